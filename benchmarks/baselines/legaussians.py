"""LEGaussians (CVPR 2024): features quantised per pixel, and 8 numbers of a Gaussian that tell the index of the code.

The **frozen variant**: published is joint training, where the semantic loss also moves geometry. Published features are CLIP's
of a pyramid of tiles beside DINO's keys (512 + 384); with another teacher there is one part, and no second term of the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from kfgs._rows import EPS, row_norms, unit_rows
from kfgs.cameras.resample import resize_labels
from kfgs.gaussians import Gaussians

from .common import FLOAT, Clock, Fitted, KeptMaps, Task, is_shown, seeded
from .methods import RenderedMethod
from .trainer import Schedule, adam, train

FEATURES = 8
SECOND_WEIGHT = 0.5  # of the DINO part
DOUBT = 0.01  # of every Gaussian at first
LOWEST_SMOOTHING = 0.1  # share of the smoothing loss for a Gaussian without doubt
HOLE = -1


@dataclass(frozen=True)
class LEGaussiansConfig:
    """The published values, or fewer steps."""

    codes: int = 128
    split: tuple[int, ...] = ()
    """Channels of the parts whose cosines are added, with weights 1 and 0.5; () = one part."""
    epochs: int = 300
    """Of the quantiser."""
    images: int = 32
    """Maps in a step of the quantiser."""
    rows: int | None = None
    """Most features of a map in a step; None = all."""
    code_rate: float = 1e-4
    steps: int = 30_000
    feature_rate: float = 1e-3
    doubt_rate: float = 5e-2
    network_rate: float = 1e-3
    smooth_every: int = 10
    smooth_sample: int | None = None
    """Gaussians that the smoothing network looks at in a step; None = all."""
    pixels: int | None = None

    @staticmethod
    def published() -> LEGaussiansConfig:
        """300 epochs, 30,000 steps at the pictures' size."""
        return LEGaussiansConfig()

    @staticmethod
    def short() -> LEGaussiansConfig:
        """For two cores: 40 epochs on 512 features a map at 10 times the rate, 600 steps of 20,000 pixels at higher rates."""
        return LEGaussiansConfig(
            epochs=40, images=16, rows=512, code_rate=1e-3, steps=600, feature_rate=2e-2, network_rate=5e-3,
            smooth_sample=10_000, pixels=20_000,
        )  # fmt: skip

    @staticmethod
    def medium() -> LEGaussiansConfig:
        """For an hour: 120 epochs on 512 features a map at 5 times the rate, 1,500 steps of 40,000 pixels."""
        return LEGaussiansConfig(
            epochs=120, images=16, rows=512, code_rate=5e-4, steps=1_500, feature_rate=1e-2, network_rate=2e-3,
            smooth_sample=10_000, pixels=40_000,
        )  # fmt: skip


def parts_of(values: Tensor, split: tuple[int, ...]) -> Sequence[Tensor]:  # [n, D] -> [n, D_1], ...
    """The parts of features that are compared apart."""
    return values.split(list(split), dim=1) if split else (values,)


def similarities(rows: Tensor, codes: Tensor, split: tuple[int, ...]) -> Tensor:  # [n, D], [K, D] -> [n, K]
    """The cosine of the first part plus half that of the second."""
    pairs = zip(parts_of(rows, split), parts_of(codes, split), strict=True)
    weights = (1.0, SECOND_WEIGHT)
    products = [w * (unit_rows(x) @ unit_rows(e).T) for w, (x, e) in zip(weights, pairs, strict=False)]
    return torch.stack(products).sum(0)


def quantiser_loss(rows: Tensor, codes: Tensor, split: tuple[int, ...] = ()) -> Tensor:  # [n, D], [K, D] -> []
    """For each part its weight times (1 - mean cosine with the chosen code), and the load: sum_k share_k mean softmax_k."""
    found = similarities(rows, codes, split)  # [n, K]
    index = found.argmax(dim=1)
    chosen = found.gather(1, index[:, None]).mean()
    whole = sum((1.0, SECOND_WEIGHT)[: len(split) or 1])
    share = torch.bincount(index, minlength=len(codes)) / len(rows)
    return whole - chosen + (share * found.softmax(dim=1).mean(0)).sum()


def fit_codes(maps: KeptMaps, config: LEGaussiansConfig, generator: torch.Generator) -> Tensor:  # [K, D]
    """Train the codes: AdamW, its rate falling along a line to a tenth after 1,000 epochs."""
    D, K = int(maps[0].shape[2]), config.codes
    codes = ((2 * torch.rand(K, D, generator=generator) - 1) / K).requires_grad_()
    optimizer = torch.optim.AdamW([codes], lr=config.code_rate, weight_decay=0.01)
    for epoch in range(config.epochs):
        optimizer.param_groups[0]["lr"] = config.code_rate * (1 - 0.9 * min(epoch, 1_000) / 1_000)
        for first in range(0, len(maps), config.images):
            parts = []
            for i in range(first, min(first + config.images, len(maps))):
                rows = maps[i].flatten(0, 1)
                rows = rows[rows.any(dim=1)]
                if len(rows) == 0:
                    continue
                if config.rows is not None:
                    rows = rows[torch.randint(len(rows), (config.rows,), generator=generator)]
                parts.append(rows)
            if not parts:
                continue
            loss = quantiser_loss(torch.cat(parts), codes, config.split)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    return codes.detach()


def index_maps(maps: KeptMaps, codes: Tensor, split: tuple[int, ...]) -> list[Tensor]:  # [h, w] int64, -1 = hole
    """The code of every pixel."""
    found = []
    for i in range(len(maps)):
        rows = maps[i].flatten(0, 1)
        index = similarities(rows, codes, split).argmax(dim=1).masked_fill(row_norms(rows) <= EPS, HOLE)
        found.append(index.view(maps[i].shape[:2]))
    return found


def layers(*widths: int) -> torch.nn.Sequential:
    """Linear layers with ReLU between."""
    parts: list[torch.nn.Module] = []
    for inputs, outputs in pairwise(widths):
        parts += [torch.nn.Linear(inputs, outputs), torch.nn.ReLU()]
    return torch.nn.Sequential(*parts[:-1])


class CodeDecoder(torch.nn.Module):
    """From 8 rendered numbers to a mixture of codes: 8-128-256-K, softmax, codes with their own lengths."""

    def __init__(self, codes: Tensor) -> None:
        super().__init__()
        self.register_buffer("codes", codes)
        self.network = layers(FEATURES, 128, 256, len(codes))

    def logits(self, latents: Tensor) -> Tensor:  # [..., 8] -> [..., K]
        """Of the direction of the rendered numbers."""
        return self.network(unit_rows(latents))

    def features(self, latents: Tensor) -> Tensor:  # [n, 8 or 9] -> [n, D]
        """softmax(logits) C."""
        return self.logits(latents[..., :FEATURES]).softmax(dim=-1) @ self.codes

    def scores(self, latents: Tensor, text: Tensor) -> Tensor:  # [n, 8 or 9], [K', D] -> [n, K']
        """softmax(logits) (C t)."""
        return self.logits(latents[..., :FEATURES]).softmax(dim=-1) @ (self.codes @ text.T)

    @property
    def parameters_stored(self) -> int:
        """67,072 for 128 codes."""
        return sum(value.numel() for value in self.network.parameters())


class Indexed(torch.nn.Module):
    """The 8 numbers and the doubt of each Gaussian, the decoder of indices, and the network that smooths in space."""

    def __init__(
        self, geometry: Gaussians, codes: Tensor, config: LEGaussiansConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        count = len(geometry)
        self.own = torch.nn.Parameter(torch.randn(count, FEATURES, generator=generator))
        self.doubt = torch.nn.Parameter(torch.full((count, 1), DOUBT).logit())
        self.decoder = CodeDecoder(codes)
        self.smooth = layers(3, 128, 128, 128, 128, FEATURES)
        self._means, self._config, self._generator = geometry.means, config, generator
        networks = [*self.decoder.network.parameters(), *self.smooth.parameters()]
        self.optimizers = [
            adam([self.own], config.feature_rate),
            adam([self.doubt], config.doubt_rate),
            torch.optim.AdamW(networks, lr=config.network_rate, weight_decay=1e-5),
        ]

    def splatted(self) -> Tensor:  # [N, 9]
        """The 8 numbers, and the doubt in (0, 1)."""
        return torch.cat([self.own, self.doubt.sigmoid()], dim=1)

    def loss(self, rendered: Tensor, target: Tensor, step: int) -> Tensor:  # [H, W, 9], [h, w] int64 -> []
        """Of the indices, of the doubt, and in every 10th step of smoothness; all with weight 1."""
        index = resize_labels(target, (rendered.shape[0], rendered.shape[1]))
        total = index_loss(self.decoder.logits(rendered[..., :FEATURES]), index, rendered[..., FEATURES])
        total = total + doubt_loss(rendered[..., FEATURES])
        if step % self._config.smooth_every == 0:
            rows = slice(None)
            if self._config.smooth_sample is not None and self._config.smooth_sample < len(self.own):
                rows = torch.randint(len(self.own), (self._config.smooth_sample,), generator=self._generator)
            predicted = self.smooth(self._means[rows])
            total = total + smoothing_loss(predicted, self.own[rows], self.doubt[rows, 0].sigmoid())
        return total


def index_loss(logits: Tensor, index: Tensor, doubt: Tensor) -> Tensor:  # [H, W, K], [H, W], [H, W] -> []
    """The mean of (1 - U) CE(logits, index); holes count 0."""
    each = cross_entropy(logits.flatten(0, 1), index.flatten(), ignore_index=HOLE, reduction="none")
    return ((1 - doubt.flatten()) * each).mean()


def doubt_loss(doubt: Tensor) -> Tensor:  # [H, W] -> []
    """The mean of -log(1 - U)."""
    return -torch.log1p(-doubt.clamp_max(1 - 1e-6)).mean()


def smoothing_loss(predicted: Tensor, own: Tensor, doubt: Tensor) -> Tensor:  # [n, 8], [n, 8], [n] -> []
    """The network learns the features of its places, and features follow it: the more, the more doubtful they are."""
    follow = (predicted.detach() - own).square().mean(dim=1)
    weight = doubt.detach() + LOWEST_SMOOTHING * (1 - doubt.detach())
    return (predicted - own.detach()).square().mean() + (follow * weight).mean()


def storage_bytes(gaussians: int, codes: int, channels: int, decoder_parameters: int) -> int:
    """The 8 numbers, the codes, the decoder; the doubt is not needed to ask."""
    return FLOAT * (gaussians * FEATURES + codes * channels + decoder_parameters)


def fit(task: Task, config: LEGaussiansConfig) -> Fitted:
    """Fit the codes, then the indices on a frozen cloud."""
    clock, frozen, maps, generator = Clock(), task.frozen, KeptMaps(task.maps), task.generator()
    with clock.stage("quantiser"):
        codes = fit_codes(maps, config, generator)
        targets = index_maps(maps, codes, config.split)
    with seeded(task.seed):
        model = Indexed(frozen, codes, config, generator)
    schedule = Schedule(config.steps, config.pixels)
    with clock.stage("indices"):
        history = train(frozen, task.cameras, targets, model, schedule, generator=generator, progress=task.progress)
    own, decoder = model.own.detach(), model.decoder.requires_grad_(False)
    text_part = config.split[0] if config.split else codes.shape[1]
    asked = CodeDecoder(codes[:, :text_part])
    asked.network = decoder.network
    known = is_shown(frozen, task.cameras)
    method = RenderedMethod("LEGaussians (frozen)", frozen.replace(features=own), asked, known)
    tensors = {"features": own, "codes": codes}
    tensors |= {f"decoder.{name}": value for name, value in decoder.network.state_dict().items()}
    storage = storage_bytes(len(frozen), len(codes), codes.shape[1], decoder.parameters_stored)

    def codec(rows: Tensor) -> Tensor:  # [n, D] -> [n, D]
        return codes[similarities(rows, codes, config.split).argmax(dim=1), :text_part]

    return Fitted(method, str(FEATURES), storage, tensors, clock.seconds, history, codec)
