"""Whether two clouds show the same scene in the same frame: how far each is from the other, against their spacing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_shapes
from .points import robust_bounds

Array = np.ndarray[Any, Any]

SAMPLE = 20_000  # points of each cloud that are measured
REACH_SPACINGS = 2.0  # near = closer than so many spacings of the sparser cloud ...
REACH_SIZE = 0.01  # ... or than this share of the scene's size, whichever is more
NEAR_SHARE = 0.8
"""Two clouds agree when four points in five of the one that fits better are near the other. (A semantic and a colour
field of the toy room: 0.99; the same with one turned by half a turn about the vertical: 0.77; 5 % larger: 0.52.)"""

LEAST_SHARE = 0.3
"""And this many of the other: one cloud may be a part of the other, but all of a room lies near a fog that fills it."""


class FrameCheck(NamedTuple):
    """Whether two clouds agree, and why, in words."""

    agree: bool
    words: str
    near: tuple[float, float]  # share of src's points near dst, and of dst's near src
    distance: float  # median distance to the other cloud, of the nearer one, world units
    reach: float  # what counted as near, world units


def frames_agree(
    src: Tensor,  # [N, 3]
    dst: Tensor,  # [M, 3]
) -> FrameCheck:
    """Say whether two clouds of one scene lie in the same frame.

    A point is near when it is closer to the other cloud than 2 spacings (median distance to the next point) of the
    sparser cloud, or 1 % of the scene's size (diagonal of the `robust_bounds` of the smaller cloud). The clouds agree
    when 80 % of one's and 30 % of the other's points (within their robust bounds) are near: one may be a part of the
    other.

    Args:
        src: one cloud, finite.
        dst: the other.

    Returns:
        The verdict, one sentence with the numbers behind it, and the numbers.

    Raises:
        ValueError: if shapes disagree, a cloud has fewer than two points, or a number is not finite.

    Note:
        Walls may lie on walls when a room is turned by half a turn: this check is quick, not clever. `align_clouds`
        compares such frames with each other.
    """
    check_shapes(("src", src, "N 3"), ("dst", dst, "M 3"))
    a, b = bulk("src", src), bulk("dst", dst)
    size = min(float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in (a, b))
    trees = cKDTree(a), cKDTree(b)
    spacing = max(median_spacing(tree) for tree in trees)
    reach = max(REACH_SPACINGS * spacing, REACH_SIZE * size)
    distances = [nearest(tree, cloud)[0] for tree, cloud in ((trees[1], a), (trees[0], b))]
    near = float((distances[0] < reach).mean()), float((distances[1] < reach).mean())
    distance = min(float(np.median(d)) for d in distances)
    agree = max(near) >= NEAR_SHARE and min(near) >= LEAST_SHARE
    words = (
        f"the frames {'agree' if agree else 'disagree'}: {near[0]:.0%} and {near[1]:.0%} of the points lie within "
        f"{reach:.3g} of the other cloud (median distance {distance:.3g}, spacing {spacing:.3g}, size {size:.3g})"
    )
    return FrameCheck(agree, words, near, distance, reach)


def bulk(name: str, points: Tensor, sample: int = SAMPLE) -> Array:
    """The points within robust bounds, float64, evenly thinned, each place once; refuses NaN and fewer than two."""
    values = points.detach().double().cpu()
    finite = values.isfinite().all(1)
    if not bool(finite.all()):
        raise ValueError(
            f"{name}: expected finite positions, got NaN or infinity in row {int((~finite).nonzero()[0])}; remove such "
            "points first"
        )
    if len(values) < 2:
        raise ValueError(f"{name}: expected at least two points, got {len(values)}; there is nothing to compare")
    kept: Array = values[robust_bounds(values, margin=0.0).inside].numpy() if len(values) > 100 else values.numpy()
    return np.unique(kept[:: max(1, len(kept) // sample)], axis=0)  # no two at one place: the spacing is not 0


def median_spacing(tree: cKDTree) -> float:
    """Median distance from a point to the next at another place."""
    return float(np.median(nearest(tree, np.asarray(tree.data)[:: max(1, tree.n // 5_000)], k=2)[0][:, 1]))


def nearest(tree: cKDTree, places: Array, k: int = 1) -> tuple[Array, Array]:
    """Distances and indices of the k nearest points, [N] each, or [N, k] for more than one."""
    distances, indices = tree.query(places, k=k, workers=1)
    return np.asarray(distances), np.asarray(indices)
