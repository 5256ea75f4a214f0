"""Project the z = 1 plane through a lens, find where a lens model is wrong, and remove the lens from pictures and labels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from kornia.geometry import create_meshgrid, remap
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import distort_points_affine, distort_points_kannala_brandt
from kornia.geometry.conversions import normalize_points_with_intrinsics
from torch import Tensor

from .._check import as_tensor, check_shapes
from .camera import Camera, Distortion
from .resample import from_bchw, to_bchw

MAX_SLOPE = 1e4  # |x / z| beyond which a distorted point is clamped (89.99 degrees): r^6 must not overflow float32


def plane_to_pixel(
    plane: Tensor,  # [..., 2] points (x / z, y / z)
    K: Tensor,  # [3, 3]
    distortion: Distortion | None = None,
) -> Tensor:  # [..., 2]
    """Map points of the z = 1 plane to pixels: u = fx D(x, y)_x + cx, v = fy D(x, y)_y + cy, with D the lens.

    D is kornia's `distort_points` or `distort_points_kannala_brandt`, which agree with COLMAP's camera models. K decides where
    pixel centres are. With a lens, slopes are clamped at 1e4, so that a point at the camera's side gives a large number
    instead of NaN.
    """
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    if distortion is None:
        return distort_points_affine(plane, intrinsics)
    coefficients = torch.tensor(distortion.coefficients, dtype=plane.dtype, device=plane.device)
    plane = plane.clamp(-MAX_SLOPE, MAX_SLOPE)
    if distortion.model == "kannala_brandt":
        return distort_points_kannala_brandt(plane, torch.cat([intrinsics, coefficients]))
    identity = torch.eye(3, dtype=K.dtype, device=K.device)
    return distort_points(plane.reshape(-1, 2), K, coefficients, new_K=identity).reshape(plane.shape)


def fold_radius(distortion: Distortion | None) -> float:
    """Radius on the z = 1 plane from which the radial polynomial runs backwards (infinity if it never does).

    Beyond it the model maps far off-axis points *into* the picture a second time, so they must not count as visible.
    It is the first positive root of the derivative of the distorted radius,
    r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), or for the fisheye of
    theta (1 + k1 theta^2 + ... + k4 theta^8) with r = tan(theta); tangential terms are ignored.
    """
    if distortion is None:
        return math.inf
    if distortion.model == "kannala_brandt":
        k1, k2, k3, k4 = distortion.coefficients
        theta = math.sqrt(_first_positive_root(np.array([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])))
        return math.tan(theta) if theta < math.pi / 2 else math.inf
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    s = np.polynomial.Polynomial([0, 1])  # r^2
    numerator = np.polynomial.Polynomial([1, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1, k4, k5, k6])
    slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
    return math.sqrt(min(_first_positive_root(slope.coef), _first_positive_root(denominator.coef)))


def _first_positive_root(coefficients: np.ndarray) -> float:
    """Smallest positive real root of a polynomial given from the constant term up; infinity if there is none."""
    roots = np.polynomial.polynomial.polyroots(coefficients)
    real = roots.real[np.abs(roots.imag) < 1e-9]
    return float(min(real[real > 0], default=math.inf))


def undistort(image: Tensor, camera: Camera) -> tuple[Tensor, Camera, Tensor]:  # image: [H, W, C]; also the mask [H, W]
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
    check_shapes(("image", image := as_tensor("image", image), f"{camera.height} {camera.width} C"))
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


def undistort_labels(labels: Tensor, camera: Camera) -> Tensor:  # [H, W] integer -> [H, W], dtype of labels
    """Remove the lens from a label map: each pixel takes the label of the nearest distorted pixel, unrecorded ones -1.

    Indexed directly, because kornia's `remap` takes floating point only.
    """
    check_shapes(("labels", labels, f"{camera.height} {camera.width}"))
    if labels.is_floating_point() or not torch.iinfo(labels.dtype).min:
        raise TypeError(f"labels: expected signed integers, got {labels.dtype}; convert them with .long()")
    if camera.distortion is None:
        return labels
    x, y, recorded = _source_positions(camera, torch.promote_types(camera.K.dtype, torch.float32), labels.device)
    rows = (y + 0.5).floor().long().clamp(0, camera.height - 1)
    columns = (x + 0.5).floor().long().clamp(0, camera.width - 1)
    return labels[rows, columns].where(recorded, -1)


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
