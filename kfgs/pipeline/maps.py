"""Prepare teacher maps for a run: as the scene's views are, without lens, and unknown where a pixel does not count."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._check import as_tensor
from .._files import digest_value
from .._rows import EPS, row_norms
from ..cameras import undistort
from ..fields.train import digest_tensors
from ..quant.maps import FeatureMaps
from ..scenes import Scene
from ..scenes.files import has_alpha
from ..scenes.scene import as_taken
from .stages import Run, describe_lens


class ViewMaps:
    """Maps of the views of a scene: without the lens, and all-zero outside the picture, where it is masked or transparent."""

    def __init__(self, maps: FeatureMaps, views: Scene) -> None:
        self.maps, self._taken, self._straighten = maps, as_taken(views), views.lenses is not None
        self._counted = cache(self._taken.counted)  # maps are read several times

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map, which does not change."""
        return map_shape(self.maps)

    def __len__(self) -> int:
        return len(self.maps)

    def changes(self, run: Run) -> list[list[Any] | None]:
        """What decides the change of each map: the lens, and the files of mask and transparent picture; None: nothing."""
        files = [changing_files(self._taken, i) for i in range(len(self))]
        digests = (digest for _, digest in run.digests([file for group in files for file in group]))
        lenses = [describe_lens(camera) if self._straighten else None for camera in self._taken.cameras]
        pairs = zip(lenses, files, strict=True)
        return [[lens, *(next(digests) for _ in group)] if group else lens for lens, group in pairs]

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        features = self.maps[i]
        size = int(features.shape[0]), int(features.shape[1])
        counted = self._counted(i, size)
        if counted is not None:  # before the lens is removed, which mixes neighbours
            features = features * counted[..., None].to(features)
        if self._taken.cameras[i].distortion is None:
            return features
        straight, _, inside = undistort(features, self._taken.cameras[i].resized(*size))
        return straight * inside[..., None]


class KnownFeatures(Sequence[Tensor]):
    """Raw maps as targets of a field: unknown pixels are NaN, which the loss ignores."""

    def __init__(self, maps: FeatureMaps) -> None:
        self.maps = maps

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D], one map at a time
        features = self.maps[i]
        return features.masked_fill(row_norms(features.float())[..., None] <= EPS, torch.nan)


def as_maps(maps: Any) -> FeatureMaps:
    """Maps as they are, those of a list or of one array as tensors; a TypeError if they are something else.

    Members of a `FeatureFolder` are used if they exist: `identity`, `files`, `shape`, `check_files()`, `grid` and `blocks`.
    """
    if isinstance(maps, list | tuple) or (isinstance(maps, Tensor | np.ndarray) and maps.ndim == 4):
        return [as_tensor(f"maps[{i}]", value, floating=True) for i, value in enumerate(maps)]
    if not hasattr(maps, "__getitem__") or isinstance(maps, str | Mapping | Tensor | np.ndarray):
        raise TypeError(
            f"maps: expected teacher maps, got {type(maps).__name__}; read them with FeatureFolder(path).of(scene), or pass a "
            "list of tensors [h, w, D], or a teacher"
        )
    return maps  # type: ignore[no-any-return]


def maps_of_views(
    scene: Scene,  # as it is rendered
    views: Sequence[int],
    maps: FeatureMaps,  # one per view, of the pictures on disk
) -> FeatureMaps:
    """Maps of some views' pictures as `ViewMaps`; unchanged if no view has a lens, a mask or transparent pixels."""
    assert len(maps) == len(views)
    chosen = scene.select(views)
    changed = chosen.lenses is not None or any(changing_files(chosen, i) for i in range(len(chosen)))
    return ViewMaps(maps, chosen) if changed else maps


def changing_files(scene: Scene, i: int) -> list[Path]:
    """The mask of a view, and its picture if that may have transparent pixels."""
    mask, picture = None if scene.masks is None else scene.masks[i], scene.image_paths[i]
    return [*([] if mask is None else [mask]), *([picture] if has_alpha(picture) else [])]


def describe_maps(run: Run, maps: FeatureMaps) -> dict[str, Any]:
    """What decides the maps, as JSON: digests of their files, or else of their values, and how they are changed."""
    plain = maps.maps if isinstance(maps, ViewMaps) else maps
    if hasattr(plain, "files"):
        digests = run.digests(plain.files)
    else:
        digests = [[f"map {i}", digest_tensors(plain[i].double())] for i in range(len(plain))]
    changes = maps.changes(run) if isinstance(maps, ViewMaps) else []
    changed = any(change is not None for change in changes)
    return {"files": digests, "changes": digest_value(changes) if changed else None}


def map_shape(maps: FeatureMaps) -> tuple[int, int, int]:
    """(h, w, D) of the first map, without reading it if the maps know their shape."""
    h, w, D = getattr(maps, "shape", None) or maps[0].shape
    return int(h), int(w), int(D)
