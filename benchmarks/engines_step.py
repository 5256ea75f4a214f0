"""A whole 9-channel training step, and its stages: kfgs's as `fit_field` takes it, and the prototype's."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from engines_runners import (
    Calls,
    Inputs,
    composite_projected,
    prototype,
    prototype_camera,
    prototype_parameters,
)
from torch import Tensor

from kfgs.fields import GaussianParams
from kfgs.fields.loss import l1_loss
from kfgs.splat import Projected, bin_tiles, project, rasterize

RATE = 1e-6  # learning rate: the scene stays what it is while it is being measured


def target_of(inputs: Inputs) -> Tensor:
    """A map to compare with, as large as the rendered one: noise, so that every gradient is as large as any."""
    g = torch.Generator().manual_seed(2)
    return torch.randn(inputs.grad_maps.shape, generator=g).to(inputs.grad_maps)


def kfgs_step(engine: str, inputs: Inputs) -> tuple[Calls, Calls]:
    """The step, and its stages; each stage works on what the one before it left."""
    params = GaussianParams.from_gaussians(inputs.gaussians).map(lambda value: value.requires_grad_())
    leaves = list(params.to_tensors().values())
    adam = torch.optim.Adam(leaves, lr=RATE, fused=True)
    target = target_of(inputs)
    width, height = inputs.case.width, inputs.case.height

    def step() -> None:
        rendering = rasterize(params.activated(), inputs.camera, engine=engine)
        l1_loss(rendering.map, rendering.alpha, target).backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    kept: dict[str, Any] = {}

    def projecting() -> None:
        kept["projected"] = project(params.activated(), inputs.camera, engine=engine)

    def binning() -> None:
        projected = Projected(*(value.detach() for value in kept["projected"]))
        kept["tiles"] = bin_tiles(projected, width, height, engine=engine)

    def compositing() -> None:
        projected: Projected = kept["projected"]
        floats = [value.detach().requires_grad_() for value in projected[:2] + projected[3:4]]
        names = "means2d", "conics", "opacities"
        cut = projected._replace(**dict(zip(names, floats, strict=True)))
        features = params.features.detach().requires_grad_()
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


def prototype_step(inputs: Inputs) -> tuple[Calls, Calls]:
    """The prototype's step on the same cloud, camera and target, and its stages by its own names."""
    engine, workers = prototype("engine"), torch.get_num_threads()
    numba.set_num_threads(workers)
    leaves = [value.requires_grad_() for value in prototype_parameters(inputs.gaussians)]
    adam = torch.optim.Adam(leaves, lr=RATE, fused=True)
    target = target_of(inputs).permute(2, 0, 1).contiguous()
    camera, width, height = prototype_camera(inputs.camera), inputs.case.width, inputs.case.height

    def step() -> None:
        maps, _ = engine.Render.apply(*leaves, camera, width, height)
        (maps - target).abs().mean().backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    return {"step": step}, _prototype_stages(engine, leaves, camera, target, workers)


def _prototype_stages(engine: Any, leaves: list[Tensor], camera: np.ndarray, target: Tensor, workers: int) -> Calls:
    channels, height, width = target.shape
    columns, lines = -(-width // 16), -(-height // 16)
    arrays, N = [value.detach().numpy() for value in leaves], len(leaves[0])
    kernels = engine.kernels(channels)
    packed, depths, boxes = torch.empty(N * kernels["ST"]).numpy(), np.empty(N, np.float32), np.empty((N, 4), np.int16)
    copies = [torch.nn.Parameter(value.detach().clone()) for value in leaves]
    adam = torch.optim.Adam(copies, lr=RATE, fused=True)
    for copy in copies:
        copy.grad = torch.randn_like(copy)
    kept: dict[str, Any] = {}

    def projecting() -> None:
        engine.proj_fwd(*arrays, camera, packed, kernels["ST"], depths, boxes, workers)

    def binning() -> None:
        order = engine.depth_order(depths, boxes)
        rows, offsets = engine.bin_exact(packed, kernels["ST"], boxes, order, columns, lines, workers)
        kept["lists"] = packed, rows, offsets, engine.balance(offsets, workers), columns, lines

    def compositing() -> None:
        maps, left = torch.empty(channels, lines * 16, columns * 16), torch.empty(lines * 16, columns * 16)
        kept["trace"] = maps.view(-1).numpy(), left.view(-1).numpy(), np.empty(columns * lines, np.int64)
        kernels["fwd"](*kept["lists"], *kept["trace"], workers)
        kept["maps"] = maps[:, :height, :width]

    def loss() -> None:
        maps = kept["maps"].detach().requires_grad_()
        (maps - target).abs().mean().backward()
        kept["grad"] = maps.grad

    def compositing_backward() -> None:
        grad = torch.zeros(channels, lines * 16, columns * 16)
        grad[:, :height, :width] = kept["grad"]
        of_alphas = np.zeros(lines * columns * 256, np.float32)
        kept["rows"] = torch.empty(workers, N * kernels["ROW"]).numpy()
        engine.zero2(kept["rows"], workers)
        kernels["bwd"](*kept["lists"], *kept["trace"], grad.view(-1).numpy(), of_alphas, kept["rows"], workers)

    def projecting_backward() -> None:
        shapes = (N, 3), (N, 3), (N, 4), (N,), (N, channels)
        grads = [torch.empty(shape).numpy() for shape in shapes]
        sizes = kernels["ST"], boxes, kept["rows"], kernels["ROW"], channels
        engine.proj_bwd(*arrays[:4], camera, packed, *sizes, *grads, workers)

    return {
        "project": projecting,
        "bin": binning,
        "composite": compositing,
        "loss and its backward": loss,
        "composite backward": compositing_backward,
        "project backward": projecting_backward,
        "Adam": adam.step,
    }
