"""One trainer for all baselines: render a view of frozen Gaussians, compare, step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.quant.maps import FeatureMaps
from kfgs.splat import rasterize

from .common import within


class Model(Protocol):
    """What is learnt per Gaussian and per pixel."""

    optimizers: Sequence[torch.optim.Optimizer]

    def splatted(self) -> Tensor:  # [N, d]
        """What the Gaussians show: the hook before splatting."""
        ...

    def loss(self, rendered: Tensor, target: Tensor, step: int) -> Tensor:  # [H, W, d], target, from 1 -> []
        """Compare a rendered map with its target: the hook after splatting."""
        ...


@dataclass(frozen=True)
class Schedule:
    """How long, and at which size."""

    steps: int
    """One view each; every view once, in random order, before any comes again."""
    pixels: int | None = None
    """Most pixels of a rendered view; None renders at the camera's size."""
    report_every: int = 50


def train(
    geometry: Gaussians,
    cameras: Sequence[Camera],
    targets: FeatureMaps | Sequence[Any],
    model: Model,
    schedule: Schedule,
    *,
    generator: torch.Generator,
    progress: bool = False,
) -> list[dict[str, Any]]:
    """Train what a model adds to frozen Gaussians; rows of step, mean loss and seconds.

    Means, covariances and opacities are detached, so no loss moves them.
    """
    frozen = geometry.replace(features=None, sh=None, labels=None).detach()
    views = [within(camera, schedule.pixels) for camera in cameras]
    history: list[dict[str, Any]] = []
    queue: list[int] = []
    start, total, last = time.perf_counter(), 0.0, 0
    for step in tqdm(range(1, schedule.steps + 1), desc="train", unit="step", disable=not progress):
        if not queue:
            queue = torch.randperm(len(views), generator=generator).tolist()
        view = queue.pop()
        rendered = rasterize(frozen.replace(features=model.splatted()), views[view]).map
        loss = model.loss(rendered, targets[view], step)
        for optimizer in model.optimizers:
            optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for optimizer in model.optimizers:
            optimizer.step()
        total += float(loss.detach())
        if step % schedule.report_every == 0 or step == schedule.steps:
            seconds = time.perf_counter() - start
            history.append({"step": step, "loss": total / (step - last), "seconds": round(seconds, 2)})
            total, last = 0.0, step
    return history


def adam(parameters: Sequence[Tensor], rate: float, eps: float = 1e-15) -> torch.optim.Adam:
    """Adam as 3DGS uses it: its tiny epsilon suits gradients of a mean over all pixels."""
    return torch.optim.Adam(parameters, lr=rate, eps=eps, fused=True)
