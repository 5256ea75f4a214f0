"""Choose which source near a destination gives its label: the nearest, a vote, or the largest overlap."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
import torch

from .._card import short_repr
from .._rows import check_finite
from ..gaussians import Gaussians
from ..splat.covariance import covariance_3d
from .nearest import Array, Cloud, Near, Sources, means_of, positions

Method = Literal["nearest", "vote", "mahalanobis"]
THIN = 1e-3  # "mahalanobis" makes Gaussians at least this share of their length thick
TINY = float(np.finfo(np.float64).tiny)


class Verdict(NamedTuple):
    """The result of a rule for n destinations."""

    column: Array  # [n] int64, the column of `Near` that gives the label; -1 = none
    share: Array  # [n] the winning label's share in the weight of all sources considered; 0 if there is none
    ambiguous: Array  # [n] bool: another label is among these sources

    def __repr__(self) -> str:
        return short_repr(self)


def make_rule(
    method: Method,
    sources: Sources,
    kept: Array,  # [n] int64, which of `src` each source is
    src: Cloud,
    dst: Cloud,
    reach: float,  # lambda; for "mahalanobis" the deviations
) -> Callable[[Array, Near], Verdict]:
    """Make the function (rows of the destinations [n], sources near them) -> which source gives the label."""
    if method == "nearest":
        return lambda _, near: _by_nearest(sources, near)
    opacities = _opacities(src)[kept]
    if method == "vote":
        least = 1e-9 * reach  # a source at the same position outweighs all others

        def vote(_: Array, near: Near) -> Verdict:
            weight = np.where(near.hit, opacities[near.source] / np.maximum(near.distance, least), 0)
            return _by_weight(sources, near, weight, near.distance)

        return vote
    src_shapes, dst_shapes = _covariances("src", src)[:, kept], _covariances("dst", dst)
    targets = positions("dst_means", means_of("dst", dst, src))

    def overlap(rows: Array, near: Near) -> Verdict:
        hit = near.hit
        source, row = near.source[hit], np.broadcast_to(rows[:, None], hit.shape)[hit]
        shapes = src_shapes[:, source] + dst_shapes[:, row]
        squares = _mahalanobis_squares(targets[row] - sources.points[source], shapes)
        m = np.full(hit.shape, np.inf)
        m[hit] = np.where(squares < reach**2, squares, np.inf)
        least = m.min(axis=1, keepdims=True)
        least[np.isinf(least)] = 0
        weight = opacities[near.source] * np.exp(-0.5 * (m - least))  # relative to the best: nothing underflows
        return _by_weight(sources, near, weight, m)

    return overlap


def _by_nearest(sources: Sources, near: Near) -> Verdict:
    label = sources.labels[near.source]
    share = (near.hit & (label == label[:, :1])).sum(axis=1) / np.maximum(near.hit.sum(axis=1), 1)
    found = near.hit[:, 0]
    return Verdict(np.where(found, 0, -1), share, found & _disagree(sources, near, near.hit))


def _by_weight(sources: Sources, near: Near, weight: Array, far: Array) -> Verdict:
    """The label with the most `weight` [n, k] wins; its nearest source by `far` [n, k] gives it.

    Of tied labels, the one with the nearest source wins. Sources at infinite distance are left out.
    """
    part = np.isfinite(far)
    found: Array = np.asarray(part.any(axis=1))
    ambiguous = _disagree(sources, near, part)
    column = np.full(len(found), -1)
    column[found] = np.argmin(far[found], axis=1)
    share = np.where(found, 1.0, 0.0)
    rows = np.flatnonzero(ambiguous)  # elsewhere one label has the whole weight
    if rows.size:
        label, weight = np.where(part[rows], sources.labels[near.source[rows]], -1), weight[rows]
        total = np.stack([(weight * (label == label[:, [j]])).sum(axis=1) for j in range(label.shape[1])], axis=1)
        total[~part[rows]] = -1
        best = total.max(axis=1)
        column[rows] = np.where(total == best[:, None], far[rows], np.inf).argmin(axis=1)
        share[rows] = best / weight.sum(axis=1)
    return Verdict(column, share, ambiguous)


def _disagree(sources: Sources, near: Near, part: Array) -> Array:  # part: [n, k] bool -> [n] bool
    """Whether the sources in `part`, or other sources at their positions, have different labels."""
    label = sources.labels[near.source]
    low = np.where(part, label, np.iinfo(np.int64).max).min(axis=1)
    high = np.where(part, label, -1).max(axis=1)
    disagree: Array = part.any(axis=1) & ((low != high) | (part & sources.mixed[near.source]).any(axis=1))
    return disagree


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


def _opacities(cloud: Cloud) -> Array:  # [N] float64, > 0
    """The weight of each source: its opacity, or 1 if there are only positions."""
    if not isinstance(cloud, Gaussians):
        return np.ones(len(cloud))
    values = cloud.opacities.detach().cpu().double()
    check_finite("src.opacities", values[:, None])
    return values.clamp_min(TINY).numpy()


def _covariances(name: str, cloud: Cloud) -> Array:  # [6, N]
    """Covariances in float64, thick enough that rounding leaves their inverse accurate; zeros for positions.

    The rows are xx, xy, xz, yy, yz, zz of the symmetric matrices.
    """
    if not isinstance(cloud, Gaussians):
        return np.zeros((6, len(cloud)))
    scales, quats = cloud.scales.detach().cpu().double(), cloud.quats.detach().cpu().double()
    check_finite(f"{name}.scales, {name}.quats", torch.cat([scales, quats], dim=1))
    scales = torch.maximum(scales, (THIN * scales.amax(dim=1, keepdim=True)).clamp_min(1e-30))
    return np.ascontiguousarray(covariance_3d(quats, scales).numpy()[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T)
