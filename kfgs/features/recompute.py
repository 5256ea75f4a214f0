"""Maps that are made anew whenever they are asked for: twice the teacher's time, and no dense map on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._files import atomic_path, digest_file, digest_value
from ..quant.sampling import SAMPLES, sample_grid
from ..scenes import Scene
from ..teachers.protocol import Teacher, as_teacher, identify
from .extract import check_pictures, discard_maps, pictures_of
from .manifest import MANIFEST, Manifest, read_manifest
from .map_store import MapStore, encode_half, locked, map_file, plain_identity, sweep


class RecomputedMaps(Sequence[Tensor]):
    """A teacher's maps of some pictures: item i runs the teacher, and nothing dense is stored.

    A map is rounded to half precision as `extract_features` would, so that everything made of it is the same, bit for
    bit, as from a folder of maps. What `fit_codebook` looks at again and again, a grid of samples per map, is stored when
    it is first asked for (29 MB for a picture of 360x480x512, a sixth of the map), so that a fit runs the teacher twice
    per picture: once for the samples and once for the index maps.

    Args:
        teacher: sees each picture, [3, H, W] RGB in [0, 1]; a teacher, or a function to [D, h, w] (see `as_teacher`).
        scene: whose pictures; the teacher sees them as they lie on disk, see `pictures_of`.
        views: which of its views, in the order of the maps.
        store: folder for the samples; made when the first is written. What a killed process left there is used.

    Raises:
        TypeError: if `teacher` is none, or its identity is no JSON.
        ValueError: if there are no views.
        FileNotFoundError: if a picture is missing.
    """

    recomputed = True
    """A look at a map costs a run of the teacher: training on raw maps (`decouple`) is out of the question."""

    def __init__(
        self,
        teacher: Teacher | Callable[[Tensor], Tensor],
        scene: Scene,
        views: Sequence[int],
        store: str | Path,
    ) -> None:
        self.teacher, self.pictures, self.store = as_teacher(teacher), pictures_of(scene, views), Path(store)
        check_pictures(self.pictures, self.store)
        self.identity = plain_identity(identify(self.teacher))
        self._image_digests: dict[int, str] = {}
        self._sampled: dict[tuple[int, str], Path] = {}  # samples that were found good in this process
        self._shape: tuple[int, int, int] | None = None

    def __len__(self) -> int:
        return len(self.pictures)

    def __repr__(self) -> str:
        return f"RecomputedMaps({self.teacher.name!r}, {len(self)} pictures)"

    @property
    def stems(self) -> list[str]:
        """The names of the views."""
        return [picture.stem for picture in self.pictures]

    @property
    def files(self) -> list[Path]:
        """The pictures."""
        return [picture.path for picture in self.pictures]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map; runs the teacher unless samples of that map have been made."""
        if self._shape is None:
            self._shape = self._recorded_shape() or tuple(map(int, self[0].shape))  # type: ignore[assignment]
        assert self._shape is not None
        return self._shape

    def digests(self) -> list[list[str]]:
        """[name, SHA-256] of what decides each map: the teacher's identity and the picture's bytes."""
        return [
            [picture.stem, digest_value({"teacher": self.identity, "image": self._image_digest(i)})]
            for i, picture in enumerate(self.pictures)
        ]

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D] float32
        path = self.pictures[i].path
        return encode_half(self.teacher, self.pictures[i].read(), path).float()

    def grid(self, i: int, step: tuple[int, int] | None = None, samples: int = SAMPLES) -> Tensor:  # [n, D] float32
        """`sample_grid(self[i], step, samples=samples)`, from the store where it has been asked for before."""
        return self.grid_after(i, step, samples, change=None, key=None)

    def grid_after(
        self,
        i: int,
        step: tuple[int, int] | None,
        samples: int,
        *,
        change: Callable[[Tensor], Tensor] | None,
        key: Any,
    ) -> Tensor:  # [n, D] float32
        """`grid` of maps that are changed on their way, as by removing a lens.

        Args:
            i: which map.
            step: of the grid.
            samples: most features to take when `step` is None.
            change: [h, w, D] -> [h, w, D].
            key: JSON that tells what `change` does.
        """
        settings = {"step": None if step is None else list(step), "samples": samples if step is None else None}
        about = plain_identity({**self.identity, "grid": {**settings, "change": key}})
        folder = self.store / f"samples-{digest_value(about)[:12]}"
        where = (i, folder.name)
        if where not in self._sampled:
            self._sampled[where] = self._make_samples(i, folder, about, (step, samples), change)
        values = torch.from_numpy(np.load(self._sampled[where], allow_pickle=False))
        return values.float()

    def clear(self) -> None:
        """Delete the samples, once the codebook has been fitted. What is known about the maps stays."""
        for folder in self._folders():
            discard_maps(folder)
        self._sampled.clear()

    def _folders(self) -> dict[Path, Manifest]:
        """The folders of samples of this teacher, whatever their grid, and what they say."""
        found = {path.parent: read_manifest(path.parent) for path in sorted(self.store.glob(f"samples-*/{MANIFEST}"))}
        mine = {**self.identity, "grid": None}
        return {
            folder: one for folder, one in found.items() if one is not None and {**one.teacher, "grid": None} == mine
        }

    def _recorded_shape(self) -> tuple[int, int, int] | None:
        for manifest in self._folders().values():
            record = manifest.maps.get(self.pictures[0].stem)
            if record is not None and record.image_digest == self._image_digest(0):
                return record.shape
        return None

    def _make_samples(
        self,
        i: int,
        folder: Path,
        about: dict[str, Any],
        grid: tuple[tuple[int, int] | None, int],
        change: Callable[[Tensor], Tensor] | None,
    ) -> Path:
        """The file of the samples of map i, which is written if it is not there or not of this picture."""
        picture, target = self.pictures[i], map_file(folder, self.pictures[i].stem)
        with locked(folder):
            store = MapStore.open(folder, about)
            sweep(folder, [target])
            if store.doubt(picture.stem, self._image_digest(i)) is None:
                return target
            start = time.perf_counter()
            features = self[i]
            seconds = time.perf_counter() - start
            h, w, D = map(int, features.shape)
            values = sample_grid(features if change is None else change(features), grid[0], samples=grid[1])
            half = values.half()
            kept = half if torch.equal(half.float(), values) else values  # a changed map need not be of half precision
            with atomic_path(target) as temporary:
                np.save(temporary, kept.contiguous().numpy())
            store.add(
                picture.stem,
                target,
                shape=(h, w, D),
                image=picture.path.name,
                image_digest=self._image_digest(i),
                seconds=round(seconds, 3),
            )
        return target

    def _image_digest(self, i: int) -> str:
        if i not in self._image_digests:
            self._image_digests[i] = digest_file(self.pictures[i].path)
        return self._image_digests[i]
