"""Number the connected parts of some Gaussians: the four chairs among all Gaussians of the class "chair"."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from .._arrays import Array
from .transfer import positions, sampled

NEIGHBOURS = 8  # nearest neighbours of each point that are joined first
NEIGHBOUR, QUANTILE = 4, 0.9  # a cloud's spacing: 90 % have their fourth neighbour within it
SPACINGS = 1.5  # the default distance in spacings of the selection: on room_0 2 joins the chairs, 1.2 breaks a sofa ...
MOST_SPACINGS = 4.0  # ... and its bound in spacings of the cloud: a few specks across a room have a spacing of metres


def part_distance(means: Tensor, mask: Tensor) -> float:  # [N, 3], [N] bool
    """The default distance of `number_parts`, in world units: 1.5 spacings of the masked Gaussians, at most 4 of all.

    It keeps a thing in one piece, and things apart. No constant does: on room_0 0.08 m joins two chairs and breaks a sofa.
    """
    points = positions("means", means)
    own, whole = _spacing(points[mask.cpu().numpy()]), _spacing(points)
    return min(SPACINGS * own, MOST_SPACINGS * whole) or 1.0  # all at one position: any distance joins them


def number_parts(
    means: Tensor,  # [N, 3]
    mask: Tensor,  # [N] bool
    distance: float | None = None,
) -> Tensor:  # [N] int64
    """Number the connected parts of the Gaussians under a mask: 0 is the largest, -1 lies outside the mask.

    Two Gaussians are connected if their means are at most `distance` apart, directly or through others under the mask. Of
    equally large parts the one with the lowest index comes first. 600,000 Gaussians take about 5 seconds on one core.
    """
    points = positions("means", means)[mask.cpu().numpy()]
    parts = radius_components(points, distance or part_distance(means, mask))
    numbers = torch.full(mask.shape, -1, device=mask.device)
    numbers[mask] = torch.from_numpy(parts).to(mask.device)
    return numbers


def radius_components(
    points: Array,  # [n, 3] float64
    distance: float,
) -> Array:  # [n] int64
    """Number the components of the graph that joins points at most `distance` apart, exactly; the largest first.

    `cKDTree.query_pairs` would list all near pairs: gigabytes for a dense cloud. Here each point is joined to its 8
    nearest. If a pair is left out, both points have more than 8 neighbours in range. For these points the nearest point
    of another part is searched, until none is in range: each binary digit of the parts' numbers divides them into two
    sets, and two different numbers differ in some digit.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    places, place = np.unique(points, axis=0, return_inverse=True)  # sorted, so that queries of neighbours follow
    n, k = len(places), min(NEIGHBOURS + 1, len(places))
    near, index = (np.reshape(part, (n, k)) for part in _nearest_within(places, places, distance, k))
    hit = near <= distance
    part = _united(n, np.repeat(np.arange(n), k)[hit.ravel()], index[hit])
    crowded = np.flatnonzero(hit.all(axis=1)) if k < n else np.empty(0, dtype=np.int64)
    while True:
        numbers = np.unique(part[crowded], return_inverse=True)[1]
        links = [np.empty((2, 0), dtype=np.int64)]
        for digit in range(int(numbers.max(initial=0)).bit_length()):
            side = (numbers >> digit) & 1 == 1
            few, many = sorted((crowded[side], crowded[~side]), key=len)
            near, index = _nearest_within(places[few], places[many], distance)
            hit = near <= distance
            links.append(np.stack([many[hit], few[index[hit]]]))
        joined = np.concatenate(links, axis=1)
        if joined.shape[1] == 0:
            break
        part = _united(int(part.max()) + 1, *part[joined])[part]
    part = part[place.ravel()]
    first, count = np.unique(part, return_index=True, return_counts=True)[1:]
    rank = np.empty(len(count), dtype=np.int64)
    rank[np.lexsort((first, -count))] = np.arange(len(count))  # by size, then by the lowest point
    return rank[part]


def _spacing(points: Array) -> float:
    """The distance within which 90 % of the positions have their fourth neighbour (the last, if fewer); 0 for one position."""
    places = np.unique(points, axis=0)
    if len(places) < 2:
        return 0.0
    k = min(NEIGHBOUR, len(places) - 1)
    return float(np.quantile(cKDTree(places).query(sampled(places), k=[k + 1], workers=-1)[0], QUANTILE))


def _nearest_within(points: Array, queries: Array, distance: float, k: int = 1) -> tuple[Array, Array]:
    """Distance and index of the k nearest points; farther than `distance` is infinite."""
    reach = distance * (1 + 1e-9)  # scipy's bound is strict, ours is not
    near, index = cKDTree(points).query(queries, k=k, distance_upper_bound=reach, workers=-1)
    return np.asarray(near), np.asarray(index)


def _united(n: int, a: Array, b: Array) -> Array:
    edges = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(n, n))
    return np.asarray(connected_components(edges, directed=False)[1])
