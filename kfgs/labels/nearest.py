"""Find the nearest labelled Gaussians, and lambda, the distance within which a label is carried over (Sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import as_tensor, check_range, check_shapes
from .._rows import check_finite

NEIGHBOURS = 4  # sources that are checked for ambiguity; 8 take half as long again
CHUNK = 16_384  # destinations at a time
SAMPLE = 20_000  # Gaussians measured for lambda
COVERAGE = 0.995  # lambda reaches this share of the destinations ...
NEAREST = 2.0  # ... but is at least this many median spacings of the sources ...
FARTHEST = 10.0  # ... and at most this many wide spacings,
WIDE = 0.9  # which are this quantile of the spacings

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source positions to N destinations."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite if there is none
    sources: Tensor  # [N] int64, index of that source; -1 if there is none
    disagree: Tensor  # [N] bool, labelled, but with another label among the 4 nearest sources in range
    distance: float  # lambda, the distance within which a label is carried over, world units
    how: str  # how lambda was found

    @property
    def labelled(self) -> int:
        """The number of destinations with a label."""
        return int((self.labels >= 0).sum())

    @property
    def orphaned(self) -> int:
        """The number of destinations without a label: no labelled source in range."""
        return len(self.labels) - self.labelled

    @property
    def ambiguous(self) -> int:
        """The number of labelled destinations whose nearest sources disagree."""
        return int(self.disagree.sum())

    @property
    def scores(self) -> Tensor:  # [N] in [0, 1]
        """How sure each label is: 1 - distance / lambda; 0 without a label."""
        reach = max(self.distance, torch.finfo(self.distances.dtype).tiny)
        return (1 - self.distances / reach).clamp_min(0.0)

    def __repr__(self) -> str:
        return (
            f"Transfer({self.labelled:,} of {len(self.labels):,} labelled (nearest within {self.distance:.4g}), "
            f"{self.orphaned:,} orphaned, {self.ambiguous:,} ambiguous; lambda: {self.how})"
        )


def nearest_labels(
    src_means: Tensor | Array,  # [S, 3]
    src_labels: Tensor | Array,  # [S] int64, -1 = none
    dst_means: Tensor | Array,  # [N, 3]
    distance: float | None = None,
) -> Transfer:
    """Give each destination the label of the nearest labelled source **strictly** closer than `distance`.

    The rule of Sec. 3.4; `distance` is its lambda, in world units (None: `default_distance`). The paper does not say which
    label wins if several are in range: here the nearest does. Of equally near sources (as float64 distances), the one with
    the lowest index gives its label. Both clouds are counted from the same origin.

    Raises:
        ValueError: if shapes disagree, a position is not finite, a label is below -1, or the distance is not positive.
        TypeError: if the labels are not integers.
    """
    src_means, dst_means = as_tensor("src_means", src_means), as_tensor("dst_means", dst_means)
    src_labels = as_tensor("src_labels", src_labels)
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if src_labels.is_floating_point() or src_labels.dtype == torch.bool:
        raise TypeError(f"src_labels: expected integer labels, got {src_labels.dtype}; convert them with .long()")
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    given: Array = src_labels.detach().cpu().numpy().astype(np.int64)
    if given.size and given.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {given.min()}; map other codes to -1 first")
    points, targets = positions("src_means", src_means), positions("dst_means", dst_means)
    n, kept = len(targets), np.flatnonzero(given >= 0)
    labels, winners, distances = np.full(n, -1), np.full(n, -1), np.full(n, np.inf)
    disagree = np.zeros(n, dtype=np.bool_)
    chosen, how = (0.0, "no labelled source") if distance is None else (float(distance), "given")
    if kept.size:
        sources = Sources(points[kept], given[kept])
        if distance is None:
            chosen, how = explained_distance(sources.tree, targets)
        order = neighbours_together(targets)
        for rows in (order[start : start + CHUNK] for start in range(0, n, CHUNK)):
            near, index = sources.near(targets[rows], NEIGHBOURS, chosen)
            hit, label = np.isfinite(near), sources.labels[index]
            winner, some = index[:, 0], hit[:, 0]
            distances[rows] = near[:, 0]
            labels[rows] = np.where(some, label[:, 0], -1)
            winners[rows] = np.where(some, kept[sources.first[winner]], -1)
            disagree[rows] = (hit & ((label != label[:, :1]) | sources.mixed[index])).any(axis=1)
    return Transfer(
        labels=torch.from_numpy(labels).to(dst_means.device),
        distances=torch.from_numpy(distances).to(dst_means),
        sources=torch.from_numpy(winners).to(dst_means.device),
        disagree=torch.from_numpy(disagree).to(dst_means.device),
        distance=chosen,
        how=how,
    )


class Sources:
    """A tree of distinct labelled positions. Of sources at one position only the one with the lowest index gives a label."""

    def __init__(self, points: Array, labels: Array) -> None:
        self.first, group = distinct(points)
        """Which of `points` each source is, ascending."""
        self.tree = cKDTree(points[self.first])
        self.labels = labels[self.first]
        self.mixed = np.zeros(len(self.first), dtype=bool)  # positions with sources of different labels
        self.mixed[group[labels != self.labels[group]]] = True

    def __len__(self) -> int:
        return int(self.tree.n)

    def near(self, points: Array, k: int, distance: float) -> tuple[Array, Array]:  # [n, k] float64, [n, k] int64
        """Distance and index of the k nearest sources **strictly** closer than `distance`; of equals the lowest indices.

        After the last source in range, distances are infinite and indices 0.
        """
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
        return near[:, columns], np.where(np.isfinite(near), index, 0)[:, columns]

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
    src_means: Tensor,  # [S, 3]
    dst_means: Tensor,  # [N, 3] counted from the same origin
) -> float:
    """Lambda for two clouds, in world units. The paper gives no value for it.

    The distance within which 99.5 % of the destinations have a source, but at least 2 median spacings of the sources (a
    spacing is the distance to the nearest other source), so that a destination between two sources reaches both. And at
    most 10 times the 90 % quantile of the spacings, so that floaters and background, which only the colour field has, take
    no labels across the room. Measured on an evenly strided sample of at most 20,000 Gaussians of each cloud.

    Raises:
        ValueError: if a cloud is empty or a position is not finite.
    """
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


def positions(name: str, means: Tensor) -> Array:  # [N, 3] float64
    """The means in numpy; a ValueError names the first that is not finite."""
    check_finite(name, means)
    points: Array = means.detach().cpu().double().numpy()
    return points
