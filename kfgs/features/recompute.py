"""Feature maps that run the teacher at each access: no dense map on disk, but twice the teacher's time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import read_array
from .._files import as_path, atomic_path, digest_file, digest_value, read_json, write_json
from ..quant.sampling import SAMPLES, sample_grid
from ..scenes import Scene
from ..teachers.protocol import Teacher, as_teacher, identify
from .manifest import plain_identity
from .pictures import Split, as_pictures
from .writer import encode_half


class RecomputedMaps(Sequence[Tensor]):
    """A teacher's maps of some pictures: item i runs the teacher, and no map is stored.

    A map is rounded to half precision as in `extract_features`, so all results are bit for bit those from a folder of maps.
    `fit_codebook` reads a grid of samples per map many times, so these samples are stored at the first access (29 MB for a
    picture of 360x480x512, a sixth of the map). A fit runs the teacher twice per picture: once for the samples, once for
    the index maps.

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
    """Each access runs the teacher, so training on raw maps (`decouple`) would take far too long."""

    def __init__(
        self,
        teacher: Teacher | Callable[[Tensor], Tensor],
        scene: Scene,
        split: Split,
        store: str | Path,
    ) -> None:
        self.teacher, self.pictures = as_teacher(teacher), as_pictures(scene, split, exist=True)
        self.identity = plain_identity(identify(self.teacher))
        self.store = as_path(store) / f"samples-{digest_value(self.identity)[:12]}"
        self._image_digests: dict[int, str] = {}

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
        """(h, w, D) of the first map; runs the teacher unless samples of that map have been stored."""
        h, w, D = read_json(self._shape_file) if self._shape_file.is_file() else self[0].shape
        return int(h), int(w), int(D)

    def digests(self) -> list[list[str]]:
        """[name, SHA-256] of each map's inputs: the teacher's identity and the picture's bytes."""
        return [
            [stem, digest_value({"teacher": self.identity, "image": self._image_digest(i)})]
            for i, stem in enumerate(self.stems)
        ]

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D] float32
        return encode_half(self.teacher, self.pictures[i].read(), self.pictures[i].path).float()

    def grid(self, i: int, step: tuple[int, int] | None = None, samples: int = SAMPLES) -> Tensor:  # [n, D] float32
        """`sample_grid(self[i], step, samples=samples)`, from the store after the first access."""
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
            key: JSON that identifies `change`.
        """
        settings = {"step": None if step is None else list(step), "samples": samples if step is None else None}
        about = plain_identity({"grid": {**settings, "change": key}, "image": self._image_digest(i)})
        file = (
            self.store / f"{self.stems[i]}-{digest_value(about)[:16]}.npy"
        )  # the name says what the content depends on
        try:
            return torch.from_numpy(read_array(file)).float()
        except (OSError, ValueError):  # not made yet, or damaged
            features = self[i]
        if i == 0:
            write_json(self._shape_file, list(features.shape))
        values = sample_grid(features if change is None else change(features), step, samples=samples)
        half = values.half()
        kept = half if torch.equal(half.float(), values) else values  # a changed map need not be of half precision
        with atomic_path(file) as temporary:
            np.save(temporary, kept.contiguous().numpy())
        return values

    def clear(self) -> None:
        """Delete this teacher's samples, once the codebook has been fitted. The shape of the maps stays known."""
        for file in self.store.rglob("*.npy"):
            file.unlink()

    @property
    def _shape_file(self) -> Path:
        return self.store / f"shape-{self._image_digest(0)[:16]}.json"

    def _image_digest(self, i: int) -> str:
        if i not in self._image_digests:
            self._image_digests[i] = digest_file(self.pictures[i].path)
        return self._image_digests[i]
