"""Maps that the teacher makes again whenever they are asked for: twice its time, and no dense map on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._files import atomic_path, digest_file, digest_value
from ..quant.sampling import SAMPLES, sample_grid
from ..scenes import Scene
from ..teachers.protocol import Teacher, as_teacher, identify
from .extract import discard_maps
from .layouts import map_file
from .manifest import MANIFEST, Manifest, plain_identity, read_manifest
from .pictures import Split, as_pictures
from .writer import MapWriter, encode_half, locked


class RecomputedMaps(Sequence[Tensor]):
    """A teacher's maps of some pictures: item i runs the teacher, and nothing dense is stored.

    A map is rounded to half precision as in `extract_features`, so that everything made from it is the same, bit for bit,
    as from a folder of maps. `fit_codebook` looks at a grid of samples per map again and again; these are stored when they
    are first asked for (29 MB for a picture of 360x480x512, a sixth of the map). So a fit runs the teacher twice per
    picture: once for the samples and once for the index maps.

    Args:
        teacher: sees each picture, [3, H, W] RGB in [0, 1]; a teacher, or a function to [D, h, w] (see `as_teacher`).
        scene: whose pictures; the teacher sees them as they are on disk, see `pictures_of`.
        split: the name of a split, `all`, or a list of view names or indices.
        store: folder for the samples; made when the first is written. Samples that a killed process left are used.

    Raises:
        TypeError: if `teacher` is no teacher, or JSON cannot hold its identity.
        ValueError: if there are no views.
        FileNotFoundError: if a picture is missing.
    """

    recomputed = True
    """Looking at a map runs the teacher, so training on raw maps (`decouple`) would take far too long."""

    def __init__(
        self,
        teacher: Teacher | Callable[[Tensor], Tensor],
        scene: Scene,
        split: Split,
        store: str | Path,
    ) -> None:
        self.teacher, self.store = as_teacher(teacher), Path(store)
        self.pictures = as_pictures(scene, split, exist=True)
        self.identity = plain_identity(identify(self.teacher))
        self._image_digests: dict[int, str] = {}
        self._sampled: dict[tuple[int, str], Path] = {}  # samples that this process made or checked

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

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map; runs the teacher unless samples of that map were stored."""
        records = [manifest.maps.get(self.stems[0]) for manifest in self._folders().values()]
        made = [one.shape for one in records if one is not None and one.image_digest == self._image_digest(0)]
        h, w, D = map(int, made[0] if made else self[0].shape)
        return h, w, D

    def digests(self) -> list[list[str]]:
        """[name, SHA-256] of what decides each map: the teacher's identity and the picture's bytes."""
        return [
            [stem, digest_value({"teacher": self.identity, "image": self._image_digest(i)})]
            for i, stem in enumerate(self.stems)
        ]

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D] float32
        return encode_half(self.teacher, self.pictures[i].read(), self.pictures[i].path).float()

    def grid(self, i: int, step: tuple[int, int] | None = None, samples: int = SAMPLES) -> Tensor:  # [n, D] float32
        """`sample_grid(self[i], step, samples=samples)`, from the store if it has been asked for before."""
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
        """`grid` of maps that are changed first, for instance by removing lens distortion.

        Args:
            i: which map.
            step: of the grid.
            samples: most features to take when `step` is None.
            change: [h, w, D] -> [h, w, D].
            key: JSON that identifies what `change` does.
        """
        settings = {"step": None if step is None else list(step), "samples": samples if step is None else None}
        about = plain_identity({**self.identity, "grid": {**settings, "change": key}})
        folder = self.store / f"samples-{digest_value(about)[:12]}"
        where = (i, folder.name)
        if where not in self._sampled:
            self._sampled[where] = self._make_samples(i, folder, about, (step, samples), change)
        return torch.from_numpy(np.load(self._sampled[where], allow_pickle=False)).float()

    def clear(self) -> None:
        """Delete the samples, once the codebook has been fitted. What is known about the maps stays."""
        for folder in self._folders():
            discard_maps(folder)
        self._sampled.clear()

    def _folders(self) -> dict[Path, Manifest]:
        """The folders of samples of this teacher, for any grid, and their manifests."""
        found = {path.parent: read_manifest(path.parent) for path in sorted(self.store.glob(f"samples-*/{MANIFEST}"))}
        mine = {**self.identity, "grid": None}
        return {path: one for path, one in found.items() if one is not None and {**one.teacher, "grid": None} == mine}

    def _make_samples(
        self,
        i: int,
        folder: Path,
        about: dict[str, Any],
        grid: tuple[tuple[int, int] | None, int],
        change: Callable[[Tensor], Tensor] | None,
    ) -> Path:
        """The file of the samples of map i, which is written unless it is there and of this picture."""
        picture, target = self.pictures[i], map_file(folder, self.stems[i])
        with locked(folder):
            writer = MapWriter(folder, about, [picture])
            if writer.doubt(picture.stem, self._image_digest(i)) is None:
                return target
            start, features = time.perf_counter(), self[i]
            seconds = time.perf_counter() - start
            h, w, D = map(int, features.shape)
            values = sample_grid(features if change is None else change(features), grid[0], samples=grid[1])
            half = values.half()
            kept = half if torch.equal(half.float(), values) else values  # a changed map need not be of half precision
            with atomic_path(target) as temporary:
                np.save(temporary, kept.contiguous().numpy())
            writer.add(picture, self._image_digest(i), target, (h, w, D), seconds)
        return target

    def _image_digest(self, i: int) -> str:
        if i not in self._image_digests:
            self._image_digests[i] = digest_file(self.pictures[i].path)
        return self._image_digests[i]
