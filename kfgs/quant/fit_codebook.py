"""Fitting the codebook of a scene: quantisation, optimisation and evolution at once (Sec. 3.3.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import check_range, check_shapes, check_whole
from .codebook import EPS, Codebook, row_norms
from .evolve import admit, prune
from .loss import class_balanced_loss
from .maps import FeatureMaps
from .row_adam import RowAdam
from .sampling import SAMPLES, farthest_points, sample_grid


@dataclass(frozen=True)
class CodebookConfig:
    """How a codebook is fitted; the defaults are the paper's, or its released script's where the paper is silent.

    The learning rate moves every channel of a codeword by up to 8e-4 a step, whatever the features' length, so it fits
    features of a length of order 10, as LSeg's summed scales have; scale it with the teacher's typical feature length.
    """

    initial: int = 8
    """Codewords from farthest-point sampling on the first image (the paper's rho)."""
    maximum: int = 100
    """Most codewords (K_max)."""
    expand_below: float = 0.9
    """A feature joins the codebook when its similarity to its codeword is below this (alpha, Eq. 8)."""
    joins_per_image: int | None = None
    """Most features of one image that join in one visit, the least similar first. None shares the free slots among the
    images, so that the first ones seen do not fill the codebook; the paper leaves the size of its batches open."""
    prune_above: float = 0.99
    """The later of two codewords is dropped when their similarity is above this (beta, Eq. 9)."""
    epochs: int = 28
    """Passes over all maps, in random order."""
    learning_rate: float = 8e-4
    """Adam's learning rate, in units of the features."""
    eps: float = 1e-9
    """Adam's epsilon (script)."""
    eager_epochs: int = 2
    """Epochs at the start with a step after every image (script)."""
    step_every: int = 8
    """Images per step afterwards, their gradients averaged; an epoch's last step takes what is left (script: 8)."""
    grid_step: tuple[int, int] | None = None
    """Every how many rows and columns of a map are looked at; None: the finest grid within `samples`."""
    samples: int = SAMPLES
    """Most features of a map that are looked at when `grid_step` is None: (2, 3) on 360 x 480, all of 90 x 120."""

    def __post_init__(self) -> None:
        for name in ("initial", "epochs", "step_every", "samples"):
            check_whole(name, getattr(self, name), 1)
        if self.joins_per_image is not None:
            check_whole("joins_per_image", self.joins_per_image, 1)
        check_whole("maximum", self.maximum, self.initial)
        check_whole("eager_epochs", self.eager_epochs, 0)
        for i, step in enumerate(self.grid_step or ()):
            check_whole(f"grid_step[{i}]", step, 1)
        check_range("expand_below", self.expand_below, -1, 1)
        # Otherwise what joins is pruned at once, and joins again.
        check_range("prune_above", self.prune_above, self.expand_below, 1)
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))
        check_range("eps", self.eps, 0, closed=(False, True))

    @staticmethod
    def paper() -> CodebookConfig:
        """The paper's values, which are also the defaults."""
        return CodebookConfig()

    @staticmethod
    def cpu() -> CodebookConfig:
        """A third of the passes with as many Adam steps per map (540 instead of 492 on 90 maps): for a slow machine."""
        return CodebookConfig(epochs=10, step_every=2)


@dataclass(frozen=True, eq=False)
class CodebookFit:
    """A fitted codebook and how it came about."""

    codebook: Codebook
    history: list[dict[str, Any]] = field(repr=False)
    """Per epoch: epoch (from 0), size, added, pruned, loss (Eq. 6, mean over images), coverage and mean_similarity; the
    last two as each image found the codebook, before it grew for that image."""
    usage: Tensor  # [K] int64
    """Sampled features of each codeword of the final codebook; unused codewords are kept, as in the paper."""
    coverage: float
    """Share of the sampled features whose similarity to their final codeword is at least alpha. Low with a codebook of
    K_max codewords: the teacher's features scatter by more than alpha allows, so lower `expand_below` (or raise K_max)."""
    mean_similarity: float
    """Mean similarity of the sampled features to their final codeword."""


def fit_codebook(
    maps: FeatureMaps,  # each [h, w, D]
    config: CodebookConfig = CodebookConfig(),
    *,
    generator: torch.Generator | None = None,
    progress: bool = False,
    callback: Callable[[dict[str, Any]], None] | None = None,
) -> CodebookFit:
    """Fit a codebook to the feature maps of a scene (Sec. 3.3.1, Eq. 5-9).

    Farthest-point sampling on the first image gives the first codewords. Then, image by image: quantise (Eq. 5), let
    badly represented features join (Eq. 8), gather the gradient of the class-balanced loss (Eq. 6-7), take an Adam step
    when one is due, and drop codewords that became too similar (Eq. 9). Codewords that survive keep Adam's moments and
    the gradients gathered so far.

    Args:
        maps: one map per image; only `len(maps)` and `maps[i]` are used, and one map is in memory at a time. Sizes may
            differ, D may not. All-zero features are left out everywhere; half precision is computed in float32. Maps
            that offer `grid(i, step, samples)`, equal to `sample_grid(maps[i], step, samples=samples)`, are asked for
            that instead: maps on disk then read only what is looked at.
        config: see `CodebookConfig`.
        generator: draws the order of the images; None stands for a fresh one with seed 0. On a CPU the same generator
            state gives the same bits.
        progress: show a progress bar.
        callback: called with each epoch's record as it is written to the history.

    Returns:
        The codebook, the history, and how well the final codebook represents the sampled features.

    Raises:
        ValueError: if there is no map, a map has another shape or is not finite, or every feature is zero.
    """
    if len(maps) == 0:
        raise ValueError("maps: expected at least one feature map, got none; encode the training images first")
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    book = _EvolvingCodebook(_first_codewords(maps, config), config, images=len(maps))
    history: list[dict[str, Any]] = []
    with tqdm(total=(config.epochs + 1) * len(maps), desc="codebook", disable=not progress) as bar:
        for epoch in range(config.epochs):
            order = torch.randperm(len(maps), generator=generator, device=generator.device).tolist()
            tally = _Tally(config.expand_below)
            period = 1 if epoch < config.eager_epochs else config.step_every
            for seen, i in enumerate(order, start=1):
                book.look_at(_samples(maps, i, config, dim=book.dim), tally)
                if seen % period == 0 or seen == len(order):
                    book.step(tally)
                bar.update()
            history.append({"epoch": epoch, "size": book.size, **tally.record()})
            bar.set_postfix(K=book.size, coverage=f"{tally.coverage:.3f}")
            if callback is not None:
                callback(dict(history[-1]))
        codebook = Codebook(book.adam.rows)
        usage, tally = torch.zeros(codebook.size, dtype=torch.int64), _Tally(config.expand_below)
        for i in range(len(maps)):
            index, similarity = codebook.nearest(_samples(maps, i, config, dim=book.dim))
            usage += torch.bincount(index, minlength=codebook.size).cpu()
            tally.see(similarity)
            bar.update()
    return CodebookFit(codebook, history, usage, tally.coverage, tally.mean_similarity)


class _EvolvingCodebook:
    """Codewords, their optimiser, and the gradients gathered since the last step, which grow and shrink together."""

    def __init__(self, codewords: Tensor, config: CodebookConfig, *, images: int) -> None:
        self.config = config
        self.joins = config.joins_per_image or -(-(config.maximum - config.initial) // images) or 1
        self.adam = RowAdam(codewords, learning_rate=config.learning_rate, eps=config.eps)
        self.gradient, self.gathered = torch.zeros_like(codewords), 0

    @property
    def size(self) -> int:
        return int(self.adam.rows.shape[0])

    @property
    def dim(self) -> int:
        return int(self.adam.rows.shape[1])

    def look_at(self, features: Tensor, tally: _Tally) -> None:  # [n, D] of one image
        """Quantise, expand, and gather the gradient."""
        if features.shape[0] == 0:
            return
        index, similarity = Codebook(self.adam.rows).nearest(features)
        tally.see(similarity)
        room = min(self.joins, self.config.maximum - self.size)
        joining = features[admit(features, similarity, threshold=self.config.expand_below, room=room)]
        if joining.shape[0] > 0:
            newest = Codebook(joining).nearest(features)
            index = torch.where(newest.similarity > similarity, newest.codeword + self.size, index)
            self.adam.append(joining)
            self.gradient = torch.cat([self.gradient, torch.zeros_like(joining)])
            tally.added += joining.shape[0]
        balanced = class_balanced_loss(features, self.adam.rows, index)
        self.gradient, self.gathered = self.gradient + balanced.gradient, self.gathered + 1
        tally.loss += float(balanced.loss)

    def step(self, tally: _Tally) -> None:
        """Optimise with the mean of the gathered gradients, then prune."""
        if self.gathered == 0:  # nothing but zeros seen
            return
        self.adam.step(self.gradient / self.gathered)
        self.gradient, self.gathered = torch.zeros_like(self.gradient), 0
        stays = prune(self.adam.rows, threshold=self.config.prune_above)
        if stays.numel() < self.size:
            tally.pruned += self.size - stays.numel()
            self.adam.keep(stays)
            self.gradient = self.gradient[stays]


class _Tally:
    """What one epoch saw."""

    def __init__(self, alpha: float) -> None:
        self.alpha = alpha
        self.added = self.pruned = self.features = self.covered = self.images = 0
        self.similarity = self.loss = 0.0

    def see(self, similarity: Tensor) -> None:  # [n] of one image
        self.features += similarity.numel()
        self.covered += int((similarity >= self.alpha).sum())
        self.similarity += float(similarity.sum(dtype=torch.float64))
        self.images += 1

    @property
    def coverage(self) -> float:
        return self.covered / max(self.features, 1)

    @property
    def mean_similarity(self) -> float:
        return self.similarity / max(self.features, 1)

    def record(self) -> dict[str, Any]:
        return {
            "added": self.added,
            "pruned": self.pruned,
            "loss": self.loss / max(self.images, 1),
            "coverage": self.coverage,
            "mean_similarity": self.mean_similarity,
        }


def _first_codewords(maps: FeatureMaps, config: CodebookConfig) -> Tensor:  # [K, D]
    """Farthest-point sampling on the first image that has features."""
    for i in range(len(maps)):
        features = _samples(maps, i, config)
        if features.shape[0] > 0:
            return features[farthest_points(features, config.initial)]
    raise ValueError(f"maps: expected nonzero features, got {len(maps)} all-zero maps; check the teacher")


def _samples(maps: FeatureMaps, i: int, config: CodebookConfig, dim: int | None = None) -> Tensor:  # [n, D]
    """The nonzero features of map i that lie on the grid, in at least single precision."""
    grid: Callable[..., Tensor] | None = getattr(maps, "grid", None)
    if grid is not None:
        features = grid(i, config.grid_step, config.samples)
        check_shapes((f"maps.grid({i})", features, f"n {dim or 'D'}"))
    else:
        feature_map = maps[i]  # once: this may read a file
        check_shapes((f"maps[{i}]", feature_map, f"h w {dim or 'D'}"))
        features = sample_grid(feature_map, config.grid_step, samples=config.samples)
    # row by row, whatever memory they come in: sums over another layout differ in their last bits
    features = features.to(torch.promote_types(features.dtype, torch.float32)).contiguous()
    norms = row_norms(features)
    if not bool(torch.isfinite(norms).all()):
        raise ValueError(f"maps[{i}]: expected finite features, got NaN or infinity; encode that image again")
    nonzero = norms > EPS
    return features if bool(nonzero.all()) else features[nonzero]
