"""How far a label may travel: lambda of Sec. 3.4, for which the paper has no value, from the spacing of two clouds."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_shapes
from .transfer_sources import Array, distinct

SAMPLE = 20_000  # Gaussians measured
COVERAGE = 0.995  # the distance reaches this share of the destinations ...
NEAREST = 2.0  # ... but is no less than so many median spacings of the sources ...
FARTHEST = 10.0  # ... and no more than so many of their wide spacings,
WIDE = 0.9  # those that nine sources in ten keep


def default_distance(
    src_means: Tensor,  # [S, 3]
    dst_means: Tensor,  # [N, 3]
) -> float:
    """A lambda for two clouds, in world units: it scales with the scene.

    The distance within which 99.5 % of the destinations have a source, but no less than 2 median spacings of the sources
    (distances to the nearest other source) and no more than 10 times the spacing that nine in ten keep. The upper bound
    keeps floaters and background, which only the colour field has, from taking labels across the room; it asks for the
    wide spacings, since a few large Gaussians fill a wall. The lower bound lets a destination that lies between two
    sources reach both. A cloud with one source position has no spacing, and the 99.5 % quantile stands alone.
    Measured on an evenly strided sample of at most 20,000 Gaussians of each cloud.

    Raises:
        ValueError: if a cloud is empty or a position is not finite.
    """
    check_shapes(("src_means", src_means, "S 3"), ("dst_means", dst_means, "N 3"))
    src, dst = positions("src_means", src_means), positions("dst_means", dst_means)
    for name, points in (("src_means", src), ("dst_means", dst)):
        if len(points) == 0:
            raise ValueError(f"{name}: expected at least one Gaussian, got none; pass the distance yourself")
    return explained_distance(cKDTree(src[distinct(src)[0]]), dst)[0]


def explained_distance(tree: cKDTree, dst: Array) -> tuple[float, str]:
    """`default_distance` on a tree of distinct positions, with one line that explains it."""
    tiny = 1e-6 * max(1.0, float(np.abs(tree.maxes).max()), float(np.abs(tree.mins).max()))
    if len(dst) == 0:
        return tiny, "no destinations"
    needed = f"{100 * COVERAGE:g} % of the destinations"
    reach = float(np.quantile(tree.query(_sample(dst), workers=-1)[0], COVERAGE))
    if tree.n == 1:
        return max(1.01 * reach, tiny), f"{needed} lie within {reach:.3g} of the one source position"
    spacings = np.asarray(tree.query(_sample(np.asarray(tree.data)), k=2, workers=-1)[0])[:, 1]
    usual, wide = (float(spacing) for spacing in np.quantile(spacings, [0.5, WIDE]))
    if reach > FARTHEST * wide:
        return max(FARTHEST * wide, tiny), (
            f"{FARTHEST:g} wide source spacings of {wide:.3g} ({needed} would need {reach:.3g})"
        )
    if reach < NEAREST * usual:
        return max(NEAREST * usual, tiny), (
            f"{NEAREST:g} median source spacings of {usual:.3g} ({needed} need only {reach:.3g})"
        )
    return max(reach, tiny), f"{needed} have a source so near (source spacings: {usual:.3g} median, {wide:.3g} wide)"


def _sample(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // SAMPLE))]


def positions(name: str, means: Tensor) -> Array:  # [N, 3] float64
    """The means in numpy; a ValueError names the first that is not finite."""
    points: Array = means.detach().cpu().double().numpy()
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(np.flatnonzero(~finite)[0])
        raise ValueError(
            f"{name}: expected finite positions, got NaN or infinity in row {row}; remove such Gaussians first"
        )
    return points
