"""Train the autoencoder on the codewords of one scene (Sec. 3.3.2, Eq. 10)."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._card import short_repr
from .._check import check_range, check_whole
from .._progress import Progress, as_progress
from .._rows import row_norms, unit_rows
from .autoencoder import Autoencoder, Layer, mlp, unit_latents
from .codebook import Codebook

BLENDED = 4  # codewords per blend: pixels at borders and noisy Gaussians mix a few
LAST_RATE = 0.02  # of the learning rate, at the last step
NORM_EPS = 1e-5  # added to the variance in batch normalisation, torch's default


@dataclass(frozen=True)
class AutoencoderConfig:
    """Options of the autoencoder and its training.

    The networks are the paper's, or its script's if the paper gives none. The paper trains on the codewords only
    (`AutoencoderConfig.paper()`); by default blends of codewords are learnt too, because a field renders blends.
    """

    latent: int = 9
    """Channels of a latent (d)."""
    encoder: tuple[int, ...] = (256, 128, 64, 32)
    """Hidden widths of E, with batch normalisation and ReLU after each (script)."""
    decoder: tuple[int, ...] = (32, 64, 128, 256, 1024)
    """Hidden widths of Psi, with ReLU after each (script)."""
    steps: int = 1500
    """Adam steps, each on all codewords (paper: 5,000)."""
    learning_rate: float = 1e-3
    """Adam's learning rate at the first step (paper: 1e-4, at every step)."""
    decay: bool = True
    """Lower the learning rate to a fiftieth along a cosine."""
    blends: int = 256
    """Blends of codewords per step: their blended latents are trained to decode to the blended features; 0 as in the paper."""
    weight_decay: float = 5e-6
    """L2 penalty in Adam's gradient (script)."""
    record_every: int = 100
    """Steps between two records of the history."""

    def __post_init__(self) -> None:
        for name in ("latent", "steps", "record_every"):
            check_whole(name, getattr(self, name), 1)
        check_whole("blends", self.blends, 0)
        for name in ("encoder", "decoder"):
            for i, width in enumerate(getattr(self, name)):
                check_whole(f"{name}[{i}]", width, 1)
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))
        check_range("weight_decay", self.weight_decay, 0)

    @staticmethod
    def paper(**changes: Any) -> AutoencoderConfig:
        """The paper's training: 5,000 steps of 1e-4 on the codewords alone."""
        return AutoencoderConfig(**({"steps": 5000, "learning_rate": 1e-4, "decay": False, "blends": 0} | changes))


@dataclass(frozen=True, eq=False)
class AutoencoderFit:
    """A fitted autoencoder, and how well it keeps the codebook apart."""

    autoencoder: Autoencoder
    history: list[dict[str, Any]] = field(repr=False)
    """Every `record_every` steps: step (from 1), loss (Eq. 10, mean over codewords and blends)."""
    latents: Tensor  # [K, d]
    """S' of Sec. 3.3.2: the codewords' latents in [0, 1]."""
    recovered: float
    """Share of codewords whose decoded latent is quantised to that codeword again; below 1, some classes are lost
    whatever the field does: fit longer, or with more latent channels."""
    loss: float
    """Eq. 10 of the finished autoencoder, mean over codewords."""
    min_latent_distance: float
    """Smallest Euclidean distance between two codewords' latents (infinite for one codeword)."""

    __repr__ = short_repr


def fit_autoencoder(
    codebook: Codebook,
    config: AutoencoderConfig = AutoencoderConfig(),
    *,
    generator: torch.Generator | None = None,
    progress: Progress = False,
) -> AutoencoderFit:
    """Fit the scene's autoencoder, which compresses codewords from D to d numbers (Eq. 10).

    The loss is the mean over codewords of |Psi(E(f)) - f|_2.

    With blends, the mean also goes over rows |Psi(sum_j w_j E(f_j)) - f|_2, f the direction of sum_j w_j f_j: `BLENDED`
    codewords drawn at random with weights from the flat Dirichlet distribution, other ones in every step.

    All codewords are one batch, so batch normalisation and the range of the latents are functions of the weights alone.
    When training ends, both are frozen exactly as the decoder saw them last.

    Args:
        codebook: its K codewords, K >= 1; targets are their unit directions.
        config: see `AutoencoderConfig`.
        generator: draws the initial weights and the blends; None stands for a fresh one with seed 0.
        progress: True shows a bar; a function is called with each record as it is written to the history.

    Returns:
        The autoencoder, the history, the latents, and how many codewords are recovered.

    Raises:
        TypeError: if `codebook` is something else.

    Note:
        The released script compares unit outputs with codewords of any length (an error that cannot vanish), and uses
        running statistics that the decoder was not trained with.
    """
    if not isinstance(codebook, Codebook):
        raise TypeError(
            f"codebook: expected a Codebook, got {type(codebook).__name__}; make one with Codebook(codewords)"
        )
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    target = codebook.unit.detach()
    encoder = _linears((codebook.dim, *config.encoder, config.latent), generator, target)
    decoder = _linears((config.latent, *config.decoder, codebook.dim), generator, target)
    norms = [(torch.ones_like(bias), torch.zeros_like(bias)) for _, bias in encoder[:-1]]
    weights = [tensor.requires_grad_() for layer in (*encoder, *norms, *decoder) for tensor in layer]
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)
    history: list[dict[str, Any]] = []
    progress = as_progress(progress)
    with quick_on_a_cpu():
        for step in tqdm(range(1, config.steps + 1), desc="autoencoder", disable=progress is not True):
            latents = unit_latents(_normalised_mlp(encoder, norms, target))
            low, high = latents.detach().amin(), latents.detach().amax()
            rows, wanted = (latents - low) / (high - low).clamp_min(_SMALLEST), target
            if config.blends:
                weights_of = _blends(config.blends, codebook.size, generator, target)
                rows, wanted = torch.cat([rows, weights_of @ rows]), torch.cat([target, unit_rows(weights_of @ target)])
            loss = row_norms(unit_rows(mlp(decoder, rows)) - wanted).mean()
            if config.decay:
                optimizer.param_groups[0]["lr"] = config.learning_rate * _cosine((step - 1) / config.steps)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if step % config.record_every == 0 or step == config.steps:
                history.append({"step": step, "loss": float(loss.detach())})
                if callable(progress):
                    progress(dict(history[-1]))
    with torch.no_grad():
        autoencoder = _freeze(encoder, norms, decoder, target)
        return _report(codebook, autoencoder, history)


@contextmanager
def quick_on_a_cpu() -> Iterator[None]:
    """One torch thread, and denormal numbers taken as zero, for a while.

    The weights of dead units shrink to denormal numbers, which a CPU multiplies some ten times slower. And at most some hundred
    rows leave a second thread little to do, and with other busy programs its waiting slows every step (measured).
    """
    smallest = sys.float_info.min  # its half is a denormal number
    threads, flushed = torch.get_num_threads(), smallest / 2 == 0
    torch.set_num_threads(1)  # the denormal mode is a property of this thread alone
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(flushed)
        torch.set_num_threads(threads)


def _blends(count: int, K: int, generator: torch.Generator, like: Tensor) -> Tensor:  # [count, K], rows sum to 1
    """Weights of `BLENDED` codewords each, uniform on the simplex (normalised exponentials)."""
    which = torch.randint(0, K, (count, BLENDED), generator=generator, device=generator.device).to(like.device)
    drawn = torch.rand(count, BLENDED, generator=generator, device=generator.device, dtype=torch.float64)
    share = -torch.log1p(-drawn).clamp_max(-1e-12)
    share = (share / share.sum(dim=1, keepdim=True)).to(like)
    return like.new_zeros(count, K).scatter_add_(1, which, share)


def _cosine(done: float) -> float:
    """From 1 to `LAST_RATE` as `done` goes from 0 to 1."""
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))


_SMALLEST = 1e-6  # range of the latents of one codeword with one channel


def _linears(widths: Sequence[int], generator: torch.Generator, like: Tensor) -> list[Layer]:
    """Layers with torch.nn.Linear's initial distribution, uniform within 1 / sqrt(inputs), from our own generator."""
    layers = []
    for inputs, outputs in pairwise(widths):
        drawn = torch.rand(outputs, inputs + 1, generator=generator, device=generator.device, dtype=torch.float64)
        both = ((2 * drawn - 1) / inputs**0.5).to(like)
        layers.append((both[:, 1:].contiguous(), both[:, 0].contiguous()))
    return layers


def _statistics(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation that batch normalisation divides by (the variance is the biased one)."""
    return rows.mean(dim=0), (rows.var(dim=0, correction=0) + NORM_EPS).sqrt()


def _normalised_mlp(layers: Sequence[Layer], norms: Sequence[Layer], rows: Tensor) -> Tensor:
    """`mlp` with batch normalisation before each ReLU; written out because torch's refuses a single row."""
    for (weight, bias), (scale, shift) in zip(layers[:-1], norms, strict=True):
        rows = torch.nn.functional.linear(rows, weight, bias)
        mean, deviation = _statistics(rows)
        rows = torch.relu((rows - mean) / deviation * scale + shift)
    return torch.nn.functional.linear(rows, *layers[-1])


def _freeze(encoder: list[Layer], norms: list[Layer], decoder: list[Layer], target: Tensor) -> Autoencoder:
    """Fold batch normalisation, with its statistics over the codebook, into the encoder, and fix the latents' range."""
    folded: list[Layer] = []
    rows = target
    for (weight, bias), (scale, shift) in zip(encoder[:-1], norms, strict=True):
        mean, deviation = _statistics(torch.nn.functional.linear(rows, weight, bias))
        gain = scale / deviation
        folded.append((gain[:, None] * weight, gain * (bias - mean) + shift))
        rows = torch.nn.functional.linear(rows, *folded[-1]).relu()
    folded.append((encoder[-1][0].detach().clone(), encoder[-1][1].detach().clone()))
    latents = unit_latents(mlp(folded, target))
    low = float(latents.min())
    high = max(float(latents.max()), low + _SMALLEST)
    return Autoencoder(tuple(folded), tuple((w.detach().clone(), b.detach().clone()) for w, b in decoder), low, high)


def _report(codebook: Codebook, autoencoder: Autoencoder, history: list[dict[str, Any]]) -> AutoencoderFit:
    latents = autoencoder.encode(codebook.codewords)
    decoded = autoencoder.decode(latents)
    own = torch.arange(codebook.size, device=latents.device)
    distances = torch.cdist(latents, latents, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(torch.inf)
    return AutoencoderFit(
        autoencoder,
        history,
        latents,
        recovered=float((codebook.quantize(decoded) == own).double().mean()),
        loss=float(row_norms(decoded - codebook.unit).mean()),
        min_latent_distance=float(distances.min()),
    )
