"""Train the autoencoder on the codewords of one scene (Sec. 3.3.2, Eq. 10)."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from .._check import check_range, check_whole
from .._progress import Progress, as_progress
from .._rows import row_norms, unit_rows
from .autoencoder import Autoencoder, AutoencoderReport, mlp, unit_latents
from .codebook import Codebook

BLENDED = 4  # codewords per blend: pixels at borders and noisy Gaussians mix a few
LAST_RATE = 0.02  # of the learning rate, at the last step
NORM_EPS = 1e-5  # added to the variance in batch normalisation, torch's default
SMALLEST = 1e-6  # range of the latents of one codeword with one channel


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
        widths = [(f"encoder[{i}]", width) for i, width in enumerate(self.encoder)]
        widths += [(f"decoder[{i}]", width) for i, width in enumerate(self.decoder)]
        for name, value in [
            ("latent", self.latent),
            ("steps", self.steps),
            ("record_every", self.record_every),
            *widths,
        ]:
            check_whole(name, value, 1)
        check_whole("blends", self.blends, 0)
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))
        check_range("weight_decay", self.weight_decay, 0)

    @staticmethod
    def paper(**changes: Any) -> AutoencoderConfig:
        """The paper's training: 5,000 steps of 1e-4 on the codewords alone."""
        return AutoencoderConfig(**({"steps": 5000, "learning_rate": 1e-4, "decay": False, "blends": 0} | changes))


def fit_autoencoder(
    codebook: Codebook,
    config: AutoencoderConfig = AutoencoderConfig(),
    *,
    generator: torch.Generator | None = None,
    progress: Progress = False,
) -> Autoencoder:
    """Fit the scene's autoencoder, which compresses codewords from D to d numbers (Eq. 10).

    The loss is the mean over codewords of |Psi(E(f)) - f|_2. With blends, the mean also goes over rows
    |Psi(sum_j w_j E(f_j)) - f|_2, f the direction of sum_j w_j f_j: `BLENDED` codewords drawn at random with weights from
    the flat Dirichlet distribution, other ones in every step. All codewords are one batch, so batch normalisation and the
    range of the latents are functions of the weights alone. When training ends, both are frozen as the decoder saw them last.
    The generator (None: a fresh one with seed 0) draws the initial weights and the blends. The result's `report` says how
    many codewords are recovered.

    Note:
        The released script compares unit outputs with codewords of any length (an error that cannot vanish), and uses
        running statistics that the decoder was not trained with.
    """
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    target = codebook.unit.detach()
    with torch.device("meta"):  # nothing is drawn from the global generator
        made = Autoencoder(
            (codebook.dim, *config.encoder, config.latent), (config.latent, *config.decoder, codebook.dim)
        )
    made = made.to_empty(device=target.device).to(target.dtype)
    _initialise(made, generator)
    norms = [(torch.ones_like(layer.bias), torch.zeros_like(layer.bias)) for layer in made.encoder[:-1]]
    weights = [*made.parameters(), *(tensor.requires_grad_() for norm in norms for tensor in norm)]
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)
    history: list[dict[str, Any]] = []
    progress = as_progress(progress)
    with quick_on_a_cpu():
        for step in tqdm(range(1, config.steps + 1), desc="autoencoder", disable=progress is not True):
            latents = unit_latents(_normalised_mlp(made.encoder, norms, target))
            low, high = latents.detach().amin(), latents.detach().amax()
            rows, wanted = (latents - low) / (high - low).clamp_min(SMALLEST), target
            if config.blends:
                shares = _blends(config.blends, codebook.size, generator, target)
                rows, wanted = torch.cat([rows, shares @ rows]), torch.cat([target, unit_rows(shares @ target)])
            loss = row_norms(unit_rows(mlp(made.decoder, rows)) - wanted).mean()
            if config.decay:
                falling = 0.5 * (1 + math.cos(math.pi * (step - 1) / config.steps))
                optimizer.param_groups[0]["lr"] = config.learning_rate * (LAST_RATE + (1 - LAST_RATE) * falling)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if step % config.record_every == 0 or step == config.steps:
                history.append({"step": step, "loss": float(loss.detach())})
                if callable(progress):
                    progress(dict(history[-1]))
    made.requires_grad_(False)
    with torch.no_grad():
        _freeze(made, norms, target)
        made.report = _report(codebook, made, history)
    return made


@contextmanager
def quick_on_a_cpu() -> Iterator[None]:
    """One torch thread, and denormal numbers taken as zero, in this thread; both are as before afterwards.

    Weights of dead units shrink to denormal numbers, which a CPU multiplies ten times slower. And at most some hundred rows
    leave a second thread little to do: with other busy programs its waiting slowed a step five times (measured).
    """
    threads, flushed = torch.get_num_threads(), sys.float_info.min / 2 == 0
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(flushed)
        torch.set_num_threads(threads)


def _initialise(made: Autoencoder, generator: torch.Generator) -> None:
    """torch.nn.Linear's initial distribution, uniform within 1 / sqrt(inputs), from our own generator."""
    for layer in (*made.encoder, *made.decoder):
        outputs, inputs = layer.weight.shape
        drawn = torch.rand(outputs, inputs + 1, generator=generator, device=generator.device, dtype=torch.float64)
        both = (2 * drawn - 1) / inputs**0.5
        layer.weight.data.copy_(both[:, 1:])
        layer.bias.data.copy_(both[:, 0])


def _blends(count: int, K: int, generator: torch.Generator, like: Tensor) -> Tensor:  # [count, K], rows sum to 1
    """Weights of `BLENDED` codewords each, uniform on the simplex (normalised exponentials)."""
    which = torch.randint(0, K, (count, BLENDED), generator=generator, device=generator.device).to(like.device)
    drawn = torch.rand(count, BLENDED, generator=generator, device=generator.device, dtype=torch.float64)
    share = -torch.log1p(-drawn).clamp_max(-1e-12)
    share = (share / share.sum(dim=1, keepdim=True)).to(like)
    return like.new_zeros(count, K).scatter_add_(1, which, share)


def _statistics(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation that batch normalisation divides by (the variance is the biased one)."""
    return rows.mean(dim=0), (rows.var(dim=0, correction=0) + NORM_EPS).sqrt()


def _normalised_mlp(layers: nn.ModuleList, norms: list[tuple[Tensor, Tensor]], rows: Tensor) -> Tensor:
    """`mlp` with batch normalisation before each ReLU; written out because torch's refuses a single row."""
    for layer, (scale, shift) in zip(layers[:-1], norms, strict=True):
        rows = layer(rows)
        mean, deviation = _statistics(rows)
        rows = torch.relu((rows - mean) / deviation * scale + shift)
    return layers[-1](rows)  # type: ignore[no-any-return]


def _freeze(made: Autoencoder, norms: list[tuple[Tensor, Tensor]], target: Tensor) -> None:
    """Fold batch normalisation, with its statistics over the codebook, into the encoder, and fix the latents' range."""
    rows = target
    for layer, (scale, shift) in zip(made.encoder[:-1], norms, strict=True):
        mean, deviation = _statistics(layer(rows))
        gain = scale / deviation
        layer.weight.copy_(gain[:, None] * layer.weight)
        layer.bias.copy_(gain * (layer.bias - mean) + shift)
        rows = layer(rows).relu()
    latents = unit_latents(mlp(made.encoder, target))
    low = float(latents.min())
    made.range = torch.tensor([low, max(float(latents.max()), low + SMALLEST)], dtype=torch.float64).to(target.device)


def _report(codebook: Codebook, made: Autoencoder, history: list[dict[str, Any]]) -> AutoencoderReport:
    latents = made.encode(codebook.codewords)
    decoded = made.decode(latents)
    own = torch.arange(codebook.size, device=latents.device)
    distances = torch.cdist(latents, latents, compute_mode="donot_use_mm_for_euclid_dist").fill_diagonal_(torch.inf)
    return AutoencoderReport(
        history,
        recovered=float((codebook.quantize(decoded) == own).double().mean()),
        loss=float(row_norms(decoded - codebook.unit).mean()),
        min_latent_distance=float(distances.min()),
    )
