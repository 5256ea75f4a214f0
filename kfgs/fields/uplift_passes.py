"""The passes of the uplift over its views: sums by rendering weight, and the correction of blended Gaussians (SIRT)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..cameras import Camera, resize_map
from ..gaussians import Gaussians
from ..splat import rasterize
from ..splat.views import sum_pixels
from .working_maps import WorkingMaps, shrink_map

NEIGHBOURS = 17  # a Gaussian and its 16 nearest, whose corrections are judged together


def average(cloud: Gaussians, views: WorkingMaps, bar: Any) -> tuple[Tensor, Tensor]:  # [2, N, d' + 1], [N]
    """Sums of features and weights, over the even and the odd views, and the number of pixels that each Gaussian fills."""
    sums, shown = cloud.means.new_zeros(2, len(cloud), views.channels + 1), torch.zeros_like(cloud.opacities)
    for i in range(len(views)):
        camera, features, _, scale = views[i]
        index, total = _sum_known(cloud, camera, features)
        half = sums[i % 2]
        before = half[:, -1].clone()
        half.index_add_(0, index, total)
        shown += scale * (half[:, -1] - before)
        bar.update()
    return sums, shown


def correct(cloud: Gaussians, sums: Tensor, views: WorkingMaps, bar: Any) -> Tensor:  # sums: [2, N, d + 1]
    """One pass of SIRT: correct each Gaussian's feature by the weighted mean of the difference at its pixels, without noise.

    The even and the odd views make one reconstruction each. Signal is the part of the two corrections that agrees among
    neighbours (`reliability`); both take the reliable share. Returns the corrected sums.
    """
    halves, lacking = per_weight(sums), torch.zeros_like(sums)
    for i in range(len(views)):
        camera, features, factor, _ = views[i]
        rendered, alpha, _ = rasterize(cloud.replace(features=halves[i % 2]), camera)
        covered = shrink_map(alpha[..., None], factor)  # the rest of the pixel is empty: no Gaussian can explain it
        index, total = _sum_known(cloud, camera, covered * features - shrink_map(rendered, factor))
        lacking[i % 2].index_add_(0, index, total)
        bar.update()
    corrections, weights = per_weight(lacking), sums[..., -1:]
    share = reliability(corrections[0], corrections[1], _neighbours(cloud.means))[:, None]
    return torch.cat([(halves + share * corrections) * weights, weights], dim=-1)


def reliability(one: Tensor, other: Tensor, near: Tensor) -> Tensor:  # [N, d] x 2, [N, k] -> [N] in [0, 1]
    """The share of signal in the mean of two independent estimates: 2 r / (1 + r), the Spearman-Brown formula.

    r is the common part of the estimates, sum of products over mean sum of squares, over a Gaussian and its neighbours.
    Negative values become 0; so do those of Gaussians that one half of the views does not show.
    """
    products = (one * other).sum(1)[near].sum(1)
    squares = (one.square().sum(1) + other.square().sum(1))[near].sum(1) / 2
    r = (products / some(squares)).clamp(0, 1)
    return 2 * r / (1 + r)


def _neighbours(means: Tensor) -> Tensor:  # [N, 3] -> [N, k] int64
    """Each Gaussian and those nearest to it."""
    places = means.detach().cpu().double().numpy()
    count = min(NEIGHBOURS, len(places))
    found = cKDTree(places).query(places, k=[*range(1, count + 1)], workers=-1)[1]
    return torch.from_numpy(np.asarray(found)).to(means.device)


def per_weight(sums: Tensor) -> Tensor:  # [..., d + 1] -> [..., d]
    """Means of sums whose last column is the weight; 0 without weight."""
    return sums[..., :-1] / some(sums[..., -1:])


def some(weights: Tensor) -> Tensor:
    """Weights to divide by: 0 becomes the smallest normal number."""
    return weights.clamp_min(torch.finfo(weights.dtype).tiny)


def _sum_known(cloud: Gaussians, camera: Camera, signal: Tensor) -> tuple[Tensor, Tensor]:  # signal [h, w, c]
    """What one view adds to some rows [M] of the cloud: the sums of the signal by rendering weight and, in the last column, the
    weight of the known pixels [M, c + 1].
    """
    known = ~signal[..., :1].isnan()
    both = torch.cat([torch.where(known, signal, 0), known.to(signal)], dim=-1)
    index, total, _ = sum_pixels(cloud, camera, resize_map(both, camera.size).contiguous())
    return index, total
