"""Exact connected components of points within a distance of each other, in bounded memory however dense they lie.

The graph with an edge for every near pair does not fit in memory where Gaussians pile up. So three steps give the same
components: points of one cell, whose diagonal is the distance, hang together; each point is joined to its 8 nearest in
range; and what is then still apart although it lies in neighbouring cells is compared point by point. Only points with
more than 8 others in range take part in the last step: the others have met all they can reach.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

NEIGHBOURS = 8
BLOCK = 4_000_000  # point pairs compared at once: 96 MB of coordinates

Array = np.ndarray[Any, Any]


def radius_components(
    points: Array,  # [n, 3] float64
    distance: float,
) -> Array:  # [n] int64
    """Number the components of the graph that joins points at most `distance` apart.

    Numbers follow size, the largest is 0; of equal ones, that with the lowest point.
    """
    n = len(points)
    if n == 0:
        return np.zeros(0, dtype=np.int64)
    first, cell, keys, steps = _cells(points, distance)
    k = min(NEIGHBOURS + 1, n)
    reach = distance * (1 + 1e-9)  # scipy's bound is strict, ours is not
    found = cKDTree(points).query(points, k=k, distance_upper_bound=reach, workers=-1)
    near, index = (np.reshape(part, (n, k)) for part in found)
    hit = near <= distance
    a, b = np.repeat(np.arange(n), k)[hit.ravel()], index.ravel()[hit.ravel()]
    part = _united(n, np.concatenate([a, np.arange(n)]), np.concatenate([b, first[cell]]))
    cut_short = np.flatnonzero(hit.all(axis=1)) if k <= n - 1 else np.empty(0, dtype=np.int64)
    links = _links(points, distance, part, cut_short, cell, keys, steps)
    part = _united(int(part.max()) + 1, part[links[0]], part[links[1]])[part]
    return _by_size(part)


def _cells(points: Array, distance: float) -> tuple[Array, Array, Array, Array]:
    """The first point of each occupied cell, each point's cell, the cells' sorted keys, and the keys' steps per axis."""
    edge = distance / np.sqrt(3) * (1 - 1e-9)  # a cell's diagonal is the distance
    place = np.floor((points - points.min(axis=0)) / edge)
    size = place.max(axis=0) + 5  # two empty cells on either side, so that a step never wraps around
    if float(np.prod(size)) > 2**62:  # more cells than keys: far outliers; number the occupied planes instead
        place = np.stack([_packed(column) for column in place.T], axis=1)
        size = place.max(axis=0) + 5
    sizes = size.astype(np.int64)
    steps = np.array([sizes[1] * sizes[2], sizes[2], 1])
    keys, first, cell = np.unique((place.astype(np.int64) + 2) @ steps, return_index=True, return_inverse=True)
    return first, cell.ravel(), keys, steps


def _packed(column: Array) -> Array:
    """The same order of cells along one axis, with gaps of more than two cells closed to three."""
    values, inverse = np.unique(column, return_inverse=True)
    closed: Array = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(values), 3))])
    return closed[inverse.ravel()]


def _links(
    points: Array, distance: float, part: Array, rows: Array, cell: Array, keys: Array, steps: Array
) -> tuple[Array, Array]:
    """Pairs of `rows` of different parts, in cells up to two apart, that lie within the distance."""
    rows = rows[np.argsort(cell[rows], kind="stable")]
    used, start, count = np.unique(cell[rows], return_index=True, return_counts=True)
    found: list[tuple[Array, Array]] = [(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))]
    for step in product(range(-2, 3), repeat=3):
        if step <= (0, 0, 0) or len(used) == 0:  # each pair of cells once
            continue
        wanted = keys[used] + np.dot(step, steps)
        other = np.minimum(np.searchsorted(keys[used], wanted), len(used) - 1)
        one = np.flatnonzero((keys[used][other] == wanted) & (part[rows[start]] != part[rows[start[other]]]))
        found += _compared(points, distance, rows, (start[one], count[one]), (start[other[one]], count[other[one]]))
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


def _compared(
    points: Array, distance: float, rows: Array, left: tuple[Array, Array], right: tuple[Array, Array]
) -> list[tuple[Array, Array]]:
    """One near pair of points for each pair of cells that has one; a cell is a run (start, count) of `rows`."""
    found = []
    many = left[1] * right[1]
    for i in np.flatnonzero(many > BLOCK):
        a, b = (rows[side[0][i] : side[0][i] + side[1][i]] for side in (left, right))
        near, index = (np.atleast_1d(part) for part in cKDTree(points[b]).query(points[a]))
        best = int(np.argmin(near))
        if near[best] <= distance:
            found.append((a[best : best + 1], b[index[best : best + 1]]))
    few = np.flatnonzero(many <= BLOCK)
    block = np.cumsum(many[few]) // BLOCK
    for which in np.split(few, np.flatnonzero(np.diff(block)) + 1):
        pair = np.repeat(which, many[which])
        nth = np.arange(len(pair)) - np.repeat(np.cumsum(many[which]) - many[which], many[which])
        a = rows[left[0][pair] + nth // right[1][pair]]
        b = rows[right[0][pair] + nth % right[1][pair]]
        close = ((points[a] - points[b]) ** 2).sum(axis=1) <= distance**2
        kept = np.unique(pair[close], return_index=True)[1]
        found.append((a[close][kept], b[close][kept]))
    return found


def _united(n: int, a: Array, b: Array) -> Array:
    edges = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(n, n))
    labels: Array = connected_components(edges, directed=False)[1]
    return labels


def _by_size(part: Array) -> Array:
    """Number the parts by size, then by their lowest point."""
    first, count = np.unique(part, return_index=True, return_counts=True)[1:]
    rank = np.empty(len(count), dtype=np.int64)
    rank[np.lexsort((first, -count))] = np.arange(len(count))
    return rank[part]
