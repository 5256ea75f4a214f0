"""Prepare teacher maps for a run: as the scene's views are, without lens, and unknown where a pixel does not count."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from .._check import as_tensor
from .._files import digest_value
from .._rows import EPS, row_norms
from ..cameras import undistort
from ..fields.checkpoint import digest_tensors
from ..scenes import Scene
from ..scenes.files import has_alpha
from ..scenes.scene import as_taken
from .stages import Run, describe_lens


class Maps(Protocol):
    """Teacher maps, one per view, read at each access; an all-zero feature means "unknown".

    Six more members are used if they exist: `identity`, JSON of the teacher; `digests() -> list[list[str]] | None`, a digest
    of each map if known without reading the files; `shape`, (h, w, D) of the first map without reading it; `check_files()`,
    which raises before the work if a map does not fit; `grid(i, step, samples)`, see `fit_codebook`; and `blocks(i)`, the map
    a few rows at a time. Maps may differ in size, as pictures do, but not in channels.
    """

    @property
    def files(self) -> Sequence[Path]:
        """The file of each view."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        ...


class MapsInMemory(Sequence[Tensor]):
    """Maps that are tensors or arrays: they have no files, and their values are digested."""

    files: Sequence[Path] = ()

    def __init__(self, maps: Sequence[Any]) -> None:
        self._maps = [as_tensor(f"maps[{i}]", value, floating=True) for i, value in enumerate(maps)]

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D]
        return self._maps[i]

    def digests(self) -> list[list[str]]:
        """A number and the SHA-256 of the values of each map."""
        plain = (value.float() if value.dtype == torch.bfloat16 else value for value in self._maps)
        return [[f"map {i}", digest_tensors(value)] for i, value in enumerate(plain)]


class ViewMaps:
    """Maps of the views of a scene: without the lens, and all-zero outside the picture, where it is masked or transparent.

    Args:
        maps: one per view, of the pictures on disk.
        taken: the views in the frame of the maps.
        straighten: whether the lenses of `taken` are removed.
    """

    def __init__(self, maps: Maps, taken: Scene, straighten: bool) -> None:
        self.maps, self._taken, self._straighten = maps, taken, straighten
        self.files = maps.files

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D) of the first map, which does not change."""
        return map_shape(self.maps)

    def __len__(self) -> int:
        return len(self.maps)

    def digests(self) -> list[list[str]] | None:
        """The digests of the original maps; None if unknown."""
        return _known_digests(self.maps)

    def changes(self, run: Run) -> list[list[Any] | None]:
        """What decides the change of each map: the lens, and the files of mask and transparent picture; None: nothing."""
        lenses = [describe_lens(camera) if self._straighten else None for camera in self._taken.cameras]
        files = [changing_files(self._taken, i) for i in range(len(self))]
        known = iter(run.digests([file for each in files for file in each]))
        return [
            [lens, *(next(known)[1] for _ in each)] if each else lens for lens, each in zip(lenses, files, strict=True)
        ]

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        features = self.maps[i]
        size = int(features.shape[0]), int(features.shape[1])
        counted = self._taken.counted(i, size)
        if counted is not None:  # before the lens is removed, which mixes neighbours
            features = features * counted[..., None].to(features)
        if not self._straighten or self._taken.cameras[i].distortion is None:
            return features
        straight, _, inside = undistort(features, self._taken.cameras[i].resized(*size))
        return straight * inside[..., None]


class KnownFeatures(Sequence[Tensor]):
    """Raw maps as targets of a field: unknown pixels are NaN, which the loss ignores."""

    def __init__(self, maps: Maps) -> None:
        self.maps = maps

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, D], one map at a time
        features = self.maps[i]
        return features.masked_fill(row_norms(features.float())[..., None] <= EPS, torch.nan)


def as_maps(maps: Any) -> Maps:
    """Maps as they are; a list of tensors or arrays, or one array of all maps, as `MapsInMemory`; else a TypeError."""
    if isinstance(maps, list | tuple) or (isinstance(maps, Tensor | np.ndarray) and maps.ndim == 4):
        return MapsInMemory(maps)  # type: ignore[return-value, arg-type]
    if not (hasattr(maps, "files") and hasattr(maps, "__getitem__")):
        raise TypeError(
            f"maps: expected teacher maps, got {type(maps).__name__}; read them with FeatureFolder(path).of(scene), or pass a "
            "list of tensors [h, w, D], or a teacher"
        )
    return maps  # type: ignore[no-any-return]


def maps_of_views(scene: Scene, views: Sequence[int], maps: Maps, *, undistorted: bool = False) -> Maps:
    """Maps of some views' pictures as `ViewMaps`; unchanged if no view has a lens, a mask or transparent pixels.

    Args:
        scene: as it is rendered.
        views: indices of the views.
        maps: one per view, of the pictures on disk.
        undistorted: the maps are of undistorted pictures.
    """
    assert len(maps) == len(views)
    chosen, lens = scene.select(views), scene.lenses is not None and not undistorted
    changed = lens or any(changing_files(chosen, i) for i in range(len(chosen)))
    return ViewMaps(maps, as_taken(chosen) if lens else chosen, lens) if changed else maps


def changing_files(scene: Scene, i: int) -> list[Path]:
    """The mask of a view, and its picture if that may have transparent pixels."""
    mask, picture = None if scene.masks is None else scene.masks[i], scene.image_paths[i]
    return [*([] if mask is None else [mask]), *([picture] if has_alpha(picture) else [])]


def describe_maps(run: Run, maps: Maps) -> dict[str, Any]:
    """What decides the maps, as JSON: their digests (of files only if the maps do not know them), and how they are changed."""
    known = _known_digests(maps)
    changes = maps.changes(run) if isinstance(maps, ViewMaps) else []
    changed = any(change is not None for change in changes)
    files = run.digests(maps.files) if known is None else known
    return {"files": files, "changes": digest_value(changes) if changed else None}


def map_shape(maps: Maps) -> tuple[int, int, int]:
    """(h, w, D) of the first map, without reading it if the maps know their shape."""
    h, w, D = maps.shape if hasattr(maps, "shape") else maps[0].shape
    return int(h), int(w), int(D)


def _known_digests(maps: Maps) -> list[list[str]] | None:
    return maps.digests() if hasattr(maps, "digests") else None  # type: ignore[no-any-return]
