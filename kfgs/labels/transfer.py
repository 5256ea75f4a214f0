"""Carry labels from the semantic field to the colour field by distance (Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from .._check import as_tensor, check_choice, check_range, check_shapes, check_whole
from ..formats.splat_file import SCORE, SplatFile
from ..gaussians import Gaussians
from .label_set import LabelSet
from .nearest import Array, Cloud, Sources, explained_distance, means_of, neighbours_together, positions
from .transfer_methods import Method, make_rule

NEIGHBOURS = 4  # sources that "nearest" checks for ambiguity; 8 take half as long again
CHUNK = 16_384  # destinations at a time: with 16 neighbours and their covariances, 25 MB


@dataclass(frozen=True, eq=False)
class Transfer:
    """Labels carried from S source Gaussians to N destination Gaussians."""

    labels: Tensor  # [N] int64, -1 = none
    distances: Tensor  # [N] world units, to the source that gave the label; infinite if there is none
    sources: Tensor  # [N] int64, index of that source; -1 if there is none
    distance: float  # lambda, the distance within which a label is carried over, world units
    how: str  # how lambda was found
    shares: Tensor  # [N] the label's share in the weight of the sources considered, in (0, 1]; 0 without a label
    disagree: Tensor  # [N] bool, labelled, but with another label among the sources considered
    method: Method = "nearest"

    @property
    def labelled(self) -> int:
        """The number of destinations with a label."""
        return int((self.labels >= 0).sum())

    @property
    def orphaned(self) -> int:
        """The number of destinations without a label: no labelled source in range."""
        return len(self.labels) - self.labelled

    @property
    def ambiguous(self) -> int:
        """The number of labelled destinations with another label among the sources considered."""
        return int(self.disagree.sum())

    @property
    def scores(self) -> Tensor:  # [N] in [0, 1]
        """The confidence of each label: 1 - distance / lambda for "nearest", else the label's share; 0 without a label."""
        if self.method != "nearest":
            return self.shares
        reach = max(self.distance, torch.finfo(self.distances.dtype).tiny)
        return (1 - self.distances / reach).clamp_min(0.0)

    @property
    def score_meaning(self) -> str:
        """The meaning of `scores`, in words."""
        return "1 - distance / lambda" if self.method == "nearest" else "the label's share of the weights in range"

    def select(self, which: Tensor) -> Transfer:  # which: [N] bool or [n] int64
        """The transfer for some of the destinations, as `Gaussians.select` selects them. `sources` keep their indices.

        Raises:
            ValueError: if a mask has another length.
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
            f"Transfer({self.labelled:,} of {len(self.labels):,} labelled ({self.method} within {self.distance:.4g}), "
            f"{self.orphaned:,} orphaned, {self.ambiguous:,} ambiguous; lambda: {self.how})"
        )


def transfer_labels(
    src: Cloud,  # [S, 3] means, Gaussians or a splat
    src_labels: Tensor | Array,  # [S] int64, -1 = none
    dst: Cloud,  # [N, 3] means, Gaussians or a splat
    distance: float | None = None,
    *,
    method: Method = "nearest",
    neighbours: int = 16,
    deviations: float = 5.0,
) -> Transfer:
    """Give each destination a label from the labelled sources **strictly** closer than `distance`.

    The rule of Sec. 3.4; `distance` is its lambda, the distance within which a label is carried over. The paper does not
    say which label wins if several are in range. There are three methods; sources with label -1 take no part in any:

    - "nearest": the nearest source decides. The share is that of its label among the 4 nearest in range.
    - "vote": the `neighbours` nearest in range vote with weight o / d, opacity (1 for positions) over distance. Among
      tied labels, the one with the nearest voter wins.
    - "mahalanobis": shapes decide. Of the `neighbours` nearest in range, those less than `deviations` standard deviations
      away vote with weight o exp(-m^2 / 2), m^2 = d^T (Sigma_src + Sigma_dst)^-1 d, which says how much source and
      destination overlap. Among tied labels, the one with the source of least m wins. `src` must be Gaussians; if `dst`
      is positions, Sigma_dst = 0.

    Of equally near sources (as float64 distances) the lowest indices come first; of several at one position only the
    lowest index gives a label. Gaussians are made at least a thousandth of their length thick.

    Args:
        src: the semantic field, as positions (a tensor or an array), Gaussians or a splat.
        src_labels: their labels.
        dst: the colour field, as positions, Gaussians or a splat. `label_splats` labels a splat in one call.
        distance: lambda in world units; None: `default_distance`.
        method: which label wins.
        neighbours: the most sources that "vote" and "mahalanobis" consider.
        deviations: the reach of "mahalanobis", in addition to `distance`.

    Returns:
        Labels, shares, distances and sources on the destinations' device, with counts. Without any labelled source no
        destination has a label.

    Raises:
        ValueError: if shapes disagree, a position, shape or opacity is not finite, a label is below -1, a number is out of
            range, or "mahalanobis" gets no Gaussians.
        TypeError: if the labels are not integers.

    Note:
        With noisy source labels "vote" and "mahalanobis" are much better than "nearest", with clean ones a little
        (`docs/results.md`, "Labels for a colour field").
    """
    check_choice("method", method, get_args(Method))
    check_whole("neighbours", neighbours, 1)
    check_range("deviations", deviations, 0, closed=(False, False))
    src, dst = (one.gaussians if isinstance(one, SplatFile) else one for one in (src, dst))
    src_means, dst_means = means_of("src", src), means_of("dst", dst, src)
    src_labels = as_tensor("src_labels", src_labels)
    check_shapes(("src_means", src_means, "S 3"), ("src_labels", src_labels, "S"), ("dst_means", dst_means, "N 3"))
    if distance is not None:
        check_range("distance", distance, 0, closed=(False, False))
    if method == "mahalanobis" and not isinstance(src, Gaussians):
        raise ValueError(
            "src: expected Gaussians for method 'mahalanobis', got positions; pass the Gaussians themselves"
        )
    given = _labels(src_labels)
    points, targets = positions("src_means", src_means), positions("dst_means", dst_means)
    n, kept = len(targets), np.flatnonzero(given >= 0)
    labels, winners, distances = np.full(n, -1), np.full(n, -1), np.full(n, np.inf)
    shares, disagree = np.zeros(n), np.zeros(n, dtype=np.bool_)
    chosen, how = (0.0, "no labelled source") if distance is None else (float(distance), "given")
    if kept.size:
        sources = Sources(points[kept], given[kept])
        if distance is None:
            chosen, how = explained_distance(sources.tree, targets)
        kept = kept[sources.first]
        reach = deviations if method == "mahalanobis" else chosen
        rule = make_rule(method, sources, kept, src, dst, reach)
        order = neighbours_together(targets)
        for rows in (order[start : start + CHUNK] for start in range(0, n, CHUNK)):
            near = sources.near(targets[rows], NEIGHBOURS if method == "nearest" else neighbours, chosen)
            found = rule(rows, near)
            some = np.flatnonzero(found.column >= 0)
            column, rows = found.column[some], rows[some]
            source = near.source[some, column]
            labels[rows], winners[rows] = sources.labels[source], kept[source]
            distances[rows], shares[rows] = near.distance[some, column], found.share[some]
            disagree[rows] = found.ambiguous[some]
    return Transfer(
        labels=torch.from_numpy(labels).to(dst_means.device),
        distances=torch.from_numpy(distances).to(dst_means),
        sources=torch.from_numpy(winners).to(dst_means.device),
        distance=chosen,
        how=how,
        shares=torch.from_numpy(shares).to(dst_means),
        disagree=torch.from_numpy(disagree).to(dst_means.device),
        method=method,
    )


def label_splats(
    splats: SplatFile | Gaussians,
    labelled: SplatFile | Gaussians,
    classes: LabelSet | Sequence[str] = (),
    distance: float | None = None,
    *,
    method: Method = "nearest",
) -> SplatFile:
    """Label a splat by distance, in one call: `label_splats(read_splats("mine.ply"), field.label(classes), classes)`.

    Both must share one frame; `kfgs.attach` finds the common frame, and can label by views instead of by distance.

    Args:
        splats: the splat to label; old labels are replaced.
        labelled: Gaussians with labels, for instance from `SemanticField.label`, or a labelled splat.
        classes: the names of the classes; by default those of a labelled splat. Gaussians alone, as `SemanticField.label`
            gives them, know no names: without `classes` the result has none.
        distance: lambda, the distance within which a label is carried over, in world units; None: `default_distance`.
        method: which label wins, see `transfer_labels`.

    Returns:
        The splat with `labels`, the extra column `score` (`Transfer.scores`), class names if they are known, and details in
        `info["labels"]`.

    Raises:
        TypeError: if `splats` or `labelled` is neither Gaussians nor a splat, for instance a path.
        ValueError: if `labelled` carries no labels, or as `transfer_labels`.
    """
    for name, one in (("splats", splats), ("labelled", labelled)):
        if not isinstance(one, SplatFile | Gaussians):
            advice = "read_splats reads a file" if isinstance(one, str | Path) else "transfer_labels takes positions"
            raise TypeError(f"{name}: expected Gaussians or a splat, got {type(one).__name__}; {advice}")
    splats, source = (SplatFile(one) if isinstance(one, Gaussians) else one for one in (splats, labelled))
    if source.gaussians.labels is None:
        raise ValueError(
            "labelled: expected Gaussians with labels, got none; label them first, with SemanticField.label"
        )
    names = classes.names if isinstance(classes, LabelSet) else tuple(classes) or source.classes
    found = transfer_labels(source.gaussians, source.gaussians.labels, splats.gaussians, distance, method=method)
    details = {
        "labelled by": "distance",
        "method": method,
        "lambda": found.distance,
        "lambda from": found.how,
        "score": found.score_meaning,
        "ambiguous": found.ambiguous,
    }
    return splats.replace(
        gaussians=splats.gaussians.replace(labels=found.labels),
        extra=splats.extra | {SCORE: found.scores.to(torch.float32).cpu().numpy()},
        classes=names,
        info=splats.info | {"labels": details},
    )


def _labels(labels: Tensor) -> Array:  # [S] int64
    if labels.dtype.is_floating_point or labels.dtype in (torch.bool, torch.complex64):
        raise TypeError(f"src_labels: expected integer labels, got {labels.dtype}; convert them with .long()")
    values: Array = labels.detach().cpu().numpy().astype(np.int64)
    if values.size and values.min() < -1:
        raise ValueError(f"src_labels: expected class indices or -1, got {values.min()}; map other codes to -1 first")
    return values
