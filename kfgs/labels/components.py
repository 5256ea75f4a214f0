"""Number the connected parts of some Gaussians: the four chairs among all Gaussians of the class "chair"."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from .._arrays import Array
from ..gaussians import Gaussians
from .transfer import INSTANCE, positions, sampled

SPECK = 0.05  # parts smaller than this share of the largest are left out
NEIGHBOUR, QUANTILE = 4, 0.9  # a cloud's spacing: 90 % have their fourth neighbour within it
SPACINGS = 1.5  # the default distance in spacings of the selection: on room_0 2 joins the chairs, 1.2 breaks a sofa ...
MOST_SPACINGS = 4.0  # ... and its bound in spacings of the cloud: a few specks across a room have a spacing of metres


def part_distance(points: Array, whole: float) -> float:  # [n, 3] of a selection
    """The default distance of `number_parts`, in world units: 1.5 spacings of the points, at most 4 of the whole cloud.

    It keeps a thing in one piece, and things apart. No constant does: on room_0 0.08 m joins two chairs and breaks a sofa.
    """
    return min(SPACINGS * spacing(points), MOST_SPACINGS * whole) or 1.0  # all at one position: any distance joins them


def number_parts(gaussians: Gaussians, mask: Tensor, distance: float | None = None) -> Tensor:  # [N] int64
    """Number the parts of the Gaussians under a mask [N]; -1 lies outside it.

    With a column `instance` (whole numbers, 0 = none) and without a distance: the things that it says, a number less 1, so the
    second chair stays the second when the first is removed (things of several classes get numbers of their own). Otherwise
    two Gaussians are connected if their means are at most `distance` apart, directly or through others; 0 is the largest.
    """
    column, labels = np.asarray(gaussians.extra.get(INSTANCE, 0)), gaussians.labels
    ours = column.min(initial=0) == 0 < column.max(initial=0) < 2**24 and (column % 1 == 0).all()
    if distance is None and ours and labels is not None and bool(mask.any()):
        thing = torch.from_numpy(column.astype(np.int64)).to(mask.device)
        numbers = thing - 1 + (labels - labels[mask].min()) * (thing.max() + 1)
        return numbers.masked_fill(~mask | (thing < 1), -1)
    means = positions("gaussians.means", gaussians.means)
    points = means[mask.cpu().numpy()]
    parts = radius_components(points, distance or part_distance(points, spacing(means)))
    return torch.full(mask.shape, -1, device=mask.device).masked_scatter(mask, torch.from_numpy(parts).to(mask.device))


def radius_components(
    points: Array,  # [n, 3] float64
    distance: float,
) -> Array:  # [n] int64
    """Number the components of the graph that joins points at most `distance` apart; the largest first.

    Points in one cube with edges of a quarter of the distance count as one, at their mean: a dense cloud has too many pairs.
    """
    cell, places = cells(points, distance / 4)
    a, b = cKDTree(places).query_pairs(distance, output_type="ndarray").T
    edges = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(len(places), len(places)))
    return largest_first(connected_components(edges, directed=False)[1][cell])


def cells(points: Array, size: float) -> tuple[Array, Array]:  # [n, 3] -> [n] int64, [S, 3]
    """Which cube of a grid each point lies in, numbered from 0, and the mean of the points in each cube."""
    cubes = np.floor((points - points.min(axis=0, initial=np.inf)) / size)
    cell, count = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)[1:]
    cell = cell.ravel()
    sums = [np.bincount(cell, points[:, axis], len(count)) for axis in range(3)]
    return cell, np.stack(sums, axis=1) / count[:, None]


def largest_first(part: Array) -> Array:  # [n] -> [n] int64
    """Number parts by size, from 0; of two equally large ones, that with the first point comes first."""
    first, part, count = np.unique(part, return_index=True, return_inverse=True, return_counts=True)[1:]
    rank = np.empty(len(count), dtype=np.int64)
    rank[np.lexsort((first, -count))] = np.arange(len(count))
    return rank[part]


def spacing(points: Array) -> float:
    """The distance within which 90 % of the positions have their fourth neighbour (the last, if fewer); 0 for one position."""
    places = np.unique(points, axis=0)
    if len(places) < 2:
        return 0.0
    k = min(NEIGHBOUR, len(places) - 1)
    return float(np.quantile(cKDTree(places).query(sampled(places), k=[k + 1], workers=-1)[0], QUANTILE))
