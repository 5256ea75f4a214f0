"""Labelled positions that can be asked for the k nearest: exact order, ties included."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

Array = np.ndarray[Any, Any]


class Near(NamedTuple):
    """The sources looked at for n destinations, by distance, then by index."""

    distance: Array  # [n, k] float64, infinite where fewer than k are in range
    source: Array  # [n, k] int64, an index of `Sources`; 0 where there is none

    @property
    def hit(self) -> Array:  # [n, k] bool
        """Which columns hold a source."""
        return np.isfinite(self.distance)


class Sources:
    """A tree of distinct positions; of sources at one position the lowest index speaks, the others only disagree."""

    def __init__(self, points: Array, labels: Array) -> None:
        self.first, group = distinct(points)
        """Which of `points` each source is, ascending."""
        self.points = points[self.first]
        self.tree = cKDTree(self.points)
        self.labels = labels[self.first]
        self.mixed = np.zeros(len(self.first), dtype=bool)  # positions where sources disagree
        self.mixed[group[labels != self.labels[group]]] = True

    def __len__(self) -> int:
        return int(self.tree.n)

    def near(self, points: Array, k: int, distance: float) -> Near:
        """The k nearest sources **strictly** closer than `distance`; of equally near ones the lowest indices."""
        k = min(k, len(self))
        near, index = self._query(points, min(k + 1, len(self)), distance)  # one more shows whether the last is tied
        tied = np.flatnonzero(((near[:, 1:] == near[:, :-1]) & np.isfinite(near[:, 1:])).any(axis=1))
        wanted, columns = 2 * k, slice(0, k)
        while tied.size:  # scipy promises no order among equals: sort them; where the last is tied, look at more first
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
    """The lowest index at each distinct position, ascending, and for every point which of these is its own."""
    order = np.lexsort(points.T)  # stable: equal points keep their order
    ranked = points[order]
    new = np.ones(len(points), dtype=bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    first = np.sort(order[new])
    inverse = np.empty(len(points), dtype=np.int64)
    inverse[order] = np.searchsorted(first, order[new])[np.cumsum(new) - 1]
    return first, inverse


def neighbours_together(points: Array) -> Array:  # [N, 3] -> [N] int64
    """An order of points in which neighbours ask one after another: the tree answers twice as fast."""
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    cell = max(float(np.ptp(points, axis=0).max()) / 64, np.finfo(np.float64).tiny)
    order: Array = np.lexsort(np.floor((points - points.min(axis=0)) / cell).T)
    return order
