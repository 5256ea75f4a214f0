"""Resize maps and label maps, and remove a lens from them; the only file that turns [H, W, D] into kornia's [B, D, H, W]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from kornia.geometry import create_meshgrid, remap
from kornia.geometry.conversions import normalize_points_with_intrinsics
from kornia.geometry.transform import resize
from torch import Tensor

from .._check import as_tensor, check_shapes, check_size
from .camera import Camera, check_camera
from .projection import fold_radius, plane_to_pixel

SMALL = 8  # cells: the aspect of a smaller map says little


def to_bchw(map: Tensor) -> Tensor:  # [H, W, D] -> [1, D, H, W]
    """A map in the layout of kornia and of networks: a view, without copying.

    The batch axis is added *before* permuting, so that torch sees its channels-last memory order and resizes about 8 times
    faster (64 channels, 640x480 to 480x360: 32 against 160 ms on one thread).
    """
    check_shapes(("map", map, "H W D"))
    return map[None].permute(0, 3, 1, 2)


def from_bchw(batch: Tensor) -> Tensor:  # [1, D, H, W] or [D, H, W] -> [H, W, D]
    """A batch of one, or one of its items, as a map: a view, the inverse of `to_bchw`."""
    check_shapes(("batch", batch, (1, "D", "H", "W") if batch.ndim > 3 else "D H W"))
    return (batch if batch.ndim == 3 else batch[0]).permute(1, 2, 0)


def resize_map(
    map: Tensor,  # [H, W, D]
    size: tuple[int, int],  # (h, w)
    *,
    antialias: bool = False,
    align_corners: bool = False,
) -> Tensor:  # [h, w, D]
    """Resize a map bilinearly, differentiably: the sampling of Eq. 4, from the rendered size to the teacher's.

    **Convention**: a map covers the same rectangle at any size, as pixel centres on halves demand (`align_corners=False`). The
    paper is silent; its released script uses True, which moves samples by up to 0.17 pixel at 639x479 -> 480x360.

    Args:
        map: any number of channels, last (`from_bchw`), floating point (resize labels with `resize_labels`).
        antialias: blur before shrinking (kornia's Gaussian). It matters from a factor of about 2, where plain bilinear sampling
            skips pixels and leaves them without gradient.
        align_corners: True puts the centres of corner pixels on each other, as LSeg and the paper's script do.
    """
    check_shapes(("map", map := as_tensor("map", map), "H W D"))
    if not map.is_floating_point():
        raise TypeError(f"map: expected floating point, got {map.dtype}; use resize_labels for class indices")
    check_size(size)
    if map.shape[:2] == tuple(size):
        return map
    check_layout("map", map.shape, size)
    return from_bchw(resize(to_bchw(map), tuple(size), align_corners=align_corners, antialias=antialias))


def resize_labels(labels: Tensor, size: tuple[int, int]) -> Tensor:  # [H, W] integer -> [h, w], dtype of labels
    """Resize a label map: each new pixel takes the label at its centre; -1 stays -1.

    Row i of the result reads row floor((i + 0.5) H / h), in whole numbers. kornia's `resize(interpolation="nearest")` takes
    floor(i H / h), the label at the pixel's corner, and neither it nor "nearest-exact" accepts int64.
    """
    check_shapes(("labels", labels := as_tensor("labels", labels), "H W"))
    if labels.is_floating_point():
        raise TypeError(f"labels: expected integers, got {labels.dtype}; use resize_map for continuous values")
    check_size(size)
    rows, columns = (
        (2 * torch.arange(new, device=labels.device) + 1) * old // (2 * new)
        for new, old in zip(size, labels.shape, strict=True)
    )
    return labels[rows[:, None], columns]


def fits_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two (height, width) have the same aspect, up to one pixel (or cell) of rounding in the smaller one."""
    (h, w), (H, W) = sorted((size, other), key=math.prod)
    return abs(h - H * w / W) <= 1 or abs(w - W * h / H) <= 1


def check_layout(name: str, shape: Sequence[int], size: tuple[int, int]) -> None:
    """Raise a ValueError if a map of a picture of `size` is [D, h, w]: its last two axes have that aspect, its first two not."""
    first, middle, last = shape
    tells = first != middle and min(middle, last) >= SMALL  # an encoder's grid may be square, whatever the picture
    if tells and not fits_aspect((first, middle), size) and fits_aspect((middle, last), size):
        got = f"{tuple(shape)}; if channels are first, kfgs.cameras.from_bchw; if last, kornia's resize of to_bchw(map)"
        raise ValueError(f"{name}: expected [h, w, D] in the shape of {size[0]} x {size[1]}, got {got}")


def undistort(
    image: Tensor,  # [H, W, C]
    camera: Camera,
    *,
    mode: Literal["bilinear", "nearest"] = "bilinear",
) -> tuple[Tensor, Camera, Tensor]:  # also the mask [H, W]
    """Undistort a picture or a feature map; K, pose and size stay.

    Each pixel of the result looks up, by `mode`, where its ray fell in the distorted picture. kornia's `undistort_image` does
    the same two steps (distort the grid, remap), but has no fisheye model and no mask. Without a lens, nothing changes.

    Args:
        image: any number of channels, floating point, of the camera's size (a feature map's: `camera.resized(h, w)`).

    Returns:
        The picture, 0 at unrecorded pixels; the camera without distortion; and the mask of recorded pixels: those within the
        distorted picture and the `fold_radius` of the lens. Within half a pixel of the border the outermost pixel is repeated.
    """
    check_camera(camera)
    check_shapes(("image", image := as_tensor("image", image), f"{camera.height} {camera.width} C"))
    if not image.is_floating_point():
        raise TypeError(f"image: expected floating point, got {image.dtype}; convert it with .float() / 255")
    if camera.distortion is None:
        return image, camera, torch.ones(camera.size, dtype=torch.bool, device=image.device)
    dtype = torch.promote_types(image.dtype, torch.float32)  # half precision cannot tell the pixels of a row apart
    K = camera.intrinsics_at_integer_centers.to(image.device, dtype)  # as kornia's grid and remap count
    plane = normalize_points_with_intrinsics(create_meshgrid(*camera.size, False, image.device, dtype)[0], K)
    x, y = plane_to_pixel(plane, K, camera.distortion).unbind(-1)
    recorded = (x >= -0.5) & (x < camera.width - 0.5) & (y >= -0.5) & (y < camera.height - 0.5)
    recorded &= plane.norm(dim=-1) < fold_radius(camera.distortion)
    # with remap's default align_corners even an identity map changes the picture (kornia#4504)
    result = remap(to_bchw(image.to(dtype)), x[None], y[None], mode, "border", align_corners=True)
    result = from_bchw(result).where(recorded[..., None], 0).to(image.dtype)
    return result, replace(camera, distortion=None), recorded
