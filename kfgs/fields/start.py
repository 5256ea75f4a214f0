"""Gaussians to start a training from: one on each point of a cloud (3DGS)."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import as_tensor, check_range, check_shapes, check_whole
from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0

# Bounds of a point's spacing: near-duplicates would give specks, and a lonely point a giant Gaussian.
SMALLEST_SPACING = 0.01  # times the median spacing
LARGEST_SPACING_QUANTILE = 0.99
OUTLIER_RANGE = 4.0  # times the 0.95 quantile of the distances from the median: points farther out are dropped


def gaussians_from_points(
    points: Tensor,  # [P, 3] world units
    channels: int | None = None,
    *,
    colors: Tensor | None = None,  # [P, 3] in [0, 1], or uint8
    sh_degree: int = 3,
    initial_opacity: float = 0.1,
) -> Gaussians:
    """Put one round Gaussian on each point, with the distance of its three nearest neighbours as its width (3DGS).

    Features start at 0 and rotations at the identity. With `colors` it becomes a colour field: each Gaussian has its
    point's colour from all directions. Structure from motion leaves points far outside a scene (30 times its size is
    common): a point is dropped if its distance from the median exceeds 4 times the 0.95 quantile of these distances.

    Args:
        points: the cloud, usually `Scene.points`; at least two different ones.
        channels: d, the number of features per Gaussian; leave it out with `colors`.
        colors: of the points, usually `Scene.colors`; None starts a field of features.
        sh_degree: highest degree of the spherical harmonics of a colour field, 0 to 3.
        initial_opacity: in (0, 1).

    Example:
        >>> cube = torch.tensor([[x, y, z] for x in (0., 1.) for y in (0., 1.) for z in (0., 1.)])
        >>> gaussians_from_points(cube, 9).scales[0]
        tensor([1., 1., 1.])
    """
    points = as_tensor("points", points, floating=True).detach()
    if (channels is None) == (colors is None):
        got = "neither" if colors is None else "both"
        raise ValueError(f"channels, colors: expected one of them, got {got}; a field has features or colours")
    if colors is not None:
        colors = as_tensor("colors", colors).to(points.device)
        colors = colors.double() / 255 if colors.dtype == torch.uint8 else colors
        if not bool(((colors >= 0) & (colors <= 1)).all()):
            raise ValueError("colors: expected uint8, or numbers in [0, 1], got others; divide by 255")
    check_shapes(("points", points, "P 3"), ("colors", colors, "P 3"))
    check_whole("channels", 1 if channels is None else channels, 1)
    check_whole("sh_degree", sh_degree, 0, 3)
    check_range("initial_opacity", initial_opacity, 0, 1, closed=(False, False))
    if not bool(torch.isfinite(points).all()):
        raise ValueError("points: expected finite numbers, got others; drop those rows first")
    if len(points):
        distance = (points - points.median(dim=0).values).norm(dim=1)
        radius = float(np.quantile(distance.cpu().double().numpy(), 0.95))  # torch.quantile stops at 16M elements
        kept = distance <= (OUTLIER_RANGE * radius or math.inf)
        points, colors = points[kept], None if colors is None else colors[kept]
    n, sh = len(points), None
    if colors is not None:
        sh = points.new_zeros(n, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = rgb_to_sh0(colors.to(points))
    return Gaussians(
        means=points.clone(),
        quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        scales=point_spacing(points)[:, None].repeat(1, 3),
        opacities=points.new_full((n,), initial_opacity),
        features=None if channels is None else points.new_zeros(n, channels),
        sh=sh,
    )


def point_spacing(points: Tensor) -> Tensor:  # [P, 3] -> [P] world units
    """Root mean square distance to the three nearest other positions, clamped to bounds. Equal points are one position."""
    cloud, where = np.unique(points.detach().cpu().double().numpy(), axis=0, return_inverse=True)
    if len(cloud) < 2:
        raise ValueError(
            f"points: expected at least two different points, got {len(points)} point(s) at {len(cloud)} place(s); "
            "check that the reconstruction holds points"
        )
    neighbours = min(3, len(cloud) - 1)
    distances = np.asarray(cKDTree(cloud).query(cloud, k=neighbours + 1)[0])[:, 1:]  # the nearest is the point itself
    spacing = np.sqrt((distances**2).mean(axis=1))
    lower = SMALLEST_SPACING * float(np.median(spacing))
    upper = float(np.quantile(spacing, LARGEST_SPACING_QUANTILE))
    return torch.from_numpy(np.clip(spacing, lower, max(lower, upper))[where.reshape(-1)]).to(points)
