"""Which of the sources near a destination gives its label: the nearest, a vote, or the densest class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .transfer_sources import Array, Near, Sources


class Verdict(NamedTuple):
    """What a rule says about n destinations."""

    column: Array  # [n] int64, the column of `Near` that gives the label; -1 = none
    share: Array  # [n] of the winning label in the weight of all sources looked at; 0 where there is none
    ambiguous: Array  # [n] bool: another label was among them


Rule = Callable[[Array, Near], Verdict]
"""Takes rows of the destinations [n] and what is near them."""


@dataclass(frozen=True)
class Nearest:
    """The nearest source gives the label, whoever else is near."""

    sources: Sources

    def __call__(self, rows: Array, near: Near) -> Verdict:
        """Column 0, where it holds a source."""
        weight = near.hit.astype(np.float64)
        label = self.sources.labels[near.source]
        share = (weight * (label == label[:, :1])).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
        found = near.hit[:, 0]
        return Verdict(np.where(found, 0, -1), share, found & _disagree(self.sources, near, near.hit))


@dataclass(frozen=True, eq=False)
class Vote:
    """The label with the most weight among the sources in range, each weighing its opacity over its distance."""

    sources: Sources
    opacities: Array  # [S] > 0
    least: float  # distances below this count as this: a source at the very place outweighs all others

    def __call__(self, rows: Array, near: Near) -> Verdict:
        """Tied labels: the one with the nearest voter."""
        weight = np.where(near.hit, self.opacities[near.source] / np.maximum(near.distance, self.least), 0)
        return _tally(self.sources, near, weight, near.distance)


@dataclass(frozen=True, eq=False)
class Density:
    """The label whose Gaussians overlap the destination most: the sum of o exp(-m^2 / 2).

    m^2 = d^T (Sigma_src + Sigma_dst)^-1 d is the squared Mahalanobis distance, the exponent of the overlap integral of
    two Gaussians; with a point for a destination, Sigma_dst = 0, it is the source's own density.
    """

    sources: Sources
    opacities: Array  # [S] > 0
    src_covariances: Array  # [6, S], see `upper_triangle`
    dst_means: Array  # [N, 3]
    dst_covariances: Array  # [6, N], zeros for points
    deviations: float  # sources from here on take no part

    def __call__(self, rows: Array, near: Near) -> Verdict:
        """Tied labels: the one with the Gaussian of least m."""
        hit = near.hit
        source, row = near.source[hit], np.broadcast_to(rows[:, None], hit.shape)[hit]
        covariances = self.src_covariances[:, source] + self.dst_covariances[:, row]
        squares = _mahalanobis_squares(self.dst_means[row] - self.sources.points[source], covariances)
        m = np.full(hit.shape, np.inf)
        m[hit] = np.where(squares < self.deviations**2, squares, np.inf)
        least = m.min(axis=1, keepdims=True)
        least[np.isinf(least)] = 0
        weight = self.opacities[near.source] * np.exp(-0.5 * (m - least))  # relative to the best: nothing underflows
        return _tally(self.sources, near, weight, m)


def upper_triangle(covariances: Array) -> Array:  # [N, 3, 3] -> [6, N], xx xy xz yy yz zz
    """The six numbers of symmetric matrices, each in a row of its own."""
    return np.ascontiguousarray(covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T)


def _mahalanobis_squares(offset: Array, covariances: Array) -> Array:  # [n, 3], [6, n] -> [n]
    """d^T Sigma^-1 d by Cramer's rule, ten times faster than a solver on so many small matrices."""
    x, y, z = offset.T
    xx, xy, xz, yy, yz, zz = covariances
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy  # the first row of the adjugate
    determinant = xx * a + xy * b + xz * c
    squares: Array = (
        x * (x * a + 2 * (y * b + z * c))
        + y * (y * (xx * zz - xz * xz) + 2 * z * (xy * xz - xx * yz))
        + z * z * (xx * yy - xy * xy)
    ) / determinant
    return np.maximum(squares, 0)


def _tally(sources: Sources, near: Near, weight: Array, far: Array) -> Verdict:
    """Add up `weight` [n, k] per label; of the winner's sources the one that is least `far` [n, k] is named."""
    part = np.isfinite(far)
    found: Array = np.asarray(part.any(axis=1))
    ambiguous = _disagree(sources, near, part)
    column = np.full(len(found), -1)
    column[found] = np.argmin(far[found], axis=1)
    share = np.where(found, 1.0, 0.0)
    rows = np.flatnonzero(ambiguous)
    if rows.size:  # elsewhere all agree, which is most of the cloud
        label, weight = np.where(part[rows], sources.labels[near.source[rows]], -1), weight[rows]
        total = np.stack([(weight * (label == label[:, [j]])).sum(axis=1) for j in range(label.shape[1])], axis=1)
        total[~part[rows]] = -1
        best = total.max(axis=1)
        column[rows] = np.where(total == best[:, None], far[rows], np.inf).argmin(axis=1)
        share[rows] = best / weight.sum(axis=1)
    return Verdict(column, share, ambiguous)


def _disagree(sources: Sources, near: Near, part: Array) -> Array:  # part: [n, k] bool -> [n] bool
    """Is more than one label among the sources that take part (or at the position of one of them)?"""
    label = sources.labels[near.source]
    low = np.where(part, label, np.iinfo(np.int64).max).min(axis=1)
    high = np.where(part, label, -1).max(axis=1)
    disagree: Array = part.any(axis=1) & ((low != high) | (part & sources.mixed[near.source]).any(axis=1))
    return disagree
