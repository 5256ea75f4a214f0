"""A view at a fraction of its size: whole blocks of pixels averaged, and the camera that would have seen just that."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..cameras import Camera
from ..cameras.resample import from_bchw, to_bchw


def shrink_map(
    map: Tensor,  # [H, W, D]
    divisor: int,
) -> Tensor:  # [H // divisor, W // divisor, D]
    """The mean of every block of divisor x divisor pixels; a block with a NaN is NaN. Rows and columns that are left over at
    the bottom and right are dropped, so that blocks stay whole.
    """
    return from_bchw(torch.nn.functional.avg_pool2d(to_bchw(map), divisor))


def shrink_camera(camera: Camera, divisor: int) -> Camera:
    """The camera of `shrink_map`'s picture. Its pixels are divisor times as wide, exactly, whatever was dropped.

    `Camera.resized` would squeeze the dropped pixels in instead, which moves everything by a fraction of a pixel.
    """
    factors = camera.K.new_tensor([1 / divisor, 1 / divisor, 1.0])[:, None]
    return replace(camera, K=camera.K * factors, width=camera.width // divisor, height=camera.height // divisor)
