"""Many rough alignments of two clouds at once: starts from all rotations, improved together on a lookup grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .._card import short_repr
from .clouds import Array, nearest, robust_weights

GRID = 40  # cells along a side of the lookup grid: 64,000 nearest points, found once in a tenth of a second
REACH = 2.6  # half a side of the grid, in radii of the cloud
STEPS, FIRST, KEPT = 14, 7, 4  # steps; after the first 7 only the best quarter (1 in 4) continues
WIDE, NARROW = 0.5, 0.08  # in radii: the distance at which a pair has weight 1/4, in the first and the last step
BLOCK = 200  # starts that are improved at a time


class Moves(NamedTuple):
    """A stack of similarities between clouds of radius 1 about 0."""

    rotations: Array  # [S, 3, 3]
    scales: Array  # [S]
    translations: Array  # [S, 3]

    def __repr__(self) -> str:
        return short_repr(self)

    @staticmethod
    def of(rotations: Array, scales: Sequence[float]) -> Moves:
        """Every rotation with every scale, about the centre."""
        turned = np.repeat(rotations, len(scales), axis=0)
        return Moves(turned, np.tile(np.asarray(scales, dtype=float), len(rotations)), np.zeros((len(turned), 3)))


def spread_rotations(count: int) -> Array:  # [count, 3, 3]
    """Rotations that cover all rotations evenly (super-Fibonacci spirals, Alexa 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quats = np.stack([inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=1)
    matrices: Array = Rotation.from_quat(quats).as_matrix()
    return matrices


def principal_axes(x: Array, y: Array) -> Array:  # [4, 3, 3]
    """The four rotations that lay the principal axes of one cloud on those of the other."""
    U, V = (np.linalg.eigh(np.cov(points.T))[1] for points in (x, y))
    U, V = U * np.sign(np.linalg.det(U)), V * np.sign(np.linalg.det(V))
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return np.stack([V @ np.diag(sign) @ U.T for sign in signs])


def thin(points: Array, count: int, rng: np.random.Generator) -> Array:
    """About `count` points, evenly over the surface: the means of the cells of a grid, whose cell size is found by bisection."""
    if len(points) <= count:
        return points
    low, size = points.min(0), float(np.ptp(points, axis=0).max())
    fine, coarse = 0.0, size
    cells = points
    for _ in range(12):
        cell = (fine + coarse) / 2
        key = np.floor((points - low) / cell).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
        _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
        if len(counts) > count:
            fine = cell
        else:
            coarse = cell
        if 0.9 * count < len(counts) <= 1.1 * count:
            break
    cells = np.stack([np.bincount(inverse, points[:, k]) for k in range(3)], axis=1) / counts[:, None]
    return cells if len(cells) <= count else cells[rng.permutation(len(cells))[:count]]


class _Lookup:
    """The nearest point of a cloud, to within a cell of a grid."""

    def __init__(self, points: Array) -> None:
        self.points = points
        axis = (np.arange(GRID) + 0.5) / GRID * 2 * REACH - REACH
        places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        self.nearest = nearest(cKDTree(points), places)[1].astype(np.int32)

    def __call__(self, places: Array) -> Array:  # [..., 3] -> [..., 3]
        cell = np.clip(((places + REACH) * (GRID / (2 * REACH))).astype(np.int32), 0, GRID - 1)
        found: Array = self.points[self.nearest[(cell[..., 0] * GRID + cell[..., 1]) * GRID + cell[..., 2]]]
        return found


def improve_on_grid(
    x: Array,  # [n, 3] radius 1 about 0
    y: Array,  # [m, 3] the same
    moves: Moves,
    count: int,
    rng: np.random.Generator,
) -> tuple[Moves, Array]:
    """Improve every start by pairs of nearest points, both ways, that count less the farther they are apart; score the results.

    Returns:
        The improved moves from x to y and their scores in [0, 1]: how much of either cloud lies on the other.
    """
    to_x, to_y = _Lookup(x.astype(np.float32)), _Lookup(y.astype(np.float32))
    p, q = (cloud[rng.permutation(len(cloud))[:count]].astype(np.float32) for cloud in (x, y))
    scores = np.zeros(0)
    for widths in np.split(np.geomspace(WIDE, NARROW, STEPS), [FIRST]):
        if len(scores):  # the second half of the steps is for the best starts only
            moves = Moves(*(part[np.argsort(-scores)[: max(1, len(scores) // KEPT)]] for part in moves))
        blocks = [Moves(*(part[i : i + BLOCK] for part in moves)) for i in range(0, len(moves.scales), BLOCK)]
        results = [
            _improve(Moves(*(part.astype(np.float32) for part in some)), p, q, to_x, to_y, widths) for some in blocks
        ]
        moves = Moves(*(np.concatenate([result[0][k] for result in results]).astype(np.float64) for k in range(3)))
        scores = np.concatenate([result[1] for result in results])
    return moves, scores


def _improve(moves: Moves, p: Array, q: Array, to_x: _Lookup, to_y: _Lookup, widths: Array) -> tuple[Moves, Array]:
    """One step per width, and the scores at the last width after the last step."""
    scores = np.zeros(len(moves.scales))
    for width in [*widths, None]:
        R, s, t = moves
        moved = s[:, None, None] * (p @ R.transpose(0, 2, 1)) + t[:, None]  # [S, n, 3]
        back = (q - t[:, None]) @ R / s[:, None, None]  # [S, m, 3]
        onto, origin = to_y(moved), to_x(back)
        reach = float(widths[-1] if width is None else width)
        ahead = robust_weights(_squares(moved - onto), reach)
        behind = robust_weights(_squares(back - origin) * s[:, None] ** 2, reach)
        if width is None:
            one, other = ahead.mean(1), behind.mean(1)
            scores = 2 * one * other / np.maximum(one + other, 1e-12)
            break
        source = np.concatenate([np.broadcast_to(p, moved.shape), origin], axis=1)
        target = np.concatenate([onto, np.broadcast_to(q, back.shape)], axis=1)
        moves = _fit(source, target, np.concatenate([ahead, behind], axis=1))
    return moves, scores


def _squares(vectors: Array) -> Array:
    squares: Array = np.einsum("snk,snk->sn", vectors, vectors)
    return squares


def _fit(source: Array, target: Array, weights: Array) -> Moves:
    """Umeyama's similarity for every row. The scale is the ratio of the spreads, which treats noise in both clouds alike."""
    w = (weights / np.maximum(weights.sum(1, keepdims=True), 1e-12))[:, None]  # [S, 1, n]
    a, b = (w @ source)[:, 0], (w @ target)[:, 0]  # [S, 3]
    cross = (target * w.transpose(0, 2, 1)).transpose(0, 2, 1) @ source - b[:, :, None] * a[:, None]
    U, _, Vt = np.linalg.svd(cross)
    Vt = Vt.copy()
    Vt[:, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    spread = [(w[:, 0] * _squares(x)).sum(1) - (c * c).sum(1) for x, c in ((source, a), (target, b))]
    s = np.clip(np.sqrt(np.maximum(spread[1], 0) / np.maximum(spread[0], 1e-12)), 0.3, 3.0)
    return Moves(R, s, b - s[:, None] * np.einsum("sij,sj->si", R, a))
