"""The density of a cloud at given points: the sum of its Gaussians' densities there."""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs._check import ORIGIN, check_shapes
from kfgs._origin import recounted
from kfgs.gaussians import Gaussians
from kfgs.splat.engines import ALPHA_MIN

_PAIRS = 2_000_000  # of Gaussian and point at a time, about 200 MB
_QUERY = 4_096  # Gaussians whose points are looked up at a time


def surface_density(
    gaussians: Gaussians,
    points: Tensor,  # [P, 3] world units
) -> Tensor:  # [P] float64
    """Sum over the Gaussians of `o exp(-d^2 / 2)` at each point, d being the Mahalanobis distance to the Gaussian.

    What one Gaussian adds is left out where it is below 1/255, as the renderer leaves it out.

    Raises:
        ValueError: if `points` is not [P, 3].

    Example:
        >>> ball = Gaussians(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.tensor([0.5]))
        >>> surface_density(ball, torch.tensor([[0.0, 0, 0], [0, 0, 2], [9, 9, 9]]))  # 0.5, 0.5 exp(-2), too far
        tensor([0.5000, 0.0677, 0.0000], dtype=torch.float64)
    """
    check_shapes(("points", points, "P 3"))
    cloud = gaussians.detach().to("cpu", torch.float64)
    places = recounted(points.detach().to("cpu", torch.float64), ORIGIN, cloud.origin)
    density = torch.zeros(len(places), dtype=torch.float64)
    cloud = cloud.select(cloud.opacities > ALPHA_MIN)  # the others never reach 1/255
    if len(cloud) == 0 or len(places) == 0:
        return density
    reach = (2 * (cloud.opacities / ALPHA_MIN).log()).sqrt() * cloud.scales.amax(1)
    thinnest = torch.finfo(torch.float64).tiny ** 0.5
    whitening = quaternion_to_rotation_matrix(cloud.quats) / cloud.scales.clamp_min(thinnest)[:, None]  # R S^-1
    tree = cKDTree(places.numpy())
    for start in range(0, len(cloud), _QUERY):
        rows = slice(start, start + _QUERY)
        centers, radii = cloud.means[rows].numpy(), reach[rows].numpy()
        counts = tree.query_ball_point(centers, radii, return_length=True)
        cuts = np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS)) + 1
        for few in np.split(np.arange(len(counts)), cuts):
            found = tree.query_ball_point(centers[few], radii[few])
            owner = torch.from_numpy(start + few.repeat(counts[few]))
            where = torch.from_numpy(np.concatenate([*found, np.empty(0)]).astype(np.int64))
            offsets = (places[where] - cloud.means[owner])[:, None] @ whitening[owner]  # [n, 1, 3]
            value = cloud.opacities[owner] * (-0.5 * offsets.square().sum((1, 2))).exp()
            density.index_add_(0, where, value.where(value >= ALPHA_MIN, 0.0))
    return density
