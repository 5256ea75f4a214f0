"""Project the z = 1 plane to pixels, with or without a lens; find the angle beyond which a lens model is wrong."""

from __future__ import annotations

import math

import numpy as np
import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import distort_points_affine, distort_points_kannala_brandt
from torch import Tensor

from .camera import Distortion

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
        theta = math.sqrt(_first_positive_root([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
        return math.tan(theta) if theta < math.pi / 2 else math.inf
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    s = np.polynomial.Polynomial([0, 1])  # r^2
    numerator = np.polynomial.Polynomial([1, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1, k4, k5, k6])
    slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
    return math.sqrt(min(_first_positive_root(slope.coef), _first_positive_root(denominator.coef)))


def _first_positive_root(coefficients: list[float] | np.ndarray) -> float:
    """Smallest positive real root of a polynomial given from the constant term up; infinity if there is none."""
    roots = np.polynomial.polynomial.polyroots(coefficients)
    real = roots.real[np.abs(roots.imag) < 1e-9]
    return float(min(real[real > 0], default=math.inf))
