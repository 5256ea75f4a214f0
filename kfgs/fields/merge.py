"""Merge Gaussians with similar features in one voxel to a single Gaussian with the same moments."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from ..gaussians import Gaussians
from ..quant.grow import group_sums, spherical_kmeans
from ..splat.covariance import covariance_3d

CLUSTERS = 64
"""Kinds of features that are never merged with each other: they keep neighbours apart that mean different things. 32 and 64 gave
the same mIoU on room_0 within half a point."""
FAINT = 0.05  # of all weight: on room_0 about two thirds of a colour field's Gaussians hold so little together
FRAGMENT = 0.25
"""Of the weight in a cube: a kind with less joins the heaviest. On room_0 this and dropping the faintest Gaussians raised the
mean IoU of 18 queries, each Gaussian asked alone, from 0.83 to 0.87."""
TRIES = 24  # halvings of the voxel's size: the count is then within 1 % of what was asked for, or as near as it gets
OPACITY = 0.05, 0.99  # of merged Gaussians: fainter ones would be pruned by the next step of any training


class Merged(NamedTuple):
    """The merged cloud, and the members of its Gaussians."""

    gaussians: Gaussians  # M, with features
    group: Tensor  # [N] int64, the merged Gaussian of each old one; -1 = dropped

    def pool(self, values: Tensor) -> Tensor:  # [N, ...] -> [M, ...]
        """Sums over the members of each merged Gaussian, for instance of their weights."""
        kept = self.group >= 0
        return group_sums(values[kept], self.group[kept], len(self.gaussians))


def merge_gaussians(
    gaussians: Gaussians,
    weights: Tensor,  # [N] >= 0
    maximum: int,
    *,
    generator: torch.Generator | None = None,
) -> Merged:
    """Prune and merge Gaussians with features until at most `maximum` are left; some weight is not 0. Classes are not used.

    If there are more, the faintest Gaussians are dropped, which together have a twentieth of all weight. These are many,
    because a splat has many Gaussians that are hardly visible; their features are noise. The others are merged if they lie
    in one cube of a grid and their features are in one of 64 groups (spherical k-means). The cubes are as small as possible
    with at most `maximum` Gaussians left. A merged Gaussian has the weighted mean, covariance (of the
    mixture: within plus between its members) and mean feature of its members. Its opacity keeps the area that they covered:
    the sum of o_i A_i divided by its A, where A is the product of the two larger standard deviations.

    Args:
        weights: usually the pixels that each Gaussian fills in the training views. Those without are dropped.
        generator: draws the first centres of k-means; None: seed 0.
    """
    rows = (weights > 0).nonzero()[:, 0]
    if len(rows) > maximum:  # all but the smallest weights, which sum to at most this share of all
        order = rows[weights[rows].argsort(stable=True)]
        below = weights[order].double().cumsum(0) <= FAINT * weights.double().sum()
        rows = order[~below].sort().values
    kept, worth = gaussians.select(rows).replace(labels=None, sh=None), weights[rows]
    assert kept.features is not None
    groups = torch.full_like(weights, -1, dtype=torch.int64)
    if len(rows) <= maximum:
        groups[rows] = torch.arange(len(rows), device=rows.device)
        return Merged(kept, groups)
    kinds = spherical_kmeans(kept.features, worth, CLUSTERS, generator=generator)[1].codeword
    group, count = _smallest_voxels(kept.means, kinds, worth, maximum)
    groups[rows] = group
    return Merged(_match_moments(kept, worth, group, count), groups)


def _smallest_voxels(means: Tensor, kinds: Tensor, worth: Tensor, maximum: int) -> tuple[Tensor, int]:  # [n] int64, M
    """The groups of the finest grid that leaves at most `maximum` of them."""
    low, span = means.amin(0), float((means.amax(0) - means.amin(0)).max())
    fine, coarse = 0.0, 1.001 * span + torch.finfo(means.dtype).tiny
    while (best := _groups(means, low, coarse, kinds, worth))[1] > maximum:
        kinds = kinds // 2  # a single cube has more kinds than `maximum`: merge kinds too
    for _ in range(TRIES):
        middle = (fine + coarse) / 2
        groups = _groups(means, low, middle, kinds, worth)
        if groups[1] > maximum:
            fine = middle
        elif (best := groups)[1] > 0.99 * maximum:
            break
        else:
            coarse = middle
    return best


def _groups(means: Tensor, low: Tensor, edge: float, kinds: Tensor, worth: Tensor) -> tuple[Tensor, int]:
    """Number the pairs of cube and kind; a kind with little weight in a cube joins the heaviest kind there."""
    cells = ((means - low).double() / edge).floor().to(torch.int64)
    sides = cells.amax(0) + 1
    column = torch.unique(cells[:, 0] * sides[1] + cells[:, 1], return_inverse=True)[1]
    # in two steps: three sides overflow int64
    cube = torch.unique(column * sides[2] + cells[:, 2], return_inverse=True)[1]
    pairs, group = torch.unique(cube * (kinds.max() + 1) + kinds, return_inverse=True)
    cube_of = pairs // (kinds.max() + 1)  # [M]
    weight = group_sums(worth, group, len(pairs))
    share = weight / group_sums(weight, cube_of, int(cube_of.max()) + 1)[cube_of]
    order = weight.argsort(stable=True)
    order = order[cube_of[order].argsort(stable=True)]  # by cube, and in a cube by weight
    heaviest = order[torch.bincount(cube_of).cumsum(0) - 1]  # the last of each cube
    joined = torch.where(share < FRAGMENT, heaviest[cube_of], torch.arange(len(pairs), device=means.device))
    left, renumbered = torch.unique(joined[group], return_inverse=True)
    return renumbered, len(left)


def _match_moments(cloud: Gaussians, worth: Tensor, group: Tensor, count: int) -> Gaussians:
    """The merged Gaussian of each group."""
    assert cloud.features is not None
    share = (worth.double() / group_sums(worth.double(), group, count)[group])[:, None]  # [n, 1]
    places = cloud.means.double()
    means = group_sums(share * places, group, count)
    away = places - means[group]
    own = covariance_3d(cloud.quats, cloud.scales).double()
    between = away[:, :, None] * away[:, None, :]
    covariances = group_sums(share[:, :, None] * (own + between), group, count)
    variances, axes = torch.linalg.eigh(covariances)
    smallest = torch.finfo(cloud.means.dtype).eps * variances[:, 2:]  # a flat group still has a thickness
    scales = torch.maximum(variances, smallest).sqrt()
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a reflection
    covered = group_sums(cloud.opacities.double() * _area(cloud.scales.double()), group, count)
    opacities = (covered / _area(scales)).clamp(*OPACITY)
    return cloud.replace(
        means=means.to(cloud.means),
        quats=rotation_matrix_to_quaternion(axes.contiguous()).to(cloud.means),
        scales=scales.to(cloud.means),
        opacities=opacities.to(cloud.means),
        features=group_sums(share.to(cloud.features) * cloud.features, group, count),
    )


def _area(scales: Tensor) -> Tensor:  # [n, 3] -> [n]
    """Product of the two larger standard deviations: the visible area of a flat Gaussian, up to a constant."""
    ordered = scales.sort(dim=1).values
    return ordered[:, 1] * ordered[:, 2]
