"""LangSplat (CVPR 2024): an autoencoder of the scene's features to 3 numbers, learnt by every Gaussian.

A latent is divided by its length before it is splatted, so a rendered map lies inside the unit ball; it is not normalised again.
Published are three levels from masks, each its own run; with features of pixels there is one. So the paper's oracle, "the level
with the highest IoU (for each category in every image)", has nothing to choose from here: it needs SAM's masks at three sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity, mse_loss

from kfgs._rows import unit_rows
from kfgs.cameras.resample import resize_labels
from kfgs.quant.autoencoder import quick_on_a_cpu

from .common import FLOAT, Clock, Fitted, KeptMaps, Task, is_shown, sample_rows, seeded
from .methods import RenderedMethod
from .trainer import Schedule, adam, train

ENCODER = 256, 128, 64, 32, 3
DECODER = 16, 32, 64, 128, 256, 256
COSINE_WEIGHT = 1e-3
NORM_EPS = 1e-9  # added to the length of a latent
START = 1e-2
"""Size of the random first latents. Published is zero, where the gradient of the direction is 1e9 times too large, which Adam's
second moment remembers."""


@dataclass(frozen=True)
class LangSplatConfig:
    """The published values, or fewer steps."""

    epochs: int = 100
    """Of the autoencoder; the best of the last four counts."""
    batch: int = 64
    rate: float = 7e-4
    rows: int = 1_000_000
    """Most features that the autoencoder learns."""
    cosine_over_batch: bool = True
    """Take the autoencoder's cosine along the batch, as the released code does by mistake; False: along the channels."""
    steps: int = 30_000
    """Of the field, for each level."""
    latent_rate: float = 2.5e-3
    pixels: int | None = None

    @staticmethod
    def published() -> LangSplatConfig:
        """100 epochs, 30,000 steps at the pictures' size."""
        return LangSplatConfig()

    @staticmethod
    def short() -> LangSplatConfig:
        """For two cores: 20 epochs of 30,000 rows in batches of 128, 600 steps of 40,000 pixels at 4 times the rate."""
        return LangSplatConfig(20, 128, 7e-4, 30_000, True, 600, 1e-2, 40_000)

    @staticmethod
    def medium() -> LangSplatConfig:
        """For an hour: 50 epochs of 60,000 rows in batches of 128, 2,000 steps of 80,000 pixels at twice the rate."""
        return LangSplatConfig(50, 128, 7e-4, 60_000, True, 2_000, 5e-3, 80_000)


class Autoencoder(torch.nn.Module):
    """512-256-128-64-32-3 with batch normalisation, and 3-16-32-64-128-256-256-512; both ends have unit length."""

    def __init__(self, channels: int, encoder: Sequence[int] = ENCODER, decoder: Sequence[int] = DECODER) -> None:
        super().__init__()
        layers: list[torch.nn.Module] = [torch.nn.Linear(channels, encoder[0])]
        for inputs, outputs in pairwise(encoder):
            layers += [torch.nn.BatchNorm1d(inputs), torch.nn.ReLU(), torch.nn.Linear(inputs, outputs)]
        self.encoder = torch.nn.Sequential(*layers)
        layers = [torch.nn.Linear(encoder[-1], decoder[0])]
        for inputs, outputs in pairwise((*decoder, channels)):
            layers += [torch.nn.ReLU(), torch.nn.Linear(inputs, outputs)]
        self.decoder = torch.nn.Sequential(*layers)

    def encode(self, features: Tensor) -> Tensor:  # [n, D] -> [n, 3]
        """Latents on the unit sphere."""
        return unit_rows(self.encoder(features))

    def features(self, latents: Tensor) -> Tensor:  # [n, 3] -> [n, D]
        """Unit features of latents, which may lie inside the sphere."""
        return unit_rows(self.decoder(latents))

    def scores(self, latents: Tensor, text: Tensor) -> Tensor:  # [n, 3], [K, D] -> [n, K]
        """Cosines up to the length of the decoder's output: the last layer is applied to the rows of text."""
        last = self.decoder[-1]
        return self.decoder[:-1](latents) @ (text @ last.weight).T + text @ last.bias

    def forward(self, features: Tensor) -> Tensor:  # [n, D] -> [n, D]
        """There and back."""
        return self.features(self.encode(features))

    @property
    def decoder_parameters(self) -> int:
        """241,440 for 512 channels."""
        return sum(value.numel() for value in self.decoder.parameters())


def autoencoder_loss(out: Tensor, target: Tensor, *, over_batch: bool) -> Tensor:  # [n, D], [n, D] -> []
    """MSE + 0.001 (1 - mean cosine); `over_batch` takes the cosine of columns instead of rows."""
    return mse_loss(out, target) + COSINE_WEIGHT * (
        1 - cosine_similarity(out, target, dim=0 if over_batch else 1).mean()
    )


def fit_autoencoder(rows: Tensor, config: LangSplatConfig, seed: int) -> Autoencoder:  # [n, D] unit rows
    """Train on rows, and keep the best of the last four epochs by its loss on them."""
    generator = torch.Generator().manual_seed(seed)
    with seeded(seed):
        network = Autoencoder(rows.shape[1])
    optimizer = torch.optim.Adam(network.parameters(), lr=config.rate)
    best, kept = float("inf"), network.state_dict()
    for epoch in range(config.epochs):
        network.train()
        for batch in torch.randperm(len(rows), generator=generator).split(config.batch):
            if len(batch) == 1:
                continue  # batch normalisation needs two rows
            out = network.features(network.encode(rows[batch]))
            loss = autoencoder_loss(out, rows[batch], over_batch=config.cosine_over_batch)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
        if epoch >= config.epochs - 4:
            network.eval()
            with torch.no_grad():
                parts = [network.features(network.encode(part)) for part in rows.split(16_384)]
                value = float(autoencoder_loss(torch.cat(parts), rows, over_batch=config.cosine_over_batch))
            if value < best:
                best, kept = value, {name: value.clone() for name, value in network.state_dict().items()}
    network.load_state_dict(kept)
    return network.eval().requires_grad_(False)


class Latents(torch.nn.Module):
    """A latent per Gaussian, of unit length where it is splatted."""

    def __init__(self, gaussians: int, config: LangSplatConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.raw = torch.nn.Parameter(START * torch.randn(gaussians, 3, generator=generator))
        self.optimizers = [adam([self.raw], config.latent_rate)]

    def splatted(self) -> Tensor:  # [N, 3]
        """Z / (|z| + 1e-9)."""
        return self.raw / (torch.linalg.vector_norm(self.raw, dim=1, keepdim=True) + NORM_EPS)

    def loss(self, rendered: Tensor, target: Tensor, step: int) -> Tensor:  # [H, W, 3], [h, w, 3] -> []
        """The mean over all pixels, also masked ones, of |S[z] M - Z* M|; each pixel has the feature of its cell."""
        wanted = nearest(target, rendered)
        known = ~wanted[..., :1].isnan()
        return (torch.where(known, rendered - wanted, 0)).abs().mean()


def nearest(target: Tensor, like: Tensor) -> Tensor:  # [h, w, c], [H, W, ...] -> [H, W, c]
    """A map at the size of another: each pixel takes the value of the cell that it lies in."""
    h, w, c = target.shape
    index = resize_labels(torch.arange(h * w).view(h, w), (like.shape[0], like.shape[1]))
    return target.reshape(h * w, c)[index]


class EncodedMaps:
    """The teacher's maps as latents, NaN where the feature is all-zero."""

    def __init__(self, maps: KeptMaps, network: Autoencoder) -> None:
        self._maps = []
        with torch.no_grad():
            for i in range(len(maps)):
                rows = maps[i].flatten(0, 1)
                latents = network.encode(unit_rows(rows)).masked_fill(~rows.any(dim=1, keepdim=True), torch.nan)
                self._maps.append(latents.view(*maps[i].shape[:2], -1))

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> Tensor:  # [h, w, 3]
        return self._maps[i]


def storage_bytes(gaussians: int, decoder_parameters: int, levels: int = 3) -> int:
    """The latents of all levels, and the decoder."""
    return FLOAT * (gaussians * 3 * levels + decoder_parameters)


def fit(task: Task, config: LangSplatConfig) -> Fitted:
    """Fit the autoencoder, then the latents of a frozen cloud: one level."""
    clock, frozen, maps, generator = Clock(), task.frozen, KeptMaps(task.maps), task.generator()
    with clock.stage("autoencoder"):
        rows = unit_rows(sample_rows(maps, config.rows, generator))
        with quick_on_a_cpu():
            network = fit_autoencoder(rows, config, task.seed)
        targets = EncodedMaps(maps, network)
    model, schedule = Latents(len(frozen), config, generator), Schedule(config.steps, config.pixels)
    with clock.stage("latents"):
        history = train(frozen, task.cameras, targets, model, schedule, generator=generator, progress=task.progress)
    own = model.splatted().detach()
    method = RenderedMethod("LangSplat", frozen.replace(features=own), network, is_shown(frozen, task.cameras))
    tensors = {"latents": own} | {f"decoder.{name}": value for name, value in network.decoder.state_dict().items()}
    storage = storage_bytes(len(frozen), network.decoder_parameters, levels=1)
    return Fitted(method, "3", storage, tensors, clock.seconds, history, network.forward)
