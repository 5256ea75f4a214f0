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
"""Takes the destinations [n, 3] and what is near them."""


@dataclass(frozen=True)
class Nearest:
    """The nearest source gives the label, whoever else is near."""

    sources: Sources

    def __call__(self, points: Array, near: Near) -> Verdict:
        """Column 0, where it holds a source."""
        weight = near.hit.astype(np.float64)
        label = self.sources.labels[near.source]
        share = (weight * (label == label[:, :1])).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
        found = near.hit[:, 0]
        return Verdict(np.where(found, 0, -1), share, found & _disagree(self.sources, near, near.hit))


@dataclass(frozen=True, eq=False)
class Vote:
    """The label with the most weight among the sources in range."""

    sources: Sources
    weights: Array  # [S] > 0

    def __call__(self, points: Array, near: Near) -> Verdict:
        """Tied labels: the one with the nearest voter."""
        weight = np.where(near.hit, self.weights[near.source], 0)
        return _tally(self.sources, near, weight, near.distance)


@dataclass(frozen=True, eq=False)
class Density:
    """The label whose Gaussians are densest at the destination: the sum of o exp(-m^2 / 2), m in standard deviations."""

    sources: Sources
    weights: Array  # [S] > 0, opacities
    whitening: Array  # [S, 3, 3], S^-1 R^T: takes an offset to standard deviations along the Gaussian's axes
    deviations: float  # sources further away than this take no part

    def __call__(self, points: Array, near: Near) -> Verdict:
        """Tied labels: the one with the Gaussian that is nearest in standard deviations."""
        offset = points[:, None] - self.sources.points[near.source]  # [n, k, 3]
        m = np.linalg.norm((self.whitening[near.source] @ offset[..., None])[..., 0], axis=-1)
        m[~near.hit | (m >= self.deviations)] = np.inf
        return _tally(self.sources, near, self.weights[near.source] * np.exp(-0.5 * m**2), m)


def _tally(sources: Sources, near: Near, weight: Array, far: Array) -> Verdict:
    """Add up `weight` [n, k] per label; of the winner's sources the one that is least `far` [n, k] is named."""
    part = np.isfinite(far)
    found = part.any(axis=1)
    ambiguous = _disagree(sources, near, part)
    column = np.asarray(np.where(found, far.argmin(axis=1), -1))
    share: Array = found.astype(np.float64)
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
