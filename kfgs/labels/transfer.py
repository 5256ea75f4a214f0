"""Labels cross from the semantic field to the colour field by distance alone (Sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_range, check_shapes

NEIGHBOURS = 4  # looked at per destination, for ambiguity (and first of all for ties); 8 cost half as much again
CHUNK = 65_536  # destinations per query: 4 MB of neighbours at a time
SAMPLE = 20_000  # Gaussians measured for the default distance
COVERAGE = 0.995  # the default distance reaches this share of the destinations ...
NEAREST, FARTHEST = 2.0, 10.0  # ... but is no less and no more than so many source spacings

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source Gaussians to N destination Gaussians, and what became of the rest."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite where there is none
    sources: Tensor  # [N] int64, index of that source; -1 where there is none
    distance: float  # lambda, world units
    how: str  # where lambda comes from
    labelled: int  # destinations with a label
    orphaned: int  # destinations without: no labelled source in range
    ambiguous: int  # labelled ones with another label among their 4 nearest sources in range

    def __repr__(self) -> str:
        return (
            f"Transfer({self.labelled} labelled, {self.orphaned} orphaned, {self.ambiguous} ambiguous, "
            f"distance {self.distance:.4g}: {self.how})"
        )


def transfer_labels(
    src_means: Tensor,  # [S, 3]
    src_labels: Tensor,  # [S] int64, -1 = none
    dst_means: Tensor,  # [N, 3]
    distance: float | None = None,
) -> Transfer:
    """Give each destination the label of the nearest labelled source **strictly** closer than `distance`.

    The rule of Sec. 3.4, where `distance` is lambda. The paper does not say which label wins when several lie in range:
    here the nearest source does, and of equally near ones (as float64 distances) the lowest index. Sources with label -1
    take no part; they do not hide a labelled source behind them.

    Args:
        src_means: positions of the labelled (semantic) Gaussians.
        src_labels: their labels.
        dst_means: positions of the Gaussians to label (the colour field).
        distance: lambda in world units; None takes `default_distance`.

    Returns:
        Labels, distances and sources on the destinations' device, with counts. Without any labelled source everything
        is orphaned.

    Raises:
        ValueError: if shapes disagree, a position is not finite, a label is below -1, or the distance is not positive.
        TypeError: if the labels are not integers.

    Note:
        600,000 destinations and 100,000 sources take about a second on two cores (scipy's k-d tree).
    """
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if src_labels.dtype.is_floating_point or src_labels.dtype in (torch.bool, torch.complex64):
        raise TypeError(f"src_labels: expected integer labels, got {src_labels.dtype}; convert them with .long()")
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    src, dst = _positions("src_means", src_means), _positions("dst_means", dst_means)
    labels = src_labels.detach().cpu().numpy().astype(np.int64)
    if labels.size and labels.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {labels.min()}; map other codes to -1 first")
    kept = np.flatnonzero(labels >= 0)
    if kept.size == 0:
        chosen, how = (0.0, "no labelled source") if distance is None else (float(distance), "given")
        return _report(_Found.nothing(len(dst)), labels, dst_means, chosen, how)
    sources = _Sources(src[kept], labels[kept])
    chosen, how = _default_distance(sources.tree, dst) if distance is None else (float(distance), "given")
    found = sources.nearest(dst, chosen)
    some = found.source >= 0
    found.source[some] = kept[sources.first[found.source[some]]]
    return _report(found, labels, dst_means, chosen, how)


def default_distance(
    src_means: Tensor,  # [S, 3]
    dst_means: Tensor,  # [N, 3]
) -> float:
    """A lambda for two clouds, in world units: it scales with the scene.

    The distance within which 99.5 % of the destinations have a source, but no less than 2 and no more than 10 times the
    sources' median spacing (distance to the nearest other source). The upper bound keeps floaters and background, which
    only the colour field has, from taking labels across the room; the lower one lets a destination that lies between two
    sources reach both. A cloud with one source position has no spacing, and the 99.5 % quantile stands alone.
    Measured on an evenly strided sample of at most 20,000 Gaussians of each cloud.

    Raises:
        ValueError: if a cloud is empty or a position is not finite.
    """
    check_shapes(("src_means", src_means, "S 3"), ("dst_means", dst_means, "N 3"))
    src, dst = _positions("src_means", src_means), _positions("dst_means", dst_means)
    for name, points in (("src_means", src), ("dst_means", dst)):
        if len(points) == 0:
            raise ValueError(f"{name}: expected at least one Gaussian, got none; pass the distance yourself")
    return _default_distance(cKDTree(src[_distinct(src)[0]]), dst)[0]


def _default_distance(tree: cKDTree, dst: Array) -> tuple[float, str]:
    """`default_distance` on a tree of distinct positions, with one line that explains it."""
    tiny = 1e-6 * max(1.0, float(np.abs(tree.maxes).max()), float(np.abs(tree.mins).max()))
    if len(dst) == 0:
        return tiny, "no destinations"
    reach = float(np.quantile(tree.query(_sample(dst), workers=-1)[0], COVERAGE))
    if tree.n == 1:
        return max(1.01 * reach, tiny), f"{COVERAGE:.1%} of destinations within {reach:.4g} of the one source position"
    spacing = float(np.median(np.asarray(tree.query(_sample(np.asarray(tree.data)), k=2, workers=-1)[0])[:, 1]))
    chosen = min(max(reach, NEAREST * spacing), FARTHEST * spacing)
    return max(chosen, tiny), (
        f"{COVERAGE:.1%} of destinations lie within {reach:.4g}, "
        f"kept between {NEAREST:g} and {FARTHEST:g} source spacings of {spacing:.4g}"
    )


class _Found(NamedTuple):
    distance: Array  # [N] infinite where there is none
    source: Array  # [N] -1 where there is none
    ambiguous: Array  # [N] bool

    @staticmethod
    def nothing(n: int) -> _Found:
        return _Found(np.full(n, np.inf), np.full(n, -1, dtype=np.int64), np.zeros(n, dtype=bool))


class _Sources:
    """A tree of distinct positions; of sources at one position the lowest index speaks, the others only disagree."""

    def __init__(self, points: Array, labels: Array) -> None:
        self.first, group = _distinct(points)
        self.tree = cKDTree(points[self.first])
        self.labels = labels[self.first]
        self.mixed = np.zeros(len(self.first), dtype=bool)
        self.mixed[group[labels != self.labels[group]]] = True

    def nearest(self, dst: Array, distance: float) -> _Found:
        found = _Found.nothing(len(dst))
        if len(dst) == 0:
            return found
        cell = max(float(np.ptp(dst, axis=0).max()) / 64, np.finfo(np.float64).tiny)
        order = np.lexsort(np.floor((dst - dst.min(axis=0)) / cell).T)  # neighbours ask one after another: 2 x faster
        for start in range(0, len(dst), CHUNK):
            self._fill(found, dst, order[start : start + CHUNK], distance)
        return found

    def _fill(self, found: _Found, dst: Array, rows: Array, distance: float) -> None:
        k = min(NEIGHBOURS, self.tree.n)
        near, index = self._query(dst[rows], k, distance)
        hit = near < distance  # scipy's bound is strict too, on squares; a miss is infinite, with index n
        rows, near, index, hit = (values[hit[:, 0]] for values in (rows, near, index, hit))
        index[~hit] = 0
        found.distance[rows], found.source[rows] = near[:, 0], index[:, 0]
        label = self.labels[index]
        found.ambiguous[rows] = (hit & ((label != label[:, :1]) | self.mixed[index])).any(axis=1)
        tied = hit[:, 1:2].any(axis=1) & (near[:, 1:2] == near[:, :1]).any(axis=1)
        rows = rows[tied]
        while rows.size:  # scipy promises no order among equals: take the lowest; where all k are equal, look at more
            near, index = self._query(dst[rows], k, distance)
            equal = (near == near[:, :1]) & (near < distance)
            found.source[rows] = np.where(equal, index, self.tree.n).min(axis=1)
            rows = rows[equal.all(axis=1)] if k < self.tree.n else rows[:0]
            k = min(2 * k, self.tree.n)

    def _query(self, points: Array, k: int, distance: float) -> tuple[Array, Array]:
        near, index = self.tree.query(points, k=k, distance_upper_bound=distance, workers=-1)
        return np.reshape(near, (len(points), k)), np.reshape(index, (len(points), k))


def _distinct(points: Array) -> tuple[Array, Array]:
    """The lowest index at each distinct position, ascending, and for every point which of these is its own."""
    order = np.lexsort(points.T)  # stable: equal points keep their order
    ranked = points[order]
    new = np.ones(len(points), dtype=bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    first = np.sort(order[new])
    inverse = np.empty(len(points), dtype=np.int64)
    inverse[order] = np.searchsorted(first, order[new])[np.cumsum(new) - 1]
    return first, inverse


def _sample(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // SAMPLE))]


def _positions(name: str, means: Tensor) -> Array:
    points: Array = means.detach().cpu().double().numpy()
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(np.flatnonzero(~finite)[0])
        raise ValueError(
            f"{name}: expected finite positions, got NaN or infinity in row {row}; remove such Gaussians first"
        )
    return points


def _report(found: _Found, src_labels: Array, dst_means: Tensor, distance: float, how: str) -> Transfer:
    some = found.source >= 0
    labels = np.full(len(some), -1, dtype=np.int64)
    labels[some] = src_labels[found.source[some]]
    labelled = int(some.sum())
    device = dst_means.device
    return Transfer(
        labels=torch.from_numpy(labels).to(device),
        distances=torch.from_numpy(found.distance).to(device, dst_means.dtype),
        sources=torch.from_numpy(found.source).to(device),
        distance=distance,
        how=how,
        labelled=labelled,
        orphaned=len(found.source) - labelled,
        ambiguous=int(found.ambiguous.sum()),
    )
