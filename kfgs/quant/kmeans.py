"""Spherical k-means (Dhillon & Modha 2001): groups of features that point the same way."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._rows import EPS, row_norms, unit_rows
from .codebook import nearest_rows


class Cells(NamedTuple):
    """Centres, and the nearest centre of each feature."""

    centres: Tensor  # [K, D] unit rows
    index: Tensor  # type: ignore[assignment]  # [n] int64
    similarity: Tensor  # [n]


def spherical_kmeans(
    features: Tensor,  # [n, D]
    weights: Tensor,  # [n] >= 0
    clusters: int,
    *,
    rounds: int = 10,
    generator: torch.Generator | None = None,
) -> Cells:
    """Group features by direction: each joins the centre of largest cosine; a centre is the mean direction of its features.

    The first centres are drawn in proportion to the weights, capped at their 0.99 quantile, so that one huge weight does not
    draw all of them. An all-zero feature goes to group 0 and moves no centre. With fewer features than `clusters`, K is smaller.
    A ValueError if every weighted feature is zero.
    """
    rows, counted = unit_rows(features), (weights > 0) & (row_norms(features) > EPS)
    candidates = int(counted.sum())
    if candidates == 0:
        raise ValueError(f"features: expected a weighted nonzero row, got {len(features)} without; check the teacher")
    capped = cap(weights, weights[counted].double()) * counted
    generator = generator or torch.Generator().manual_seed(0)
    first = torch.multinomial(capped.cpu().double(), min(clusters, candidates), generator=generator)
    return refine(rows, rows[first.to(rows.device)], rounds, weights=capped)


def cap(weights: Tensor, positive: Tensor) -> Tensor:
    """Weights capped at the 0.99 quantile of the positive ones, so that a few wall-sized Gaussians do not decide alone."""
    sample = positive[:: max(1, len(positive) // 100_000)]  # torch.quantile refuses more than 16 million
    return weights.clamp_max(torch.quantile(sample, 0.99))


def refine(unit: Tensor, centres: Tensor, rounds: int, *, weights: Tensor | None = None) -> Cells:
    """Rounds of averaging and assignment, from given centres; a centre that loses all its features stays where it is."""
    cells = Cells(centres, *nearest_rows(unit, centres))
    rows = unit if weights is None else unit * weights[:, None].to(unit)
    for _ in range(rounds):
        sums = torch.zeros_like(centres).index_add_(0, cells.index, rows)  # repeatable on a CPU
        centres = torch.where(row_norms(sums)[:, None] > EPS, unit_rows(sums), cells.centres)
        cells = Cells(centres, *nearest_rows(unit, centres))
    return cells
