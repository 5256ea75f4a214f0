"""Groups of features that point the same way: spherical k-means."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_shapes, check_whole
from .._rows import EPS, row_norms, unit_rows

ROUNDS = 10  # of assignment and averaging: later ones move few features


class Clusters(NamedTuple):
    """Groups of features."""

    centres: Tensor  # [K, D] unit rows
    group: Tensor  # [n] int64, the group of each feature

    def __repr__(self) -> str:
        return short_repr(self)


def spherical_kmeans(
    features: Tensor,  # [n, D]
    weights: Tensor,  # [n] >= 0
    clusters: int,
    *,
    rounds: int = ROUNDS,
    generator: torch.Generator | None = None,
) -> Clusters:
    """Group features by direction (Dhillon & Modha 2001): each feature joins the centre of largest cosine, and a
    centre is the mean direction of its features.

    Args:
        features: of any length; an all-zero one goes to group 0 and moves no centre.
        weights: how much each counts. The first centres are drawn in proportion to them, capped at their 0.99 quantile, so
            that one huge weight does not draw all of them.
        clusters: most groups, K; fewer if there are fewer features. A centre that loses all features stays.
        rounds: of assignment and averaging.
        generator: draws the first centres; None stands for seed 0.

    Raises:
        ValueError: if shapes disagree, or every weighted feature is zero.
    """
    check_shapes(("features", features, "n D"), ("weights", weights, "n"))
    check_whole("clusters", clusters, 1)
    check_whole("rounds", rounds, 1)
    generator = generator or torch.Generator().manual_seed(0)
    rows = unit_rows(features)
    counted = (weights > 0) & (row_norms(features) > EPS)
    candidates = int(counted.sum())
    if candidates == 0:
        raise ValueError(
            f"features: expected a nonzero row with a weight, got {len(features)} without; check the teacher"
        )
    worth = weights.clamp_max(torch.quantile(_some(weights[counted]), 0.99)) * counted
    first = torch.multinomial(worth.cpu().double(), min(clusters, candidates), generator=generator)
    centres = rows[first.to(rows.device)]
    for _ in range(rounds):
        index = (rows @ centres.T).argmax(dim=1)
        sums = torch.zeros_like(centres).index_add_(0, index, rows * worth[:, None].to(rows))
        centres = torch.where(row_norms(sums)[:, None] > EPS, unit_rows(sums), centres)
    return Clusters(centres, (rows @ centres.T).argmax(dim=1))


def _some(values: Tensor) -> Tensor:
    """At most 100,000 of the values, evenly: torch.quantile refuses more than 16 million."""
    return values[:: max(1, len(values) // 100_000)].double()
