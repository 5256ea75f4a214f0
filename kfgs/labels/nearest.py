"""Find the nearest labelled Gaussians, and lambda, the distance within which a label is carried over (Sec. 3.4)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes
from .._origin import recounted, to_world
from .._rows import check_finite
from ..formats.splat_file import SplatFile
from ..gaussians import Gaussians

SAMPLE = 20_000  # Gaussians measured
COVERAGE = 0.995  # lambda reaches this share of the destinations ...
NEAREST = 2.0  # ... but is at least this many median spacings of the sources ...
FARTHEST = 10.0  # ... and at most this many wide spacings,
WIDE = 0.9  # which are this quantile of the spacings

Array = np.ndarray[Any, Any]
Cloud = Tensor | Array | Gaussians | SplatFile
"""Positions [N, 3], Gaussians, or a splat. Positions are counted from the origin of the Gaussians that they meet."""


class Near(NamedTuple):
    """The nearest sources of n destinations, by distance, then by index."""

    distance: Array  # [n, k] float64, infinite after the last source in range
    source: Array  # [n, k] int64, an index into `Sources`; 0 if there is none

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def hit(self) -> Array:  # [n, k] bool
        """Which columns hold a source."""
        return np.isfinite(self.distance)


class Sources:
    """A tree of distinct labelled positions. Of sources at one position only the one with the lowest index gives a label."""

    def __init__(self, points: Array, labels: Array) -> None:
        self.first, group = distinct(points)
        """Which of `points` each source is, ascending."""
        self.points = points[self.first]
        self.tree = cKDTree(self.points)
        self.labels = labels[self.first]
        self.mixed = np.zeros(len(self.first), dtype=bool)  # positions with sources of different labels
        self.mixed[group[labels != self.labels[group]]] = True

    def __len__(self) -> int:
        return int(self.tree.n)

    def near(self, points: Array, k: int, distance: float) -> Near:
        """The k nearest sources **strictly** closer than `distance`; of equally near ones the lowest indices."""
        k = min(k, len(self))
        near, index = self._query(points, min(k + 1, len(self)), distance)  # one more shows whether the last is tied
        tied = np.flatnonzero(((near[:, 1:] == near[:, :-1]) & np.isfinite(near[:, 1:])).any(axis=1))
        wanted, columns = 2 * k, slice(0, k)
        while tied.size:  # scipy returns equals in any order: sort them; if the last is tied, query more first
            more, which = self._query(points[tied], min(wanted, len(self)), distance)
            order = np.lexsort((which, more), axis=1)[:, columns]
            near[tied, columns] = np.take_along_axis(more, order, axis=1)
            index[tied, columns] = np.take_along_axis(which, order, axis=1)
            last = more[:, -1]
            open_ = (last == near[tied, k - 1]) & np.isfinite(last) & (more.shape[1] < len(self))
            tied, wanted = tied[open_], 2 * wanted
        return Near(near[:, columns], np.where(np.isfinite(near), index, 0)[:, columns])

    def _query(self, points: Array, k: int, distance: float) -> tuple[Array, Array]:
        near, index = self.tree.query(points, k=k, distance_upper_bound=distance, workers=-1)
        near, index = np.reshape(near, (len(points), k)), np.reshape(index, (len(points), k))
        near[near >= distance] = np.inf  # scipy compares squares, which rounds otherwise
        return near, index


def distinct(points: Array) -> tuple[Array, Array]:
    """The lowest index at each distinct position, ascending, and for every point its place in that list."""
    order = np.lexsort(points.T)  # stable: equal points keep their order
    ranked = points[order]
    new = np.ones(len(points), dtype=bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    first = np.sort(order[new])
    inverse = np.empty(len(points), dtype=np.int64)
    inverse[order] = np.searchsorted(first, order[new])[np.cumsum(new) - 1]
    return first, inverse


def neighbours_together(points: Array) -> Array:  # [N, 3] -> [N] int64
    """An order in which neighbours follow each other: queries of a tree in this order are twice as fast."""
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    cell = max(float(np.ptp(points, axis=0).max()) / 64, np.finfo(np.float64).tiny)
    order: Array = np.lexsort(np.floor((points - points.min(axis=0)) / cell).T)
    return order


def default_distance(
    src: Cloud,  # [S, 3] means, Gaussians or a splat
    dst: Cloud,  # [N, 3] means, Gaussians or a splat
) -> float:
    """Lambda for two clouds, in world units. The paper gives no value for it.

    The distance within which 99.5 % of the destinations have a source, but at least 2 median spacings of the sources (a
    spacing is the distance to the nearest other source) and at most 10 times the 90 % quantile of the spacings. With the
    lower bound a destination between two sources reaches both. The upper bound keeps floaters and background, which only
    the colour field has, from taking labels across the room; it uses a quantile because a few large Gaussians fill a wall.
    With a single source position there are no spacings, and only the 99.5 % count. Measured on an evenly strided sample
    of at most 20,000 Gaussians of each cloud.

    Raises:
        ValueError: if a cloud is empty or a position is not finite.
    """
    src_means, dst_means = means_of("src", src), means_of("dst", dst, src)
    check_shapes(("src_means", src_means, "S 3"), ("dst_means", dst_means, "N 3"))
    places, targets = positions("src_means", src_means), positions("dst_means", dst_means)
    for name, points in (("src_means", places), ("dst_means", targets)):
        if len(points) == 0:
            raise ValueError(f"{name}: expected at least one Gaussian, got none; pass the distance yourself")
    return explained_distance(cKDTree(places[distinct(places)[0]]), targets)[0]


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
    return max(reach, tiny), f"{needed} have a source within it (source spacings: {usual:.3g} median, {wide:.3g} wide)"


def _sample(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // SAMPLE))]


def places_of(name: str, cloud: Cloud) -> Tensor:  # [N, 3] in the world
    """The positions of a splat or of Gaussians in the world, or positions as given."""
    gaussians = cloud.gaussians if isinstance(cloud, SplatFile) else cloud
    means = means_of(name, gaussians)
    return to_world(means, gaussians.origin) if isinstance(gaussians, Gaussians) else means


def means_of(name: str, cloud: Cloud, like: Cloud | None = None) -> Tensor:  # [N, 3]
    """The positions of a splat or of Gaussians, counted from the origin of `like` if both have one; or positions as given."""
    gaussians, other = (one.gaussians if isinstance(one, SplatFile) else one for one in (cloud, like))
    if not isinstance(gaussians, Gaussians):
        return as_tensor(name, gaussians)
    origin = other.origin if isinstance(other, Gaussians) else gaussians.origin
    return recounted(gaussians.means, gaussians.origin, origin)


def positions(name: str, means: Tensor) -> Array:  # [N, 3] float64
    """The means in numpy; a ValueError names the first that is not finite."""
    check_finite(name, means)
    points: Array = means.detach().cpu().double().numpy()
    return points
