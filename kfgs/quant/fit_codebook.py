"""Fit the codebook of a scene: quantisation, optimisation and evolution together (Sec. 3.3.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._card import short_repr
from .._check import as_tensor, check_range, check_shapes, check_whole
from .._progress import Progress, as_progress
from .._rows import ENCODE, EPS, check_directions, row_norms, unit_rows
from .._typed import typed
from .codebook import Codebook
from .evolve import EvolvingCodebook, Tally, prune
from .grow import ROUNDS, grow, kmeans
from .maps import FeatureMaps
from .sampling import SAMPLES, farthest_points, sample_grid

POOL = 32_768  # features that codewords grow on: 67 MB of 512 channels in float32, 365 of each of 90 maps
CODEWORD_RMS = 0.5  # of a codeword's channels: in mode adc the field learns them at absolute rates made for [0, 1]


@typed
@dataclass(frozen=True)
class CodebookConfig:
    """Options of `fit_codebook`. By default the data decide; `CodebookConfig.paper()` follows the paper."""

    adaptive: bool = True
    """Grow by splitting cells and let the data decide (`grow`); False follows Eq. 6-9 to the letter."""
    maximum: int = 255
    """Most codewords (K_max). 255 and holes still fit one byte per pixel; 1,024 won 1.7 points in mode adc on room_0."""
    expand_below: float | None = None
    """The similarity that features should reach (alpha, Eq. 8). None grows as long as a split pays and reports the
    similarity that a share `coverage` of the features has reached."""
    coverage: float = 0.9
    """Share of the features of a cell that must reach alpha; a cell below that is split."""
    prune_above: float = 0.99
    """The later of two codewords is dropped when their similarity is above this (beta, Eq. 9)."""
    grid_step: tuple[int, int] | None = None
    """Sample every so many rows and columns of a map; None: the finest grid within `samples_of`."""
    samples: int = SAMPLES
    """Most features sampled per map if `grid_step` is None: (2, 3) on 360 x 480, all of 90 x 120. If adaptive, at most `POOL`
    of all maps together, for any grid."""
    initial: int = 8
    """Paper only: codewords from farthest-point sampling on the first image (rho)."""
    joins_per_image: int | None = None
    """Paper only: most features of one image that join in one visit, the least similar first. None shares the free slots
    among the images, so that the first ones seen do not fill the codebook; the paper leaves its batches open."""
    epochs: int = 28
    """Paper only: passes over all maps, in random order."""
    learning_rate: float = 8e-4
    """Paper only: Adam's learning rate, in units of the features. It fits features of a length of order 10, as LSeg's
    summed scales have."""
    eps: float = 1e-9
    """Paper only: Adam's epsilon (script)."""
    eager_epochs: int = 2
    """Paper only: epochs at the start with a step after every image (script)."""
    step_every: int = 8
    """Paper only: images per step afterwards, their gradients averaged; an epoch's last step uses the rest."""

    def __post_init__(self) -> None:
        for name in ("initial", "epochs", "step_every", "samples", "maximum"):
            check_whole(name, getattr(self, name), 1)
        if self.joins_per_image is not None:
            check_whole("joins_per_image", self.joins_per_image, 1)
        check_whole("eager_epochs", self.eager_epochs, 0)
        for i, step in enumerate(self.grid_step or ()):
            check_whole(f"grid_step[{i}]", step, 1)
        if self.expand_below is not None:
            check_range("expand_below", self.expand_below, -1, 1)
        if not self.adaptive:
            check_whole("maximum", self.maximum, self.initial)
            if self.expand_below is None:
                raise ValueError(
                    "expand_below: expected a similarity with adaptive = False, got None; the paper has 0.9"
                )
        # Otherwise a new codeword is pruned at once, and joins again.
        check_range("prune_above", self.prune_above, -1 if self.expand_below is None else self.expand_below, 1)
        check_range("coverage", self.coverage, 0, 1, closed=(False, True))
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))
        check_range("eps", self.eps, 0, closed=(False, True))

    @property
    def passes(self) -> int:
        """How often each map is read."""
        return 1 if self.adaptive else self.epochs + 1

    def samples_of(self, maps: int) -> int:
        """Most features taken from each of `maps` maps when `grid_step` is None."""
        return min(self.samples, -(-POOL // maps)) if self.adaptive else self.samples

    @staticmethod
    def paper(**changes: Any) -> CodebookConfig:
        """The paper's method and values; those of its released script if the paper gives none."""
        return CodebookConfig(**({"adaptive": False, "maximum": 100, "expand_below": 0.9} | changes))


@dataclass(frozen=True, eq=False)
class CodebookFit:
    """A fitted codebook and its history."""

    codebook: Codebook
    history: list[dict[str, Any]] = field(repr=False)
    """Per round of growth (paper: per epoch): epoch (from 0), size, added, pruned, coverage and mean_similarity, the last
    two as each round found the codebook, before it grew; with the paper's method also loss (Eq. 6, mean over images)."""
    usage: Tensor  # [K] int64
    """Sampled features of each codeword of the final codebook; unused codewords are kept, as in the paper."""
    coverage: float
    """Share of the sampled features whose similarity to their codeword is at least `alpha`."""
    mean_similarity: float
    """Mean similarity of the sampled features to their codeword."""
    alpha: float
    """The similarity for `coverage`: `expand_below`, or the one that the data reached."""
    note: str | None
    """One line of advice if the book is full or covers too little; None if all is well."""

    __repr__ = short_repr


def fit_codebook(
    maps: FeatureMaps,  # each [h, w, D]
    config: CodebookConfig = CodebookConfig(),
    *,
    generator: torch.Generator | None = None,
    progress: Progress = False,
) -> CodebookFit:
    """Fit a codebook to the feature maps of a scene: K features that stand for all others (Sec. 3.3.1).

    By default: take a pool of features evenly from the maps, grow codewords on it by splitting cells (`grow`), and drop
    those that are too similar (Eq. 9). A codeword is the mean direction of its cell, scaled to channels of root mean
    square `CODEWORD_RMS`. Only directions count: scaling any feature by a positive factor changes nothing but rounding.

    With `CodebookConfig.paper()` (Eq. 5-9): farthest-point sampling on the first image gives the first codewords. Then,
    image by image: quantise (Eq. 5), let badly represented features join (Eq. 8), gather the gradient of the
    class-balanced loss (Eq. 6-7), take an Adam step when one is due, and drop codewords that became too similar (Eq. 9).
    Codewords that survive keep Adam's moments and the gradients gathered so far.

    Args:
        maps: one map per image; only `len(maps)` and `maps[i]` are used, and one map is in memory at a time. Sizes may
            differ, D may not. All-zero features are left out everywhere; half precision is computed in float32. If maps
            have `grid(i, step, samples)`, equal to `sample_grid(maps[i], step, samples=samples)`, it is called instead, so
            that maps on disk read only the samples.
        config: see `CodebookConfig`.
        generator: draws the first directions of splits (paper: the order of the images); None stands for a fresh one
            with seed 0. On a CPU the same generator state gives the same bits.
        progress: True shows a bar; a function is called with each record as it is written to the history.

    Returns:
        The codebook, the history, and how well the final codebook represents the sampled features.

    Raises:
        ValueError: if there is no map, a map has another shape or is not finite, or every feature is zero.
    """
    if len(maps) == 0:
        raise ValueError("maps: expected at least one feature map, got none; encode the training images first")
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    fit = _fit_adaptive if config.adaptive else _fit_paper
    return fit(maps, config, generator, as_progress(progress))


def _fit_adaptive(
    maps: FeatureMaps,
    config: CodebookConfig,
    generator: torch.Generator,
    progress: Progress,
) -> CodebookFit:
    """One pass over the maps that gathers the pool; everything else is done on the pool."""
    pool = _pool(maps, config, progress)
    grown = grow(pool, config.maximum, alpha=config.expand_below, coverage=config.coverage, generator=generator)
    cells = grown.cells
    stays = prune(cells.centres, threshold=config.prune_above)
    pruned = len(cells.centres) - len(stays)
    if pruned:
        cells = kmeans(pool, cells.centres[stays], ROUNDS)
    alpha = config.expand_below
    if alpha is None:
        alpha = float(cells.similarity.sort().values[int((1 - config.coverage) * (len(pool) - 1))])
    history = [
        {"epoch": i, **record, "pruned": 0, "coverage": _share(similarity, alpha)}
        for i, (record, similarity) in enumerate(zip(grown.history, grown.similarity, strict=True))
    ]
    history[-1] |= {"size": len(cells.centres), "pruned": pruned}
    if callable(progress):
        for record in history:
            progress(dict(record))
    codebook = Codebook(cells.centres * (CODEWORD_RMS * cells.centres.shape[1] ** 0.5))
    usage = torch.bincount(cells.index, minlength=codebook.size).cpu()
    coverage, mean = _share(cells.similarity, alpha), float(cells.similarity.mean(dtype=torch.float64))
    note = _note(config, codebook.size, grown.full, coverage, alpha)
    return CodebookFit(codebook, history, usage, coverage, mean, alpha, note)


def _share(similarity: Tensor, alpha: float) -> float:
    """The share of features that are at least so similar."""
    return float((similarity >= alpha).double().mean())


def _pool(maps: FeatureMaps, config: CodebookConfig, progress: Progress) -> Tensor:  # [n, D] unit
    """Unit features from the grid of every map, in order."""
    parts, most = list[Tensor](), config.samples_of(len(maps))

    def look(i: int) -> dict[str, Tensor]:
        features = _samples(maps, i, config, dim=parts[0].shape[1] if parts else None)
        if len(features) > most:  # on a grid that the caller chose
            features = features[torch.arange(most, device=features.device) * len(features) // most]
        return {"features": unit_rows(features)}

    shared = map(look, range(len(maps)))
    for i, part in enumerate(tqdm(shared, desc="codebook", total=len(maps), disable=progress is not True)):
        parts.append(part["features"])
        check_shapes((f"maps[{i}]", parts[-1], ("n", parts[0].shape[1])))
    pool = torch.cat(parts)
    if len(pool) == 0:
        raise ValueError(
            f"maps: expected nonzero features (longer than {EPS:g}), got {len(maps)} maps without; check the teacher"
        )
    return pool


def _note(config: CodebookConfig, size: int, full: bool, coverage: float, alpha: float) -> str | None:
    """One line for the user: what is wrong and what to do."""
    reached = f"{100 * coverage:.0f} % of the features are {alpha:.2f} similar to their codeword"
    if full:
        otherwise = "" if config.expand_below is None else ", or lower expand_below"
        return f"the codebook is full ({size} codewords): {reached}; raise maximum for finer codewords{otherwise}"
    if config.expand_below is not None and coverage < config.coverage:
        return f"{size} codewords, low coverage: {reached}; lower expand_below, or leave it out to follow the data"
    return None


def _fit_paper(
    maps: FeatureMaps,
    config: CodebookConfig,
    generator: torch.Generator,
    progress: Progress,
) -> CodebookFit:
    """Eq. 5-9 as the paper has them, pass after pass."""
    alpha = config.expand_below
    assert alpha is not None  # checked by the config
    book = EvolvingCodebook(
        _first_codewords(maps, config),
        learning_rate=config.learning_rate,
        eps=config.eps,
        expand_below=alpha,
        prune_above=config.prune_above,
        maximum=config.maximum,
        joins=config.joins_per_image or -(-(config.maximum - config.initial) // len(maps)) or 1,
    )

    def look(i: int) -> dict[str, Tensor]:
        return {"features": _samples(maps, i, config, dim=book.dim)}

    history: list[dict[str, Any]] = []
    with tqdm(total=(config.epochs + 1) * len(maps), desc="codebook", disable=progress is not True) as bar:
        for epoch in range(config.epochs):
            order = torch.randperm(len(maps), generator=generator, device=generator.device).tolist()
            tally = Tally(alpha)
            period = 1 if epoch < config.eager_epochs else config.step_every
            for seen, part in enumerate(map(look, order), start=1):
                book.learn_from(part["features"], tally)
                if seen % period == 0 or seen == len(order):
                    book.step(tally)
                bar.update()
            history.append({"epoch": epoch, "size": book.size, **tally.record()})
            bar.set_postfix(K=book.size, coverage=f"{tally.coverage:.3f}")
            if callable(progress):
                progress(dict(history[-1]))
        codebook = Codebook(book.adam.rows)
        usage, tally = torch.zeros(codebook.size, dtype=torch.int64), Tally(alpha)
        for part in map(look, range(len(maps))):
            index, similarity = codebook.nearest(part["features"])
            usage += torch.bincount(index, minlength=codebook.size).cpu()
            tally.see(similarity)
            bar.update()
    full = codebook.size >= config.maximum and tally.coverage < config.coverage
    note = _note(config, codebook.size, full, tally.coverage, alpha)
    return CodebookFit(codebook, history, usage, tally.coverage, tally.mean_similarity, alpha, note)


def _first_codewords(maps: FeatureMaps, config: CodebookConfig) -> Tensor:  # [K, D]
    """Farthest-point sampling on the first image that has features."""
    for i in range(len(maps)):
        features = _samples(maps, i, config)
        if features.shape[0] > 0:
            return features[farthest_points(features, config.initial)]
    raise ValueError(
        f"maps: expected nonzero features (longer than {EPS:g}), got {len(maps)} maps without; check the teacher"
    )


def _samples(maps: FeatureMaps, i: int, config: CodebookConfig, dim: int | None = None) -> Tensor:  # [n, D]
    """The nonzero features of map i that lie on the grid, in at least single precision."""
    grid: Callable[..., Tensor] | None = getattr(maps, "grid", None)
    if grid is not None:
        features = grid(i, config.grid_step, config.samples_of(len(maps)))
        check_shapes((f"maps.grid({i})", features, f"n {dim or 'D'}"))
    else:
        feature_map = as_tensor(f"maps[{i}]", maps[i])  # once: this may read a file
        check_shapes((f"maps[{i}]", feature_map, f"h w {dim or 'D'}"))
        features = sample_grid(feature_map, config.grid_step, samples=config.samples_of(len(maps)))
    # row by row, whatever memory they come in: sums over another layout differ in their last bits
    features = features.to(torch.promote_types(features.dtype, torch.float32)).contiguous()
    norms = row_norms(features)
    check_directions(f"maps[{i}]", features, norms, ENCODE)
    nonzero = norms > EPS
    return features if bool(nonzero.all()) else features[nonzero]
