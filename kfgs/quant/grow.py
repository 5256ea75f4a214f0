"""Fit the codebook of a scene (Sec. 3.3.1). kfgs's grows on a sample: the cell represented worst splits, then k-means runs.

k-means is spherical (Dhillon & Modha 2001): a cell is a group of features that point the same way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import Progress, as_progress, check_range, check_shapes, check_whole
from .._rows import ENCODE, EPS, check_directions, row_norms, unit_rows
from .codebook import Codebook, Nearest, coverage, nearest_rows, with_report
from .maps import SAMPLES, FeatureMaps, all_zero, read_grid
from .paper import PaperCodebook, prune

POOL = 32_768  # features that codewords grow on: 67 MB of 512 channels in float32, 365 of each of 90 maps
CODEWORD_RMS = 0.5  # of a codeword's channels: without an autoencoder the field learns them, at rates made for [0, 1]
COVERAGE = 0.9  # share of the features that reach the similarity alpha, which the history counts by
LEAST_GAIN = 0.05  # of a cell's cosine distance; isotropic noise in n dimensions gains about 2 / (pi n) from a split
LEAST_SHARE = 1 / 16  # of the mean cell's features, at maximum size: fewer are outliers, not content
ROUNDS = 2  # of k-means after each growth: cells only need to be good enough to be ranked
LAST_ROUNDS = 6  # of k-means at the end
POWER_STEPS = 6  # of the power iteration for a cell's widest direction


@dataclass(frozen=True)
class GrownCodebook:
    """A codebook that grows by splitting cells (`grow`); the data decide how far.

    A pool of features is taken evenly from the maps; only their directions count. Codewords that are too similar are dropped
    (Eq. 9). A codeword is the mean direction of its cell, scaled to channels of root mean square `CODEWORD_RMS`.
    """

    maximum: int = 255
    """The most codewords (K_max). 255 and holes still fit one byte per pixel; 1,024 won 1.7 points on
    room_0 without an autoencoder."""
    prune_above: float = 0.99
    """The later of two codewords is dropped when their similarity is above this (beta, Eq. 9)."""

    def __post_init__(self) -> None:
        check_whole("maximum", self.maximum, 1)
        check_range("prune_above", self.prune_above, -1, 1)

    def fit(self, read: Callable[[int], Tensor], maps: int, generator: torch.Generator, progress: Progress) -> Codebook:
        """See `fit_codebook`. `read` gives the sampled features [n, D] of a map, without all-zero ones."""
        pool = torch.cat([unit_rows(read(i)) for i in tqdm(range(maps), desc="codebook", disable=progress is not True)])
        if len(pool) == 0:
            raise all_zero(maps)
        centres, nearest, rounds = grow(pool, self.maximum, generator)
        stays = prune(centres, threshold=self.prune_above)
        if pruned := len(centres) - len(stays):
            centres, nearest = refine(pool, centres[stays], ROUNDS)
        alpha = float(nearest.similarity.sort().values[int((1 - COVERAGE) * (len(pool) - 1))])
        history: list[dict[str, Any]] = []
        for number, (size, added, similarity) in enumerate(rounds):
            history.append({"round": number, "size": size, "added": added, "pruned": 0} | coverage(similarity, alpha))
        history[-1] |= {"size": len(centres), "pruned": pruned}
        if callable(progress):
            for record in history:
                progress(dict(record))
        return with_report(centres * (CODEWORD_RMS * centres.shape[1] ** 0.5), history, nearest, alpha)


def fit_codebook(
    maps: FeatureMaps,  # each [h, w, D]
    options: GrownCodebook | PaperCodebook | None = None,
    *,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
    progress: Progress = False,
) -> Codebook:
    """Fit a codebook to the feature maps of a scene: K features that stand for all others.

    Args:
        maps: one map per image, read one at a time; channels are last, which nothing here can check. Sizes may differ, D may
            not. All-zero features are left out; half precision is computed in float32.
        options: `GrownCodebook` (also if None), kfgs's own, reads each map once; `PaperCodebook` (Eq. 5-9) once per epoch.
        device: computes, and has the codebook; None: that of the maps. Maps are moved one at a time.
        generator: draws the first directions of splits, or the order of the images; None: seed 0. On a CPU the same state
            gives the same bits.
        progress: True shows a bar; a function is called with each record as it is written to the history.

    Returns:
        The codebook; its `report` has the history, and how well it represents the sampled features.

    Raises:
        ValueError: if there is no map, `maps` is one array, a map has another shape or is not finite, or all features are zero.
    """
    options, count = options or GrownCodebook(), len(maps)
    if count == 0:
        raise ValueError("maps: expected at least one feature map, got none; encode the training images first")
    if len(shape := getattr(maps, "shape", ())) == 4:  # [B, h, w, D], or torch's [B, D, h, w]?
        way = "pass [kfgs.cameras.from_bchw(map) for map in maps] if channels are second, list(maps) if they are last"
        raise ValueError(f"maps: expected a list of maps [h, w, D], got one array {tuple(shape)}; {way}")
    samples = options.samples if isinstance(options, PaperCodebook) else min(SAMPLES, -(-POOL // count))
    channels: list[int] = []

    def read(i: int) -> Tensor:  # [n, D] nonzero, in at least single precision
        features = read_grid(maps, i, samples).to(device)
        channels.append(features.shape[-1])
        check_shapes((f"maps[{i}]", features, ("n", channels[0])))
        # row by row, whatever memory they come in: sums over another layout differ in their last bits
        features = features.to(torch.promote_types(features.dtype, torch.float32)).contiguous()
        norms = row_norms(features)
        check_directions(f"maps[{i}]", features, norms, ENCODE)
        return features if bool((norms > EPS).all()) else features[norms > EPS]

    generator = generator or torch.Generator().manual_seed(0)
    return options.fit(read, count, generator, as_progress(progress))


def spherical_kmeans(
    features: Tensor,  # [n, D]
    weights: Tensor,  # [n] >= 0
    clusters: int,
    *,
    rounds: int = 10,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Nearest]:  # [K, D] unit centres, and the nearest of each feature
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


def refine(
    unit: Tensor,  # [n, D] unit rows
    centres: Tensor,  # [K, D] unit rows
    rounds: int,
    *,
    weights: Tensor | None = None,  # [n]
) -> tuple[Tensor, Nearest]:  # [K, D] unit centres, and the nearest of each feature
    """Rounds of averaging and assignment, from given centres; a centre that loses all its features stays where it is."""
    nearest = nearest_rows(unit, centres)
    rows = unit if weights is None else unit * weights[:, None].to(unit)
    for _ in range(rounds):
        sums = group_sums(rows, nearest.codeword, len(centres))
        centres = torch.where(row_norms(sums)[:, None] > EPS, unit_rows(sums), centres)
        nearest = nearest_rows(unit, centres)
    return centres, nearest


def grow(
    unit: Tensor,  # [n, D] unit rows
    maximum: int,
    generator: torch.Generator,
) -> tuple[Tensor, Nearest, list[tuple[int, int, Tensor]]]:  # [K, D] unit centres, the nearest of each feature, rounds
    """Start with one codeword and split cells, the least similar first, until no split pays or `maximum` is reached.

    A cell is split in two across its widest direction. It qualifies by its *mean* similarity, not by its number of
    features, so rare content gets codewords as readily as a wall; by at least 2 `LEAST_SHARE` n / `maximum` features,
    so that a few outliers never lead; and by a split that lowers its cosine distance by `LEAST_GAIN`, which noise
    without structure does not allow. At most half of the cells split in one round.
    Returned for each round: the size after it, the codewords added, and the features' similarities [n] before.
    """
    least = max(2.0, LEAST_SHARE * len(unit) / maximum)
    centres, nearest = refine(unit, unit_rows(unit.sum(dim=0, keepdim=True)), 0)
    rounds: list[tuple[int, int, Tensor]] = []
    while True:
        K = len(centres)
        halves, gain = _halves(unit, centres, nearest, least, generator)
        pays, mean = gain >= LEAST_GAIN, _mean(nearest.similarity, nearest.codeword, K)
        room = min(maximum - K, max(1, K // 2))
        chosen = mean.masked_fill(~pays, torch.inf).argsort(stable=True)[: min(room, int(pays.sum()))]
        rounds.append((K + len(chosen), len(chosen), nearest.similarity))
        if len(chosen) == 0:
            return *refine(unit, centres, LAST_ROUNDS), rounds
        centres = centres.index_copy(0, chosen, halves[0, chosen])
        centres, nearest = refine(unit, torch.cat([centres, halves[1, chosen]]), ROUNDS)


def _halves(
    unit: Tensor, centres: Tensor, nearest: Nearest, least: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The centres [2, K, D] of each cell's halves, and the share [K] of its cosine distance that splitting saves.

    Direction and halves come from every other feature, the gain from the rest: with few features in many channels, any
    split looks good on the features it was made for. The gain is 0 where a half holds fewer than `least` features.
    """
    K = len(centres)
    (learn, cell), (check, check_cell) = ((unit[i::2], nearest.codeword[i::2]) for i in (0, 1))
    drawn = torch.randn(centres.shape, generator=generator, device=generator.device, dtype=torch.float64)
    direction = unit_rows(drawn.to(centres))
    inside = (learn * centres[cell]).sum(dim=1)  # u . c of the residual u - (u . c) c, which is never built whole

    def along(direction: Tensor) -> Tensor:  # [n / 2] the residual's part along its cell's direction
        return (learn * direction[cell]).sum(dim=1) - inside * (centres * direction).sum(dim=1)[cell]

    for _ in range(POWER_STEPS):
        across = along(direction)
        pull = group_sums(inside * across, cell, K)
        direction = unit_rows(group_sums(learn * across[:, None], cell, K) - pull[:, None] * centres)
    across = along(direction)
    distance = _mean(1 - nearest.similarity[1::2], check_cell, K)

    def split(middle: Tensor) -> tuple[Tensor, Tensor]:  # [K] -> [2, K, D], [K]
        """The halves on both sides of a middle, and the gain."""
        side = cell + K * (across > middle[cell])
        halves = unit_rows(group_sums(learn, side, 2 * K)).view(2, K, -1)
        to_halves = torch.stack([(check * half[check_cell]).sum(dim=1) for half in halves])  # [2, n / 2]
        checked = check_cell + K * to_halves.argmax(dim=0)
        counts = torch.bincount(torch.cat([side, checked]), minlength=2 * K).view(2, K)
        gain = 1 - _mean(1 - to_halves.amax(dim=0), check_cell, K) / distance.clamp_min(1e-12)
        # 1e-5 is what float32 rounding leaves of the cosine distance of equal features
        out = (counts.amin(dim=0) < least) | (distance < 1e-5) | (halves.abs().amax(dim=2) == 0).any(dim=0)
        return halves, gain.masked_fill(out, 0)

    square, cube = (_mean(across**power, cell, K) for power in (2, 3))
    # In the middle, or, for a small group far out on one side, half way to it: its share of square and cube is the same
    # but for one factor, its distance.
    (halves, gain), (others, other_gain) = split(torch.zeros_like(square)), split(0.5 * cube / square.clamp_min(1e-12))
    return torch.where((other_gain > gain)[:, None], others, halves), torch.maximum(gain, other_gain)


def group_sums(values: Tensor, group: Tensor, count: int) -> Tensor:  # [n, ...], [n] int64 -> [count, ...]
    """Sum of the values of each group, repeatable on a CPU."""
    return values.new_zeros(count, *values.shape[1:]).index_add_(0, group, values)


def _mean(values: Tensor, group: Tensor, count: int) -> Tensor:  # [n] -> [count]
    """Mean of the values of each group; 0 for an empty one."""
    return group_sums(values, group, count) / torch.bincount(group, minlength=count).clamp_min(1)
