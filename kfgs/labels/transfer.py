"""Labels cross from the semantic field to the colour field by distance alone (Sec. 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from .._check import check_choice, check_range, check_shapes, check_whole
from ..gaussians import Gaussians
from .transfer_distance import explained_distance, positions
from .transfer_rules import Density, Nearest, Rule, Vote
from .transfer_sources import Array, Sources, neighbours_together

Method = Literal["nearest", "vote", "mahalanobis"]

NEIGHBOURS = 4  # looked at by "nearest", for ambiguity alone; 8 cost half as much again
CHUNK = 32_768  # destinations at a time: with 16 neighbours and their axes, 38 MB


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source Gaussians to N destination Gaussians, and what became of the rest."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite where there is none
    sources: Tensor  # [N] int64, index of that source; -1 where there is none
    distance: float  # lambda, world units
    how: str  # where lambda comes from
    labelled: int  # destinations with a label
    orphaned: int  # destinations without: no labelled source in range
    ambiguous: int  # labelled ones with another label among the sources looked at
    shares: Tensor  # [N] of the label in the weight of the sources looked at, in (0, 1]; 0 where there is none
    method: Method = "nearest"

    def __repr__(self) -> str:
        return (
            f"Transfer({self.labelled} labelled, {self.orphaned} orphaned, {self.ambiguous} ambiguous, "
            f"{self.method} within {self.distance:.4g}: {self.how})"
        )


def transfer_labels(
    src: Tensor | Gaussians,  # [S, 3] means, or the Gaussians
    src_labels: Tensor,  # [S] int64, -1 = none
    dst_means: Tensor,  # [N, 3]
    distance: float | None = None,
    *,
    method: Method = "nearest",
    neighbours: int = 16,
    deviations: float = 3.0,
) -> Transfer:
    """Give each destination a label from the labelled sources **strictly** closer than `distance`.

    The rule of Sec. 3.4, where `distance` is lambda. The paper does not say which label wins when several lie in range.
    Three answers, of the same sources, those with label -1 left out (they do not hide a labelled one behind them):

    - "nearest": the nearest source decides. Its share is that of its label among the 4 nearest in range, each counting 1.
    - "vote": the `neighbours` nearest in range vote, each with its opacity (1 if `src` is positions alone), however far
      they are. Among tied labels, the one with the nearest voter.
    - "mahalanobis": the density of the semantic field at the destination decides: of the `neighbours` nearest in range,
      each weighs o exp(-m^2 / 2), where m is the distance in standard deviations of that source; from `deviations` on,
      none takes part. Among tied labels, the one with the source of least m. Needs Gaussians as `src`.

    Of equally near sources (as float64 distances) the lowest indices come first; of several at one position only the
    lowest index speaks.

    Args:
        src: the semantic field, as positions or as Gaussians.
        src_labels: their labels.
        dst_means: positions of the Gaussians to label (the colour field).
        distance: lambda in world units; None takes `default_distance`.
        method: which label wins.
        neighbours: how many sources "vote" and "mahalanobis" look at, at most.
        deviations: the reach of "mahalanobis" in standard deviations of a source.

    Returns:
        Labels, shares, distances and sources on the destinations' device, with counts. Without any labelled source
        everything is orphaned.

    Raises:
        ValueError: if shapes disagree, a position is not finite, a label is below -1, a number is out of range, or
            "mahalanobis" gets no Gaussians.
        TypeError: if the labels are not integers.
    """
    check_choice("method", method, get_args(Method))
    check_whole("neighbours", neighbours, 1)
    check_range("deviations", deviations, 0, closed=(False, False))
    src_means = src.means if isinstance(src, Gaussians) else src
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if method == "mahalanobis" and not isinstance(src, Gaussians):
        raise ValueError(
            "src: expected Gaussians for method 'mahalanobis', got positions; pass the Gaussians themselves"
        )
    points, dst = positions("src_means", src_means), positions("dst_means", dst_means)
    labels = _labels(src_labels)
    kept = np.flatnonzero(labels >= 0)
    found = _Found(len(dst))
    if kept.size == 0:
        chosen, how = (0.0, "no labelled source") if distance is None else (float(distance), "given")
        return found.report(dst_means, chosen, how, method)
    sources = Sources(points[kept], labels[kept])
    chosen, how = explained_distance(sources.tree, dst) if distance is None else (float(distance), "given")
    kept = kept[sources.first]
    rule = _rule(method, sources, src, kept, deviations)
    order = neighbours_together(dst) if len(dst) else np.empty(0, dtype=np.int64)
    for start in range(0, len(dst), CHUNK):
        rows = order[start : start + CHUNK]
        found.fill(sources, kept, rule, dst, rows, NEIGHBOURS if method == "nearest" else neighbours, chosen)
    return found.report(dst_means, chosen, how, method)


class _Found:
    """What is known about N destinations, filled in piece by piece."""

    def __init__(self, n: int) -> None:
        self.labels = np.full(n, -1, dtype=np.int64)
        self.sources = np.full(n, -1, dtype=np.int64)
        self.distances = np.full(n, np.inf)
        self.shares = np.zeros(n)
        self.ambiguous = 0

    def fill(self, sources: Sources, kept: Array, rule: Rule, dst: Array, rows: Array, k: int, distance: float) -> None:
        """Ask `rule` about some rows of `dst`; `kept` says which of the caller's sources each source is."""
        points = dst[rows]
        near = sources.near(points, k, distance)
        verdict = rule(points, near)
        self.ambiguous += int(verdict.ambiguous.sum())
        some = np.flatnonzero(verdict.column >= 0)
        column = verdict.column[some]
        source = near.source[some, column]
        rows = rows[some]
        self.labels[rows], self.sources[rows] = sources.labels[source], kept[source]
        self.distances[rows], self.shares[rows] = near.distance[some, column], verdict.share[some]

    def report(self, dst_means: Tensor, distance: float, how: str, method: Method) -> Transfer:
        device = dst_means.device
        labelled = int((self.labels >= 0).sum())
        return Transfer(
            labels=torch.from_numpy(self.labels).to(device),
            distances=torch.from_numpy(self.distances).to(device, dst_means.dtype),
            sources=torch.from_numpy(self.sources).to(device),
            distance=distance,
            how=how,
            labelled=labelled,
            orphaned=len(self.labels) - labelled,
            ambiguous=self.ambiguous,
            shares=torch.from_numpy(self.shares).to(device, dst_means.dtype),
            method=method,
        )


def _rule(method: Method, sources: Sources, src: Tensor | Gaussians, kept: Array, deviations: float) -> Rule:
    """The rule of a method for the sources `kept` of `src`."""
    if method == "nearest":
        return Nearest(sources)
    if not isinstance(src, Gaussians):
        return Vote(sources, np.ones(len(kept)))
    which = torch.from_numpy(kept).to(src.means.device)
    tiny = np.finfo(np.float64).tiny
    opacities = np.maximum(src.opacities[which].detach().cpu().double().numpy(), tiny)
    if method == "vote":
        return Vote(sources, opacities)
    axes = quaternion_to_rotation_matrix(src.quats[which].detach().cpu().double()).numpy()
    scales = src.scales[which].detach().cpu().double().clamp_min(1e-12).numpy()
    return Density(sources, opacities, axes.transpose(0, 2, 1) / scales[:, :, None], deviations)


def _labels(labels: Tensor) -> Array:  # [S] int64
    if labels.dtype.is_floating_point or labels.dtype in (torch.bool, torch.complex64):
        raise TypeError(f"src_labels: expected integer labels, got {labels.dtype}; convert them with .long()")
    values: Array = labels.detach().cpu().numpy().astype(np.int64)
    if values.size and values.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {values.min()}; map other codes to -1 first")
    return values
