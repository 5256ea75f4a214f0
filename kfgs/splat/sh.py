"""View-dependent colour from real spherical harmonics, degree 0 to 3, in the order and signs of 3DGS."""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import torch
from torch import Tensor

from .._check import check_shapes
from ..cameras.camera import exact_rotation

SH_C0 = 0.5 * sqrt(1 / pi)
"""The constant harmonic, 0.28209...: rgb = SH_C0 * coefficient + 0.5 at degree 0."""

C1 = sqrt(3 / (4 * pi))  # of the higher harmonics, by degree
C2 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi)), sqrt(15 / (16 * pi))
C3 = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi)), sqrt(105 / (16 * pi))


def evaluate_sh(
    sh: Tensor,  # [N, K, 3], K = 1, 4, 9 or 16
    directions: Tensor,  # [N, 3]
) -> Tensor:  # [N, 3]
    """Colour of each Gaussian seen along a direction: max(0, sum of sh * Y(direction) + 0.5), as 3DGS does.

    **Convention**: directions point from the camera to the Gaussian, in world axes, and are normalised here. Coefficients
    go by degree l, then order m = -l..l; the harmonics carry the Condon-Shortley phase, so band 1 is (-y, z, -x).

    Args:
        sh: coefficients for red, green, blue.
        directions: of any length; a zero one sees the terms without x, y, z only.

    Returns:
        Colours >= 0, not bounded above; the gradient is zero where a channel is clamped.

    Raises:
        ValueError: if shapes disagree or K is not a full set of degrees up to 3.

    Example:
        >>> sh = torch.zeros(1, 4, 3)
        >>> sh[0, 2] = 0.5  # the coefficient of z
        >>> evaluate_sh(sh, torch.tensor([[0.0, 0.0, 2.0]]))
        tensor([[0.7443, 0.7443, 0.7443]])
    """
    check_shapes(("sh", sh, "N K 3"), ("directions", directions, "N 3"))
    K = _check_degree(sh)
    return (torch.einsum("nk,nkc->nc", _basis(directions, K), sh) + 0.5).clamp(min=0)


def rotate_sh(
    sh: Tensor,  # [N, K, 3], K = 1, 4, 9 or 16
    rotation: Tensor,  # [3, 3]
) -> Tensor:  # [N, K, 3]
    """Turn the colours with the scene: `evaluate_sh(rotate_sh(sh, R), R d)` is `evaluate_sh(sh, d)` for every d.

    A rotation mixes the 2 l + 1 coefficients of a band among themselves by an orthogonal matrix D_l. It solves
    Y_l(R d) D_l = Y_l(d), here for 32 directions spread over the sphere, in float64: exact to rounding, since both sides
    are polynomials of degree l in d.

    Args:
        sh: coefficients for red, green, blue; differentiable.
        rotation: R, taking old directions to new ones as columns, d' = R d.

    Raises:
        ValueError: if shapes disagree, K is not a full set of degrees, or the matrix is not a rotation (a reflection or
            a scale included).

    Example:
        >>> quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to y
        >>> sh = torch.zeros(1, 4, 3)
        >>> sh[0, 3] = 1.0  # the coefficient of -x ...
        >>> rotate_sh(sh, quarter)[0, :, 0].round(decimals=4).abs()  # ... becomes that of -y
        tensor([0., 1., 0., 0.])
    """
    K = _check_degree(sh)
    check_shapes(("rotation", rotation, "3 3"))
    R = exact_rotation("rotation", rotation)
    directions = _sphere(32)
    before, after = _basis(directions, K), _basis(directions @ R.T, K)
    D = torch.zeros(K, K, dtype=torch.float64)
    for degree in range(int(K**0.5)):
        band = slice(degree * degree, (degree + 1) ** 2)
        D[band, band] = torch.linalg.lstsq(after[:, band], before[:, band]).solution
    return torch.einsum("jk,nkc->njc", D.to(sh), sh)


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """The degree-0 coefficient that shows `rgb` from everywhere; any shape."""
    return (rgb - 0.5) / SH_C0


def sh0_to_rgb(sh0: Tensor) -> Tensor:
    """The colour that a degree-0 coefficient shows, unclamped; the inverse of `rgb_to_sh0`."""
    return sh0 * SH_C0 + 0.5


def _check_degree(sh: Tensor) -> int:
    """The number of coefficients, which must be a full set of degrees."""
    K = check_shapes(("sh", sh, "N K 3"))["K"]
    if K not in (1, 4, 9, 16):
        raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {K}; cut it to a full degree")
    return K


def _sphere(count: int) -> Tensor:  # [count, 3] float64
    """Unit vectors spread evenly over the sphere: equal steps of height, golden-angle steps of azimuth."""
    step = torch.arange(count, dtype=torch.float64) + 0.5
    z, azimuth = 1 - 2 * step / count, step * pi * (3 - sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


def _basis(directions: Tensor, K: int) -> Tensor:  # [N, 3] -> [N, K]
    """The first K real spherical harmonics of each direction."""
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(1)
    terms = [torch.full_like(x, SH_C0)] * K
    fill_harmonics(terms, K, x, y, z)
    return torch.stack(terms, dim=1)


def fill_harmonics(basis: Any, K: int, x: Any, y: Any, z: Any) -> None:
    """Write all of the first K real spherical harmonics but the constant one; the CPU engine compiles this for numbers."""
    if K > 1:
        basis[1], basis[2], basis[3] = -C1 * y, C1 * z, -C1 * x
    if K > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5] = C2[0] * x * y, -C2[0] * y * z
        basis[6] = C2[1] * (2 * zz - xx - yy)
        basis[7], basis[8] = -C2[0] * x * z, C2[2] * (xx - yy)
    if K > 9:
        xx, yy, zz = x * x, y * y, z * z
        basis[9] = -C3[0] * y * (3 * xx - yy)
        basis[10] = C3[1] * x * y * z
        basis[11] = -C3[2] * y * (4 * zz - xx - yy)
        basis[12] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy)
        basis[13] = -C3[2] * x * (4 * zz - xx - yy)
        basis[14] = C3[4] * z * (xx - yy)
        basis[15] = -C3[0] * x * (xx - 3 * yy)
