"""Whether two clouds show the same scene in the same frame: how far each is from the other, and where they fit best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_shapes
from ..cameras.similarity import Similarity
from .close_fit import Cloud, fit_closely
from .clouds import Array, bulk, median_spacing, nearest

REACH_SPACINGS = 2.0  # near = closer than so many spacings of the other cloud ...
REACH_SIZE = 0.01  # ... or than this share of the scene's size, whichever is more ...
REACH_MOST = 0.025  # ... but never more than this share: a sparse cloud of anything would be near everything
NEAR_SHARE = 0.8
"""Two clouds agree when four points in five of the one that fits better are near the other. (Field and colour splat of
Replica's room_0: 0.88, 300 to 4,000 Gaussians drawn from the splat: 0.78. The toy room: 1.00, 4,000 and 300 points of
it turned by half a turn: 0.63 and 0.59.)"""

LEAST_SHARE = 0.3
"""And this many of the other: one cloud may be a part of the other, but all of a room lies near a fog that fills it."""

DRIFT_SHARE, DRIFT_SIZE = 0.9, 0.005
"""And when the fit that is best nearby moves the surface, along its normals and at nine points in ten, by at most this
share of the size. (Same frame: 0.0007 for room_0, up to 0.003 with few points or a part; 5 % larger: 0.007 to 0.018;
moved by 2 % of the size: 0.014 to 0.019. The shares that are near hardly notice: walls stay near walls.)"""

NEARBY = 0.05  # of the size: points farther from the other cloud have no counterpart, and no say in the best fit nearby
FITTED, STEPS = 3_000, 10  # points of each cloud that look for the best fit, and its steps: a tenth of a second
FEWEST = 12  # points: below, there are no surfaces to fit


class FrameCheck(NamedTuple):
    """Whether two clouds agree, and why, in words."""

    agree: bool
    words: str
    near: tuple[float, float]  # share of src's points near dst, and of dst's near src
    distance: float  # median distance to the other cloud, of the nearer one, world units
    reach: tuple[float, float]  # what counted as near dst, and near src, world units
    drift: float  # how far the best fit nearby moves the surface of src, along its normals, world units


def frames_agree(
    src: Tensor,  # [N, 3]
    dst: Tensor,  # [M, 3]
) -> FrameCheck:
    """Say whether two clouds of one scene lie in the same frame.

    A point is near when it is closer to the other cloud than 2 of that cloud's spacings (median distance to the next
    point), at least 1 % and at most 2.5 % of the scene's size (diagonal of the `robust_bounds` of the smaller cloud).
    The clouds agree when 80 % of one's and 30 % of the other's points (within their robust bounds) are near: one may be
    a part of the other; and when they fit no better a little elsewhere: least squares on point-to-plane distances, from
    where they are, moves nine points in ten by less than 0.5 % of the size along their normals.

    Args:
        src: one cloud, finite.
        dst: the other.

    Returns:
        The verdict, one sentence with the numbers behind it, and the numbers.

    Raises:
        ValueError: if shapes disagree, a cloud has fewer than two points, or a number is not finite.

    Note:
        This check is quick, and strict rather than lenient: a few hundred points of a noisy splat may disagree in their
        own frame. `align_clouds` takes seconds, and compares all frames with each other.
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
    words = (
        f"the frames {'agree' if agree else 'disagree'}: {near[0]:.0%} and {near[1]:.0%} of the points lie within "
        f"{to_dst:.3g} and {to_src:.3g} of the other cloud (median distance {distance:.3g}, spacings {spacings[0]:.3g} and "
        f"{spacings[1]:.3g}, size {size:.3g}), and the best fit nearby moves their surface by {drift:.3g}"
    )
    return FrameCheck(agree, words, near, distance, (to_dst, to_src), drift)


def _drift(a: Array, b: Array) -> float:
    """How far the best fit nearby moves the surface of a; 0 where there is too little to fit.

    Along the normals, and the quantile `DRIFT_SHARE` of it: where walls slide along themselves nothing can be told, and
    normals at edges are no normals.
    """
    if min(len(a), len(b)) < FEWEST:
        return 0.0
    rng = np.random.default_rng(0)
    one, other = (Cloud.of(cloud, FITTED, rng) for cloud in (a, b))
    fit = fit_closely(one, other, Similarity.identity(), np.geomspace(2, 0.5, STEPS))
    moved = fit.similarity.apply(torch.from_numpy(one.points)).numpy() - one.points
    return float(np.quantile(np.abs((moved * one.normals).sum(1)), DRIFT_SHARE))
