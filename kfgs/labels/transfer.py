"""Labels cross from the semantic field to the colour field by distance alone (Sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from .._check import check_choice, check_range, check_shapes, check_whole
from ..gaussians import Gaussians
from ..splat.covariance import covariance_3d
from .transfer_distance import explained_distance, positions
from .transfer_rules import Density, Nearest, Rule, Verdict, Vote, upper_triangle
from .transfer_sources import Array, Near, Sources, neighbours_together

Method = Literal["nearest", "vote", "mahalanobis"]

NEIGHBOURS = 4  # looked at by "nearest", for ambiguity alone; 8 cost half as much again
CHUNK = 16_384  # destinations at a time: with 16 neighbours and their covariances, 25 MB
THIN = 1e-3  # of a Gaussian's length is the least thickness that "mahalanobis" sees
TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source Gaussians to N destination Gaussians, and what became of the rest."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite where there is none
    sources: Tensor  # [N] int64, index of that source; -1 where there is none
    distance: float  # lambda, world units
    how: str  # where lambda comes from
    shares: Tensor  # [N] of the label in the weight of the sources looked at, in (0, 1]; 0 where there is none
    disagree: Tensor  # [N] bool, labelled, but with another label among the sources looked at
    method: Method = "nearest"

    @property
    def labelled(self) -> int:
        """Destinations with a label."""
        return int((self.labels >= 0).sum())

    @property
    def orphaned(self) -> int:
        """Destinations without: no labelled source in range."""
        return len(self.labels) - self.labelled

    @property
    def ambiguous(self) -> int:
        """Labelled destinations with another label among the sources looked at."""
        return int(self.disagree.sum())

    def select(self, which: Tensor) -> Transfer:  # which: [N] bool or [n] int64
        """The transfer of the destinations under a mask or an index alone, to go with `Gaussians.select` of them.

        Sources stay numbered as they were. Counts are those of the selected: over the parts of a partition they add up
        to the counts of the whole.

        Raises:
            ValueError: if a mask is not of these destinations.
        """
        if which.dtype == torch.bool and which.shape != self.labels.shape:
            raise ValueError(
                f"which: expected a mask [N] with N = {len(self.labels)} (the destinations), got {tuple(which.shape)}; "
                "select in the cloud that received the labels"
            )
        columns = ("labels", "distances", "sources", "shares", "disagree")
        return replace(self, **{name: getattr(self, name)[which] for name in columns})

    def __repr__(self) -> str:
        return (
            f"Transfer({self.labelled} labelled, {self.orphaned} orphaned, {self.ambiguous} ambiguous, "
            f"{self.method} within {self.distance:.4g}: {self.how})"
        )


def transfer_labels(
    src: Tensor | Gaussians,  # [S, 3] means, or the Gaussians
    src_labels: Tensor,  # [S] int64, -1 = none
    dst: Tensor | Gaussians,  # [N, 3] means, or the Gaussians
    distance: float | None = None,
    *,
    method: Method = "nearest",
    neighbours: int = 16,
    deviations: float = 5.0,
) -> Transfer:
    """Give each destination a label from the labelled sources **strictly** closer than `distance`.

    The rule of Sec. 3.4, where `distance` is lambda. The paper does not say which label wins when several lie in range.
    Three answers; sources with label -1 take no part and do not hide a labelled one behind them:

    - "nearest": the nearest source decides. Its share is that of its label among the 4 nearest in range, each counting 1.
    - "vote": the `neighbours` nearest in range vote with weight o / d, opacity (1 for positions) over distance. Among
      tied labels, the one with the nearest voter.
    - "mahalanobis": shapes decide. Of the `neighbours` nearest in range, those less than `deviations` standard deviations
      away vote with weight o exp(-m^2 / 2), m^2 = d^T (Sigma_src + Sigma_dst)^-1 d: how much source and destination
      overlap. Among tied labels, the one with the source of least m. `src` must be Gaussians; a `dst` of positions has
      Sigma_dst = 0.

    Of equally near sources (as float64 distances) the lowest indices come first; of several at one position only the
    lowest index speaks. A Gaussian thinner than a thousandth of its length counts as that thick.

    Args:
        src: the semantic field, as positions or as Gaussians.
        src_labels: their labels.
        dst: what to label (the colour field), as positions or as Gaussians.
        distance: lambda in world units; None takes `default_distance`.
        method: which label wins.
        neighbours: how many sources "vote" and "mahalanobis" look at, at most.
        deviations: the reach of "mahalanobis", besides `distance`.

    Returns:
        Labels, shares, distances and sources on the destinations' device, with counts. Without any labelled source
        everything is orphaned.

    Raises:
        ValueError: if shapes disagree, a position, shape or opacity is not finite, a label is below -1, a number is out of
            range, or "mahalanobis" gets no Gaussians.
        TypeError: if the labels are not integers.

    Note:
        Measured on the colour Gaussians of the toy room (true classes of its surface) and of Replica's room_0 (classes of
        the labelled pixels that they fill), mIoU in per cent over nearest / vote / mahalanobis of Gaussians: 88.6 / 89.6 /
        90.9 and 74.7 / 75.4 / 78.7 from votes of segmented views; 50.1 / 70.1 / 74.4 and 30.7 / 51.1 / 48.9 from
        `SemanticField.classify`, whose labels are noisy. Times: benchmarks/transfer.py.
    """
    check_choice("method", method, get_args(Method))
    check_whole("neighbours", neighbours, 1)
    check_range("deviations", deviations, 0, closed=(False, False))
    src_means = src.means if isinstance(src, Gaussians) else src
    dst_means = dst.means if isinstance(dst, Gaussians) else dst
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if method == "mahalanobis" and not isinstance(src, Gaussians):
        raise ValueError(
            "src: expected Gaussians for method 'mahalanobis', got positions; pass the Gaussians themselves"
        )
    labels = _labels(src_labels)
    points, targets = positions("src_means", src_means), positions("dst_means", dst_means)
    kept = np.flatnonzero(labels >= 0)
    found = _Found(len(targets))
    if kept.size == 0:
        chosen, how = (0.0, "no labelled source") if distance is None else (float(distance), "given")
        return found.report(dst_means, chosen, how, method)
    sources = Sources(points[kept], labels[kept])
    kept = kept[sources.first]
    chosen, how = explained_distance(sources.tree, targets) if distance is None else (float(distance), "given")
    k = NEIGHBOURS if method == "nearest" else neighbours
    rule: Rule = Nearest(sources)
    if method == "vote":
        rule = Vote(sources, _opacities(src)[kept], 1e-9 * chosen)
    elif method == "mahalanobis":
        shapes = _covariances("src", src)[:, kept], targets, _covariances("dst", dst)
        rule = Density(sources, _opacities(src)[kept], *shapes, deviations)
    order = neighbours_together(targets)
    for start in range(0, len(targets), CHUNK):
        rows = order[start : start + CHUNK]
        near = sources.near(targets[rows], k, chosen)
        found.fill(rows, sources, kept, near, rule(rows, near))
    return found.report(dst_means, chosen, how, method)


class _Found:
    """What is known about N destinations, filled in piece by piece."""

    def __init__(self, n: int) -> None:
        self.labels = np.full(n, -1, dtype=np.int64)
        self.sources = np.full(n, -1, dtype=np.int64)
        self.distances = np.full(n, np.inf)
        self.shares = np.zeros(n)
        self.disagree = np.zeros(n, dtype=np.bool_)

    def fill(self, rows: Array, sources: Sources, kept: Array, near: Near, verdict: Verdict) -> None:
        """Note a verdict on some rows; `kept` says which of the caller's sources each source is."""
        some = np.flatnonzero(verdict.column >= 0)
        column = verdict.column[some]
        source, rows = near.source[some, column], rows[some]
        self.labels[rows], self.sources[rows] = sources.labels[source], kept[source]
        self.distances[rows], self.shares[rows] = near.distance[some, column], verdict.share[some]
        self.disagree[rows] = verdict.ambiguous[some]

    def report(self, dst_means: Tensor, distance: float, how: str, method: Method) -> Transfer:
        device = dst_means.device
        return Transfer(
            labels=torch.from_numpy(self.labels).to(device),
            distances=torch.from_numpy(self.distances).to(device, dst_means.dtype),
            sources=torch.from_numpy(self.sources).to(device),
            distance=distance,
            how=how,
            shares=torch.from_numpy(self.shares).to(device, dst_means.dtype),
            disagree=torch.from_numpy(self.disagree).to(device),
            method=method,
        )


def _opacities(cloud: Tensor | Gaussians) -> Array:  # [N] float64, > 0
    """What each source has to say: its opacity, or 1 where there are only positions."""
    if not isinstance(cloud, Gaussians):
        return np.ones(len(cloud))
    values = cloud.opacities.detach().cpu().double()
    _check_finite("src.opacities", values[:, None])
    return values.clamp_min(TINY).numpy()


def _covariances(name: str, cloud: Tensor | Gaussians) -> Array:  # [6, N]
    """Covariances in float64, none so thin that its inverse is lost in rounding; zeros for positions."""
    if not isinstance(cloud, Gaussians):
        return np.zeros((6, len(cloud)))
    scales, quats = cloud.scales.detach().cpu().double(), cloud.quats.detach().cpu().double()
    _check_finite(f"{name}.scales, {name}.quats", torch.cat([scales, quats], dim=1))
    scales = torch.maximum(scales, (THIN * scales.amax(dim=1, keepdim=True)).clamp_min(1e-30))
    return upper_triangle(covariance_3d(quats, scales).numpy())


def _check_finite(name: str, values: Tensor) -> None:  # [N, n]
    finite = torch.isfinite(values).all(dim=1)
    if not finite.all():
        row = int((~finite).nonzero()[0])
        raise ValueError(
            f"{name}: expected finite numbers, got NaN or infinity in row {row}; remove such Gaussians first"
        )


def _labels(labels: Tensor) -> Array:  # [S] int64
    if labels.dtype.is_floating_point or labels.dtype in (torch.bool, torch.complex64):
        raise TypeError(f"src_labels: expected integer labels, got {labels.dtype}; convert them with .long()")
    values: Array = labels.detach().cpu().numpy().astype(np.int64)
    if values.size and values.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {values.min()}; map other codes to -1 first")
    return values
