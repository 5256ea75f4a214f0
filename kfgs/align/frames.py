"""Decide whether two clouds of a scene are in the same frame, from their distances and from the best fit nearby."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_shapes
from .._typed import typed
from ..cameras.similarity import Similarity
from .close_fit import Cloud, fit_closely
from .clouds import Array, bulk, median_spacing, nearest

REACH_SPACINGS = 2.0  # near: closer than this many spacings of the other cloud ...
REACH_SIZE = 0.01  # ... or than this share of the scene's size, whichever is more ...
REACH_MOST = 0.025  # ... but at most this share: else everything would be near a sparse cloud
NEAR_SHARE = 0.8
"""Two clouds agree if 80 % of the points of the one that fits better are near the other. (Field and colour splat of
Replica's room_0: 0.88, 300 to 4,000 Gaussians drawn from the splat: 0.78. The toy room: 1.00, 4,000 and 300 points of
it turned by half a turn: 0.63 and 0.59.)"""

LEAST_SHARE = 0.3
"""The share of the other cloud that must be near as well. It is low, because one cloud may be a part of the other. It is not 0,
because a fog of points that fills a room is near everything in it."""

DRIFT_SHARE, DRIFT_SIZE = 0.9, 0.005
"""The best fit nearby may move 90 % of the surface, along its normals, by at most this share of the size. (Same frame: 0.0007 for
room_0, up to 0.003 with few points or a part; 5 % larger: 0.007 to 0.018; moved by 2 % of the size: 0.014 to 0.019. The shares of
near points hardly change then: walls stay near walls.)"""

NEARBY = 0.05  # of the size: points farther from the other cloud have no counterpart and are left out of the fit
FITTED, STEPS = 3_000, 10  # points of each cloud in the fit, and its steps: a tenth of a second
FEWEST = 12  # points: fewer give no surface to fit


class FrameCheck(NamedTuple):
    """Whether two clouds agree, and why."""

    agree: bool
    summary: str  # one sentence with the numbers
    near: tuple[float, float]  # share of src's points near dst, and of dst's near src
    distance: float  # median distance to the other cloud, of the nearer one, world units
    reach: tuple[float, float]  # the distances that count as near dst, and near src, world units
    drift: float  # how far the best fit nearby moves the surface of src, along its normals, world units


@typed
def frames_agree(
    src: Tensor,  # [N, 3]
    dst: Tensor,  # [M, 3]
) -> FrameCheck:
    """Decide whether two clouds of one scene are in the same frame.

    A point is near when it is closer to the other cloud than 2 of that cloud's spacings (median distance to the next
    point), at least 1 % and at most 2.5 % of the scene's size (diagonal of the `robust_bounds` of the smaller cloud).
    The clouds agree if both of these hold:

    - 80 % of the points of one cloud and 30 % of the other (within their robust bounds) are near. One may be a part of the
      other.
    - They do not fit better a little elsewhere: least squares on point-to-plane distances moves 90 % of the points by less
      than 0.5 % of the size along their normals.

    Args:
        src: one cloud, finite.
        dst: the other.

    Returns:
        The decision, one sentence that explains it, and the numbers.

    Raises:
        ValueError: if shapes disagree, a cloud has fewer than two points, or a number is not finite.

    Note:
        This check is quick and strict: a few hundred points of a noisy splat may disagree with the same splat in the
        same frame. `align_clouds` takes seconds, and compares all frames.
    """
    check_shapes(("src", src, "N 3"), ("dst", dst, "M 3"))
    a, b = bulk("src", src), bulk("dst", dst)
    size = min(float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in (a, b))
    trees = cKDTree(a), cKDTree(b)
    spacings = median_spacing(trees[0]), median_spacing(trees[1])
    to_dst, to_src = (
        min(max(REACH_SPACINGS * spacing, REACH_SIZE * size), REACH_MOST * size) for spacing in spacings[::-1]
    )
    distances = nearest(trees[1], a)[0], nearest(trees[0], b)[0]
    near = float((distances[0] < to_dst).mean()), float((distances[1] < to_src).mean())
    distance = min(float(np.median(d)) for d in distances)
    drift = _drift(*(cloud[d < NEARBY * size] for cloud, d in zip((a, b), distances, strict=True)))
    agree = max(near) >= NEAR_SHARE and min(near) >= LEAST_SHARE and drift <= DRIFT_SIZE * size
    summary = (
        f"the frames {'agree' if agree else 'disagree'}: {near[0]:.0%} and {near[1]:.0%} of the points lie within "
        f"{to_dst:.3g} and {to_src:.3g} of the other cloud (median distance {distance:.3g}, spacings {spacings[0]:.3g} and "
        f"{spacings[1]:.3g}, size {size:.3g}), and the best fit nearby moves their surface by {drift:.3g}"
    )
    return FrameCheck(agree, summary, near, distance, (to_dst, to_src), drift)


def _drift(a: Array, b: Array) -> float:
    """How far the best fit nearby moves the surface of a; 0 if there are too few points to fit.

    Only the motion along the normals counts, because a wall can slide along itself unnoticed. The quantile `DRIFT_SHARE` leaves
    out edges, where normals are wrong.
    """
    if min(len(a), len(b)) < FEWEST:
        return 0.0
    rng = np.random.default_rng(0)
    one, other = (Cloud.of(cloud, FITTED, rng) for cloud in (a, b))
    fit = fit_closely(one, other, Similarity.identity(), np.geomspace(2, 0.5, STEPS))
    moved = fit.similarity.apply(torch.from_numpy(one.points)).numpy() - one.points
    return float(np.quantile(np.abs((moved * one.normals).sum(1)), DRIFT_SHARE))
