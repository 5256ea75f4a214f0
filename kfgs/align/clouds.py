"""Helpers of all alignments: the bulk of a cloud, its spacing, nearest points, rotations and robust weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..cameras.bounds import robust_bounds
from ..cameras.similarity import Similarity

Array = np.ndarray[Any, Any]

SAMPLE = 20_000  # points of each cloud that are measured


def bulk(name: str, points: Tensor, sample: int = SAMPLE) -> Array:
    """The points within robust bounds as float64, thinned to about `sample`, without duplicates.

    Raises:
        ValueError: if a position is not finite, or there are fewer than two points.
    """
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
    return np.unique(kept[:: max(1, len(kept) // sample)], axis=0)  # without duplicates, so that the spacing is not 0


def median_spacing(tree: cKDTree) -> float:
    """Median distance from a point to the nearest other one."""
    return float(np.median(nearest(tree, np.asarray(tree.data)[:: max(1, tree.n // 5_000)], k=2)[0][:, 1]))


def nearest(tree: cKDTree, places: Array, k: int = 1) -> tuple[Array, Array]:
    """Distances and indices of the k nearest points, [N] each, or [N, k] for more than one."""
    distances, indices = tree.query(places, k=k, workers=1)
    return np.asarray(distances), np.asarray(indices)


def robust_weights(squares: Array, width: float) -> Array:
    """Weights of squared distances (Geman-McClure): 1 at 0, a quarter at `width`, almost none far away."""
    weights: Array = (width**2 / (width**2 + squares)) ** 2
    return weights


def nearest_rotation(matrix: Array) -> Array:  # [3, 3]
    """The rotation nearest to a matrix; of a sum of rotations, their mean."""
    U, _, Vt = np.linalg.svd(matrix)
    rotation: Array = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return rotation


def to_similarity(scale: float, rotation: Array, translation: Array) -> Similarity:
    """A `Similarity` from numpy arrays."""
    return Similarity(float(scale), torch.from_numpy(np.array(rotation)), torch.from_numpy(np.array(translation)))
