"""A whole 9-channel training step, and its stages: as `fit_field` takes it."""

from __future__ import annotations

from typing import Any

import torch
from engines_runners import (
    Calls,
    Inputs,
    composite_projected,
)
from torch import Tensor

from kfgs.fields.loss import l1_loss
from kfgs.fields.optimizer import to_gaussians, to_raw
from kfgs.splat import Projected, bin_tiles, project, rasterize

RATE = 1e-6  # learning rate: the scene stays what it is while it is being measured


def target_of(inputs: Inputs) -> Tensor:
    """A map to compare with, as large as the rendered one: noise, so that every gradient is as large as any."""
    g = torch.Generator().manual_seed(2)
    return torch.randn(inputs.grad_maps.shape, generator=g).to(inputs.grad_maps)


def kfgs_step(engine: str, inputs: Inputs) -> tuple[Calls, Calls]:
    """The step, and its stages; each stage works on what the one before it left."""
    raw = {name: value.clone().requires_grad_() for name, value in to_raw(inputs.gaussians).items()}
    leaves = list(raw.values())
    adam = torch.optim.Adam(leaves, lr=RATE, fused=True)
    target = target_of(inputs)
    width, height = inputs.case.width, inputs.case.height

    def step() -> None:
        rendering = rasterize(to_gaussians(raw, inputs.gaussians), inputs.camera, engine=engine)
        l1_loss(rendering.map, rendering.alpha, target).backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    kept: dict[str, Any] = {}

    def projecting() -> None:
        kept["projected"] = project(to_gaussians(raw, inputs.gaussians), inputs.camera, engine=engine)

    def binning() -> None:
        projected = Projected(*(value.detach() for value in kept["projected"]))
        kept["tiles"] = bin_tiles(projected, width, height, engine=engine)

    def compositing() -> None:
        projected: Projected = kept["projected"]
        floats = [value.detach().requires_grad_() for value in projected[:2] + projected[3:4]]
        names = "means2d", "conics", "opacities"
        cut = projected._replace(**dict(zip(names, floats, strict=True)))
        features = raw["features"].detach().requires_grad_()
        kept["inputs"] = [*floats, features]
        kept["maps"], kept["alphas"] = composite_projected(cut, features, kept["tiles"], engine)

    def loss() -> None:
        maps = kept["maps"].detach().requires_grad_()
        l1_loss(maps, kept["alphas"].detach(), target).backward()
        kept["grad"] = maps.grad

    def compositing_backward() -> None:
        kept["grads"] = torch.autograd.grad(kept["maps"], kept["inputs"], kept["grad"])

    def projecting_backward() -> None:
        projected: Projected = kept["projected"]
        outputs = projected.means2d, projected.conics, projected.opacities
        found = torch.autograd.grad(outputs, leaves[:4], kept["grads"][:3])
        for leaf, grad in zip(leaves, (*found, kept["grads"][3]), strict=True):
            leaf.grad = grad

    stages = {
        "project": projecting,
        "bin": binning,
        "composite": compositing,
        "loss and its backward": loss,
        "composite backward": compositing_backward,
        "project backward": projecting_backward,
        "Adam": adam.step,
    }
    return {"step": step}, stages
