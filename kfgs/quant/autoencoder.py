"""The scene's autoencoder (Sec. 3.3.2): codewords from D to d numbers and back, trained on them and on blends (Eq. 10)."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from .._card import short_repr
from .._check import Progress, as_progress, check_range, check_whole
from .._rows import row_norms, unit_rows
from .codebook import Codebook, as_channels
from .store import Stored

CHUNK = 8192  # rows at a time: the decoder's widest layer then takes 32 MB
BLENDED = 4  # codewords per blend: pixels at borders and noisy Gaussians mix a few
LAST_RATE = 0.02  # of the learning rate, at the last step
NORM_EPS = 1e-5  # added to the variance in batch normalisation, torch's default
SMALLEST = 1e-6  # range of the latents of one codeword with one channel
RECORDED = 100  # steps between two records of the history


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

    def __post_init__(self) -> None:
        widths = {f"{name}[{i}]": n for name in ("encoder", "decoder") for i, n in enumerate(getattr(self, name))}
        for name, value in {"latent": self.latent, "steps": self.steps, **widths}.items():
            check_whole(name, value, 1)
        check_whole("blends", self.blends, 0)
        check_range("learning_rate", self.learning_rate, 0, closed=(False, True))
        check_range("weight_decay", self.weight_decay, 0)

    @staticmethod
    def paper(**changes: Any) -> AutoencoderConfig:
        """The paper's training: 5,000 steps of 1e-4 on the codewords alone."""
        return AutoencoderConfig(**({"steps": 5000, "learning_rate": 1e-4, "decay": False, "blends": 0} | changes))


@dataclass(frozen=True, eq=False)
class AutoencoderReport:
    """How an autoencoder was fitted, and how well it keeps the codebook apart."""

    history: list[dict[str, Any]] = field(repr=False)
    """Every 100 steps: step (from 1), loss (Eq. 10, mean over codewords and blends)."""
    recovered: float
    """Share of codewords whose decoded latent is quantised to that codeword again; below 1, some classes are lost
    whatever the field does: fit longer, or with more latent channels."""
    loss: float
    """Eq. 10 of the finished autoencoder, mean over codewords."""

    __repr__ = short_repr


class Autoencoder(nn.Module, Stored):
    """Encoder E and decoder Psi of Eq. 10: D channels to d latents and back.

    Both are linear layers with ReLU between. The encoder was trained with batch normalisation; when fitting ended, its
    statistics over the whole codebook were folded into the linear layers, and the range of the latents was frozen. So
    each row is treated alone: the latent of a codeword does not depend on what else is in the batch.

    **Convention**: a latent has unit length and is then mapped from `range` to [0, 1], the same for all channels.
    (A single channel keeps its length: a unit scalar would only say -1 or 1, and have no gradient to learn from.)
    """

    kind = "autoencoder"
    encoder: Any  # torch.nn.ModuleList of torch.nn.Linear
    decoder: Any
    range: Tensor  # [2] float64, lowest and highest number in the codewords' unit latents
    report: AutoencoderReport | None = None  # set by `fit_autoencoder`; not saved

    def __init__(self, encoder: Sequence[int], decoder: Sequence[int]) -> None:
        """`encoder`: channels D, hidden widths, d. `decoder`: channels d, hidden widths, D."""
        super().__init__()
        if (encoder[0], encoder[-1]) != (decoder[-1], decoder[0]):
            raise ValueError(f"decoder: expected widths from {encoder[-1]} to {encoder[0]}, got {tuple(decoder)}")
        self.encoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(encoder))
        self.decoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(decoder))
        self.register_buffer("range", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def __repr__(self) -> str:
        widths = [self.dim, *(len(layer.bias) for layer in (*self.encoder, *self.decoder))]
        return f"Autoencoder({self.dim} channels to {self.latent} latents and back, widths {widths})"

    @property
    def dim(self) -> int:
        """Channels of a feature, D."""
        return int(self.encoder[0].weight.shape[1])

    @property
    def latent(self) -> int:
        """Channels of a latent, d."""
        return int(self.encoder[-1].weight.shape[0])

    @property
    def decoder_parameters(self) -> int:
        """Weights and biases of the decoder: counted as storage in Table 1 (831,744 for D = 512, d = 9)."""
        return sum(value.numel() for value in self.decoder.parameters())

    def encode(self, features: Tensor) -> Tensor:  # [..., D] -> [..., d] in [0, 1]
        """The latents of features (E), by their directions. Codewords fill [0, 1]; another latent is clamped to it."""
        low, high = self.range  # not as Python's numbers, which torch.compile could not trace
        unit = _by_chunk("features", features, self.dim, lambda rows: unit_latents(mlp(self.encoder, unit_rows(rows))))
        return ((unit - low) / (high - low)).clamp(0, 1)

    def decode(self, latents: Tensor) -> Tensor:  # [..., d] -> [..., D]
        """The features of latents (Psi in Sec. 3.4), as unit rows. Differentiable."""
        return _by_chunk("latents", latents, self.latent, lambda rows: unit_rows(mlp(self.decoder, rows)))

    def to(self, *args: Any, **kwargs: Any) -> Autoencoder:
        """A copy, moved or converted, as all objects of kfgs have it; `torch.nn.Module.to` would change this one."""
        return nn.Module.to(deepcopy(self), *args, **kwargs)

    @classmethod
    def from_state_dict(cls, tensors: Mapping[str, Tensor]) -> Autoencoder:
        """An autoencoder from `state_dict`, with the widths of the weights. Other names are ignored."""
        try:
            widths = []
            for name in ("encoder", "decoder"):
                layers = sum(key.startswith(f"{name}.") and key.endswith(".weight") for key in tensors)
                outputs = [len(tensors[f"{name}.{i}.weight"]) for i in range(layers)]
                widths.append([tensors[f"{name}.0.weight"].shape[1], *outputs])
            with torch.device("meta"):
                made = cls(*widths)
            made.load_state_dict({name: tensors[name] for name in made.state_dict()}, assign=True)
        except (LookupError, RuntimeError) as error:
            raise ValueError(f"tensors: expected those of Autoencoder.state_dict, got others ({error})") from error
        low, high = made.range.tolist()
        if not -torch.inf < low < high < torch.inf:
            raise ValueError(f"range: expected low < high, got {low:g}, {high:g}")
        return made.requires_grad_(False)


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
    generator = generator or torch.Generator().manual_seed(0)
    target = codebook.unit.detach()
    K, D = target.shape  # codewords, channels
    with torch.device("meta"):  # nothing is drawn from the global generator
        made = Autoencoder((D, *config.encoder, config.latent), (config.latent, *config.decoder, D))
    made = made.to_empty(device=target.device).to(target.dtype)
    for layer in (*made.encoder, *made.decoder):  # torch.nn.Linear's distribution: uniform within 1 / sqrt(inputs)
        outputs, inputs = layer.weight.shape
        drawn = torch.rand(outputs, inputs + 1, generator=generator, device=generator.device, dtype=torch.float64)
        both = (2 * drawn - 1) / inputs**0.5
        layer.weight.data.copy_(both[:, 1:])
        layer.bias.data.copy_(both[:, 0])
    norms = [(torch.ones_like(layer.bias), torch.zeros_like(layer.bias)) for layer in made.encoder[:-1]]
    weights = [*made.parameters(), *(tensor.requires_grad_() for norm in norms for tensor in norm)]
    optimizer = torch.optim.Adam(weights, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)
    history: list[dict[str, Any]] = []
    progress = as_progress(progress)
    with quick_on_a_cpu():
        for step in tqdm(range(1, config.steps + 1), desc="autoencoder", disable=progress is not True):
            latents = _normalised_latents(made, norms, target)
            low, high = latents.detach().aminmax()
            rows, wanted = (latents - low) / (high - low).clamp_min(SMALLEST), target
            if config.blends:
                shares = _blends(config.blends, K, generator, target)
                rows, wanted = torch.cat([rows, shares @ rows]), torch.cat([target, unit_rows(shares @ target)])
            loss = row_norms(unit_rows(mlp(made.decoder, rows)) - wanted).mean()
            if config.decay:
                falling = 0.5 * (1 + math.cos(math.pi * (step - 1) / config.steps))
                optimizer.param_groups[0]["lr"] = config.learning_rate * (LAST_RATE + (1 - LAST_RATE) * falling)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if step % RECORDED == 0 or step == config.steps:
                history.append({"step": step, "loss": float(loss.detach())})
                if callable(progress):
                    progress(dict(history[-1]))
    made.requires_grad_(False)
    with torch.no_grad():
        low, high = _normalised_latents(made, norms, target, freeze=True).double().aminmax()
        made.range = torch.stack([low, torch.maximum(high, low + SMALLEST)])
        decoded = made.decode(made.encode(codebook.codewords))
        recovered = codebook.quantize(decoded) == torch.arange(K, device=decoded.device)
        loss = row_norms(decoded - codebook.unit).mean()
        made.report = AutoencoderReport(history, float(recovered.double().mean()), float(loss))
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


def _blends(count: int, K: int, generator: torch.Generator, like: Tensor) -> Tensor:  # [count, K], rows sum to 1
    """Weights of `BLENDED` codewords each, uniform on the simplex (normalised exponentials)."""
    which = torch.randint(0, K, (count, BLENDED), generator=generator, device=generator.device).to(like.device)
    drawn = torch.rand(count, BLENDED, generator=generator, device=generator.device, dtype=torch.float64)
    share = -torch.log1p(-drawn).clamp_max(-1e-12)
    share = (share / share.sum(dim=1, keepdim=True)).to(like)
    return like.new_zeros(count, K).scatter_add_(1, which, share)


def _normalised_latents(
    made: Autoencoder, norms: list[tuple[Tensor, Tensor]], rows: Tensor, *, freeze: bool = False
) -> Tensor:  # [K, D] -> [K, d]
    """Unit latents with batch normalisation before each ReLU; written out because torch's refuses a single row.

    With `freeze`, its statistics over these rows become part of the linear layers.
    """
    for layer, (scale, shift) in zip(made.encoder[:-1], norms, strict=True):
        sums = layer(rows)
        mean, deviation = sums.mean(dim=0), (sums.var(dim=0, correction=0) + NORM_EPS).sqrt()
        if freeze:
            gain = scale / deviation
            layer.weight.mul_(gain[:, None])
            layer.bias.sub_(mean).mul_(gain).add_(shift)
        rows = torch.relu(layer(rows) if freeze else (sums - mean) / deviation * scale + shift)
    return unit_latents(made.encoder[-1](rows))


def mlp(layers: Iterable[nn.Module], rows: Tensor) -> Tensor:  # [n, in] -> [n, out]
    """Linear layers with ReLU between."""
    for i, layer in enumerate(layers):
        rows = layer(rows.relu() if i else rows)
    return rows


def unit_latents(latents: Tensor) -> Tensor:  # [n, d]
    """Unit length, unless there is only one channel."""
    return unit_rows(latents) if latents.shape[1] > 1 else latents


def _by_chunk(name: str, x: Tensor, width: int, function: Callable[[Tensor], Tensor]) -> Tensor:
    x = as_channels(name, x, width, floating=True)
    rows = torch.cat([function(part) for part in x.reshape(-1, width).split(CHUNK)])  # one empty part of no rows
    return rows.reshape(*x.shape[:-1], rows.shape[1])
