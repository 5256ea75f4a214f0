"""Grow codewords: split the cell whose features are represented worst, and run k-means on the sphere after each split."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._rows import unit_rows

LEAST_GAIN = 0.05  # of a cell's cosine distance; isotropic noise in n dimensions gains about 2 / (pi n) from a split
LEAST_SHARE = 1 / 16  # of the mean cell's features, at maximum size: fewer are outliers, not content
ROUNDS = 2  # of k-means after each growth: cells only need to be good enough to be ranked
LAST_ROUNDS = 6  # of k-means at the end
POWER_STEPS = 6  # of the power iteration for a cell's widest direction


class Cells(NamedTuple):
    """The nearest centre of each feature."""

    centres: Tensor  # [K, D] unit rows
    index: Tensor  # type: ignore[assignment]  # [n] int64
    similarity: Tensor  # [n]

    def __repr__(self) -> str:
        return short_repr(self)


class Grown(NamedTuple):
    """The result of `grow`."""

    cells: Cells
    history: list[dict[str, Any]]  # per round: size, added, mean_similarity before it grew
    similarity: list[Tensor]  # [n] of each round, before it grew
    full: bool  # whether a split that pays was left out because the book was full

    def __repr__(self) -> str:
        return short_repr(self)


def grow(
    unit: Tensor,  # [n, D] unit rows
    maximum: int,
    *,
    alpha: float | None = None,
    coverage: float = 0.9,
    generator: torch.Generator,
) -> Grown:
    """Start with one codeword and split cells, the least similar first, until no split pays or `maximum` is reached.

    A cell is split in two across its widest direction. It qualifies by its *mean* similarity, not by its number of
    features, so rare content gets codewords as readily as a wall; by at least 2 `LEAST_SHARE` n / `maximum` features,
    so that a few outliers never lead; and by a split that lowers its cosine distance by `LEAST_GAIN`, which noise
    without structure does not allow. With `alpha`, only cells split in which less than `coverage` of the features are
    that similar (Eq. 8 for cells instead of single features). At most half of the cells split in one round.

    Returns:
        Centres with the final assignment, ties to the lowest index, and a record of the rounds.

    Note:
        Lengths do not matter: the features are unit rows, and a centre is the direction of their sum.
    """
    least = max(2.0, LEAST_SHARE * len(unit) / maximum)
    cells = nearest_cells(unit, unit_rows(unit.sum(dim=0, keepdim=True)))
    history: list[dict[str, Any]] = []
    similarity: list[Tensor] = []
    while True:
        K = len(cells.centres)
        halves, gain = _halves(unit, cells, least, generator)
        mean = _mean(cells.similarity, cells.index, K)
        pays = gain >= LEAST_GAIN
        if alpha is not None:
            pays &= _mean((cells.similarity >= alpha).to(mean), cells.index, K) < coverage
        room = min(maximum - K, max(1, K // 2))
        chosen = mean.masked_fill(~pays, torch.inf).argsort(stable=True)[: min(room, int(pays.sum()))]
        record = {"size": K + len(chosen), "added": len(chosen), "mean_similarity": float(cells.similarity.mean())}
        history.append(record)
        similarity.append(cells.similarity)
        if len(chosen) == 0:
            break
        centres = cells.centres.clone()
        centres[chosen] = halves[0, chosen]
        cells = kmeans(unit, torch.cat([centres, halves[1, chosen]]), ROUNDS)
    full = bool(pays.any())
    return Grown(kmeans(unit, cells.centres, LAST_ROUNDS), history, similarity, full)


def kmeans(unit: Tensor, centres: Tensor, rounds: int) -> Cells:
    """Rounds of spherical k-means (Dhillon and Modha 2001); a centre that loses all its features stays where it is."""
    cells = nearest_cells(unit, centres)
    for _ in range(rounds):
        sums = _sums(unit, cells.index, len(centres))
        empty = torch.bincount(cells.index, minlength=len(centres)) == 0
        cells = nearest_cells(unit, torch.where(empty[:, None], cells.centres, unit_rows(sums)))
    return cells


def nearest_cells(unit: Tensor, centres: Tensor, *, chunk: int = 16_384) -> Cells:
    """Eq. 5 for unit rows."""
    best = [(part @ centres.T).max(dim=1) for part in unit.split(chunk)]
    return Cells(centres, torch.cat([b.indices for b in best]), torch.cat([b.values for b in best]))


def _halves(unit: Tensor, cells: Cells, least: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The centres [2, K, D] of each cell's halves, and the share [K] of its cosine distance that splitting saves.

    Direction and halves come from every other feature, the gain from the rest: with few features in many channels, any
    split looks good on the features it was made for. The gain is 0 where a half holds fewer than `least` features.
    """
    centres, K = cells.centres, len(cells.centres)
    (learn, index), (check, other) = ((unit[i::2], cells.index[i::2]) for i in (0, 1))
    drawn = torch.randn(centres.shape, generator=generator, device=generator.device, dtype=torch.float64)
    direction = unit_rows(drawn.to(centres))
    inside = (learn * centres[index]).sum(dim=1)  # u . c of the residual u - (u . c) c, which is never built whole

    def along(direction: Tensor) -> Tensor:  # [n / 2] the residual's part along its cell's direction
        return (learn * direction[index]).sum(dim=1) - inside * (centres * direction).sum(dim=1)[index]

    for _ in range(POWER_STEPS):
        across = along(direction)
        pull = torch.zeros_like(centres[:, 0]).index_add_(0, index, inside * across)
        direction = unit_rows(_sums(learn, index, K, across) - pull[:, None] * centres)
    across = along(direction)
    square, cube = ((_mean(across**power, index, K)) for power in (2, 3))
    # In the middle, or, for a small group far out on one side, half way to it: its share of square and cube is the same
    # but for one factor, its distance.
    middles = torch.zeros_like(square), 0.5 * cube / square.clamp_min(1e-12)
    tried = [_try(learn, index + K * (across > middle[index]), check, other, cells, least) for middle in middles]
    second = tried[1][1] > tried[0][1]
    return torch.where(second[:, None], tried[1][0], tried[0][0]), torch.where(second, tried[1][1], tried[0][1])


def _try(
    learn: Tensor, side: Tensor, check: Tensor, other: Tensor, cells: Cells, least: float
) -> tuple[Tensor, Tensor]:  # [2, K, D], [K]
    """Halves from the features `learn`, those of cell e in half `side` = e or e + K; gain on `check` of cells `other`."""
    K = len(cells.centres)
    halves = unit_rows(_sums(learn, side, 2 * K)).view(2, K, -1)
    to_halves = torch.stack([(check * half[other]).sum(dim=1) for half in halves])  # [2, n / 2]
    before, after = 1 - cells.similarity[1::2], 1 - to_halves.amax(dim=0)
    checked = other + K * to_halves.argmax(dim=0)
    counts = torch.bincount(torch.cat([side, checked]), minlength=2 * K).view(2, K)
    distance = _mean(before, other, K)
    gain = 1 - _mean(after, other, K) / distance.clamp_min(1e-12)
    # 1e-5 is what float32 rounding leaves of the cosine distance of equal features
    out = (counts.amin(dim=0) < least) | (distance < 1e-5) | (halves.abs().amax(dim=2) == 0).any(dim=0)
    return halves, gain.masked_fill(out, 0)


def _sums(rows: Tensor, index: Tensor, K: int, weight: Tensor | None = None) -> Tensor:  # [n, D] -> [K, D]
    """Sum of the rows of each cell, repeatable on a CPU."""
    return rows.new_zeros(K, rows.shape[1]).index_add_(0, index, rows if weight is None else rows * weight[:, None])


def _mean(values: Tensor, index: Tensor, K: int) -> Tensor:  # [n] -> [K]
    """Mean of the values of each cell; 0 for an empty one."""
    return values.new_zeros(K).index_add_(0, index, values) / torch.bincount(index, minlength=K).clamp_min(1)
