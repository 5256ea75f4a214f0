"""Teacher maps on their way into a run: the lens removed where the scene's was, unknown pixels marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from ..cameras import Camera, undistort
from ..quant import EPS, row_norms


class Maps(Protocol):
    """Teacher maps on disk, one file per view, read when asked for; an all-zero feature says "nothing known"."""

    @property
    def files(self) -> Sequence[Path]:
        """The file of each view."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        ...


class UndistortedMaps:
    """Maps of the pictures as they were taken, brought to the undistorted views of a scene.

    Where the lens saw nothing, the feature becomes all-zero.

    Args:
        maps: one per view, of the distorted pictures.
        lenses: the views' cameras with their distortion (`Scene.lenses`), at any size of the same aspect.

    Raises:
        ValueError: if the counts differ.
    """

    def __init__(self, maps: Maps, lenses: Sequence[Camera]) -> None:
        if len(maps) != len(lenses):
            raise ValueError(
                f"lenses: expected {len(maps)} cameras (one per map), got {len(lenses)}; give one for each"
            )
        self.maps, self.lenses = maps, lenses

    @property
    def files(self) -> Sequence[Path]:
        """The files of the maps as they are on disk."""
        return self.maps.files

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        features = self.maps[i]
        lens = self.lenses[i].resized(int(features.shape[0]), int(features.shape[1]))
        if lens.distortion is None:
            return features
        straight, _, inside = undistort(features, lens)
        return straight * inside[..., None]


class KnownFeatures(Sequence[Tensor]):
    """Raw maps as targets of a field (`decouple`): pixels without a feature are NaN, which the loss leaves out."""

    def __init__(self, maps: Maps) -> None:
        self.maps = maps

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D], one map at a time
        features = self.maps[i]
        return features.masked_fill(row_norms(features.float())[..., None] <= EPS, torch.nan)
