"""Refine a similarity between two clouds: least squares on point-to-plane distances, both ways."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .._card import short_repr
from ..cameras.similarity import Similarity
from .clouds import Array, median_spacing, nearest, nearest_rotation, robust_weights, to_similarity
from .starts import thin

NEAR = 2.0  # a point fits if it is closer than this many spacings of the sparser cloud


class Fit(NamedTuple):
    """A similarity from one cloud to another, and how well the clouds then fit."""

    similarity: Similarity
    quality: float  # harmonic mean of the two shares that fit
    shares: tuple[float, float]  # of src points near dst, and of dst points near src
    rms: float  # of the points that fit, world units of dst


class Cloud(NamedTuple):
    """Points with normals, and a tree that finds the nearest."""

    points: Array  # [n, 3]
    normals: Array  # [n, 3]
    tree: cKDTree
    spacing: float

    def __repr__(self) -> str:
        return short_repr(self)

    @staticmethod
    def of(points: Array, count: int, rng: np.random.Generator) -> Cloud:
        """About `count` of the points, evenly over the surface; normals from the twelve nearest."""
        points = thin(points, count, rng)
        tree = cKDTree(points)
        near = points[nearest(tree, points, k=min(12, len(points)))[1]]  # [n, k, 3]
        near = near - near.mean(1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
        return Cloud(points, normals, tree, median_spacing(tree))


def fit_closely(a: Cloud, b: Cloud, start: Similarity, reaches: Array) -> Fit:
    """Least squares on distances to the other cloud's tangent planes, both ways, one step per reach.

    Reaches are multiples of the distance within which a point fits.
    """
    R, s, t = start.rotation.numpy(), start.scale, start.translation.numpy()
    fits = NEAR * max(a.spacing * s, b.spacing)
    for reach in reaches * fits:
        moved = s * a.points @ R.T + t
        d, i = nearest(b.tree, moved)
        e, j = nearest(a.tree, (b.points - t) @ R / s)
        P = np.concatenate([moved, moved[j]])
        Q = np.concatenate([b.points[i], b.points])
        n = np.concatenate([b.normals[i], a.normals[j] @ R.T])
        w = np.concatenate([robust_weights(d**2, reach) / len(d), robust_weights((e * s) ** 2, reach) / len(e)])
        center = P.mean(0)
        A = np.concatenate([np.cross(P - center, n), n, ((P - center) * n).sum(1)[:, None]], axis=1)  # [., 7]
        system = (A * w[:, None]).T @ A
        damping = 1e-4 * np.diag(np.maximum(np.diag(system), 1e-12 * np.trace(system)))
        x = np.linalg.solve(system + damping, (A * w[:, None]).T @ ((Q - P) * n).sum(1))
        turn, factor = Rotation.from_rotvec(x[:3]).as_matrix(), float(np.exp(np.clip(x[6], -0.1, 0.1)))
        t = factor * turn @ (t - center) + center + x[3:6]
        R, s = nearest_rotation(turn @ R), s * factor
    return _judge(a, b, to_similarity(s, R, t))


def _judge(a: Cloud, b: Cloud, similarity: Similarity) -> Fit:
    """How much of each cloud fits under a similarity."""
    d = nearest(b.tree, similarity.apply(torch.from_numpy(a.points)).numpy())[0]
    e = nearest(a.tree, similarity.inverse().apply(torch.from_numpy(b.points)).numpy())[0] * similarity.scale
    reach = NEAR * max(a.spacing * similarity.scale, b.spacing)
    shares = float((d < reach).mean()), float((e < reach).mean())
    quality = 2 * shares[0] * shares[1] / max(sum(shares), 1e-12)
    near = np.concatenate([d[d < reach], e[e < reach]])
    return Fit(similarity, quality, shares, float(np.sqrt((near**2).mean())) if len(near) else float("inf"))
