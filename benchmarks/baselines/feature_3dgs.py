"""Feature 3DGS (CVPR 2024): the teacher's 512 channels on every Gaussian, or 128 and a 1x1 convolution.

Its rasteriser passes no gradient from features to the weights of blending, so geometry follows the pictures alone: features on
frozen Gaussians are the same method, but for what a young Gaussian inherits when it is split.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kfgs.cameras import resize_map

from .common import FLOAT, Clock, Fitted, KeptMaps, Task, is_shown, seeded
from .methods import LinearDecoder, RenderedMethod
from .trainer import Schedule, adam, train


@dataclass(frozen=True)
class Feature3DGSConfig:
    """The published values, or fewer steps at higher rates."""

    channels: int | None = None
    """Of a Gaussian, decoded by a convolution; None takes the teacher's channels, without one."""
    steps: int = 30_000
    feature_rate: float = 1e-3
    convolution_rate: float = 1e-4
    pixels: int | None = None
    """Most pixels of a rendered view; None renders at the camera's size."""

    @staticmethod
    def published(channels: int | None = None) -> Feature3DGSConfig:
        """30,000 steps at the pictures' size."""
        return Feature3DGSConfig(channels)

    @staticmethod
    def short(channels: int | None = None) -> Feature3DGSConfig:
        """For two cores: 240 steps at 15 times the rate (the convolution's 30 times), of 40,000 pixels (512 channels: 20,000)."""
        return Feature3DGSConfig(channels, 240, 1.5e-2, 3e-3, 40_000 if channels else 20_000)

    @staticmethod
    def medium(channels: int | None = None) -> Feature3DGSConfig:
        """For an hour: 800 steps of 40,000 pixels, at 6 times the rate (the convolution's 12 times)."""
        return Feature3DGSConfig(channels, 800, 6e-3, 1.2e-3, 40_000)


class Features(torch.nn.Module):
    """Features of Gaussians, zero at first, and the convolution behind them."""

    def __init__(self, gaussians: int, teacher: int, config: Feature3DGSConfig) -> None:
        super().__init__()
        self.own = torch.nn.Parameter(torch.zeros(gaussians, config.channels or teacher))
        self.convolution = torch.nn.Linear(config.channels, teacher) if config.channels else None
        self.optimizers = [adam([self.own], config.feature_rate)]
        if self.convolution is not None:
            weights = list(self.convolution.parameters())
            self.optimizers.append(adam(weights, config.convolution_rate, eps=1e-8))

    def splatted(self) -> Tensor:  # [N, d]
        """The features as they are."""
        return self.own

    def loss(self, rendered: Tensor, target: Tensor, step: int) -> Tensor:  # [H, W, d], [h, w, D] -> []
        """The mean over all pixels and channels of |conv(resize(rendered)) - teacher|."""
        small = resize_map(rendered, (target.shape[0], target.shape[1]), align_corners=True)
        found = small if self.convolution is None else self.convolution(small)
        return (found - target).abs().mean()


def storage_bytes(gaussians: int, channels: int, teacher: int) -> int:
    """The features, and the convolution if there is one: no geometry, no colours."""
    convolution = 0 if channels == teacher else teacher * channels + teacher
    return FLOAT * (gaussians * channels + convolution)


def fit(task: Task, config: Feature3DGSConfig) -> Fitted:
    """Learn the features of a frozen cloud."""
    clock, frozen, maps = Clock(), task.frozen, KeptMaps(task.maps)
    teacher = int(maps[0].shape[2])
    with seeded(task.seed):
        model = Features(len(frozen), teacher, config)
    schedule = Schedule(config.steps, config.pixels)
    with clock.stage("features"):
        history = train(frozen, task.cameras, maps, model, schedule, generator=task.generator(), progress=task.progress)
    own, tensors = model.own.detach(), {"features": model.own.detach()}
    decoder = LinearDecoder()
    if model.convolution is not None:
        weight, bias = model.convolution.weight.detach(), model.convolution.bias.detach()
        decoder, tensors = LinearDecoder(weight, bias), tensors | {"weight": weight, "bias": bias}
    method = RenderedMethod("Feature 3DGS", frozen.replace(features=own), decoder, is_shown(frozen, task.cameras))
    storage = storage_bytes(len(frozen), own.shape[1], teacher)
    return Fitted(method, str(own.shape[1]), storage, tensors, clock.seconds, history)
