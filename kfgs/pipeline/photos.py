"""The photographs that a colour field learns from: read when first asked for, shrunk to the training size, kept as bytes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..cameras import Camera, resize_map
from ..scenes import Scene


class Photos(Sequence[Tensor]):
    """The training pictures at their training size: read when first asked for, then kept as bytes.

    A picture is [h, w, 3] float32 in [0, 1], NaN where nothing was recorded (the border of an undistorted one), be it in
    part of the pixel. Bytes take a quarter of the memory: 0.9 MB for 639x479.

    Args:
        scene: whose pictures.
        views: which of its views.
        cameras: one per view, of the size that the picture is to have.
    """

    def __init__(self, scene: Scene, views: Sequence[int], cameras: Sequence[Camera]) -> None:
        self._scene, self._views, self._sizes = scene, list(views), [camera.size for camera in cameras]
        self._kept: dict[int, tuple[Tensor, Tensor | None]] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, 3], one picture at a time
        if i not in self._kept:
            self._kept[i] = self._read(i)
        bytes_, known = self._kept[i]
        picture = bytes_.float() / 255
        return picture if known is None else picture.masked_fill(~known[..., None], torch.nan)

    def _read(self, i: int) -> tuple[Tensor, Tensor | None]:  # [h, w, 3] uint8, [h, w] bool
        view, size = self._views[i], self._sizes[i]
        picture, known = self._scene.image(view), self._scene.mask(view)
        inside = known.float()[..., None]
        picture = resize_map(picture, size, antialias=True)
        inside = resize_map(inside, size, antialias=True)[..., 0]
        bytes_ = (picture.clamp(0, 1) * 255).round().to(torch.uint8)
        return bytes_, None if bool(known.all()) else inside > 1 - 1e-4
