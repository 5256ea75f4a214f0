"""Remove lens distortion from pictures and label maps."""

from __future__ import annotations

from dataclasses import replace

import torch
from kornia.geometry import create_meshgrid, remap
from kornia.geometry.conversions import normalize_points_with_intrinsics
from torch import Tensor

from .._check import check_shapes
from .camera import Camera
from .distortion import fold_radius, plane_to_pixel
from .resample import from_bchw, to_bchw


def undistort(
    image: Tensor,  # [H, W, C]
    camera: Camera,
) -> tuple[Tensor, Camera, Tensor]:  # [H, W, C], camera, [H, W] bool
    """Undistort a picture or a feature map; K, pose and size stay.

    Each pixel of the result looks up, bilinearly, where its ray fell in the distorted picture. kornia's `undistort_image` does
    the same two steps (distort the grid, remap), but has no fisheye model and no mask.

    Args:
        image: any number of channels, floating point, as large as the camera says (a smaller feature map:
            `camera.resized(h, w)`).
        camera: the camera that took it. Without distortion the picture is returned unchanged.

    Returns:
        The picture, 0 at unrecorded pixels; the camera without distortion; and the mask of recorded pixels. Pixels beyond the
        border of the picture, or beyond the `fold_radius` of the lens model, are not recorded. Within half a pixel of the
        border the outermost pixel is repeated.
    """
    check_shapes(("image", image, f"{camera.height} {camera.width} C"))
    if not image.is_floating_point():
        raise TypeError(f"image: expected floating point, got {image.dtype}; convert it with .float() / 255")
    if camera.distortion is None:
        return image, camera, torch.ones(camera.size, dtype=torch.bool, device=image.device)
    dtype = torch.promote_types(image.dtype, torch.float32)  # half precision cannot tell the pixels of a row apart
    x, y, recorded = _source_positions(camera, dtype, image.device)
    # with remap's default align_corners even an identity map changes the picture (kornia#4504)
    result = remap(to_bchw(image.to(dtype)), x[None], y[None], padding_mode="border", align_corners=True)
    result = from_bchw(result).where(recorded[..., None], 0).to(image.dtype)
    return result, replace(camera, distortion=None), recorded


def undistort_labels(
    labels: Tensor,  # [H, W] integer
    camera: Camera,
    fill: int = -1,
) -> Tensor:  # [H, W], dtype of labels
    """Remove the lens from a label map: each pixel takes the label of the nearest distorted pixel, unrecorded ones `fill`.

    Indexed directly, because kornia's `remap` takes floating point only.
    """
    check_shapes(("labels", labels, f"{camera.height} {camera.width}"))
    if labels.is_floating_point() or labels.dtype == torch.bool:
        raise TypeError(f"labels: expected integers, got {labels.dtype}; convert them with .long()")
    if fill < torch.iinfo(labels.dtype).min:
        raise ValueError(f"fill: expected a value that {labels.dtype} can hold, got {fill}; pass labels.long()")
    if camera.distortion is None:
        return labels
    x, y, recorded = _source_positions(camera, torch.promote_types(camera.K.dtype, torch.float32), labels.device)
    rows = (y + 0.5).floor().long().clamp(0, camera.height - 1)
    columns = (x + 0.5).floor().long().clamp(0, camera.width - 1)
    return labels[rows, columns].where(recorded, fill)


def _source_positions(
    camera: Camera, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:  # [H, W], [H, W], [H, W] bool
    """Where in the distorted picture each undistorted pixel lies, counting pixel *centres* from 0, and whether it does.

    kornia's grid and remap put centres on integers, so K is shifted by half a pixel here.
    """
    height, width = camera.size
    K = camera.intrinsics_at_integer_centers.to(device=device, dtype=dtype)
    grid = create_meshgrid(height, width, normalized_coordinates=False, device=device, dtype=dtype)[0]
    plane = normalize_points_with_intrinsics(grid, K)
    x, y = plane_to_pixel(plane, K, camera.distortion).unbind(-1)
    recorded = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
    return x, y, recorded & (plane.norm(dim=-1) < fold_radius(camera.distortion))
