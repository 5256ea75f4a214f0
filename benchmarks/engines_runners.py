"""What is measured: for every engine, kfgs's own and the peers, calls that do one thing each on the same input."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import engines_gsplat
import numba
import torch
from devices import CPU
from engines_room import room, view
from torch import Tensor

from kfgs import Gaussians
from kfgs.cameras import Camera
from kfgs.splat import (
    Projected,
    Tiles,
    accumulate_pixels,
    available_engines,
    bin_tiles,
    composite,
    project,
    rasterize,
    rasterize_labels,
)

Calls = dict[str, Callable[[], Any]]


class Case(NamedTuple):
    """One configuration."""

    count: int  # N
    channels: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"N={self.count:,} {self.width}x{self.height}x{self.channels}"


class Inputs(NamedTuple):
    """What all engines are given for a case: the same arrays, the same lists of tiles."""

    case: Case
    gaussians: Gaussians
    camera: Camera
    projected: Projected
    tiles: Tiles
    grad_maps: Tensor  # [H, W, D]
    grad_alphas: Tensor  # [H, W]


def prepare(case: Case, device: torch.device = CPU) -> Inputs:
    """Make the room, project it and bin it."""
    gaussians, camera = room(case.count, case.channels).to(device), view(case.width, case.height).to(device)
    with torch.no_grad():
        projected = project(gaussians, camera)
        tiles = bin_tiles(projected, case.width, case.height)
    g = torch.Generator().manual_seed(1)
    grad_maps = torch.randn(case.height, case.width, case.channels, generator=g)
    grad_alphas = torch.randn(grad_maps.shape[:2], generator=g)
    return Inputs(case, gaussians, camera, projected, tiles, grad_maps.to(device), grad_alphas.to(device))


def engine_names(device: torch.device = CPU) -> list[str]:
    """Kfgs's engines that run on the device (on a GPU without the slow reference), then gsplat, if it is there."""
    mine = [f"kfgs {name}" for name in available_engines(device.type)]
    if device.type == "cuda":
        peers = engines_gsplat.NAMES if engines_gsplat.fault() is None else ()
        return [name for name in mine if name != "kfgs reference"] + [*peers]
    return mine


def missing(device: torch.device = CPU) -> list[str]:
    """What could be measured on the device, but is not there, one line each."""
    if device.type == "cpu":
        return []
    triton = "kfgs triton: pip install triton"
    found = [] if "triton" in available_engines("cuda") else [triton]
    fault = engines_gsplat.fault()
    return found if fault is None else [*found, f"gsplat: {fault}"]


def calls(name: str, inputs: Inputs) -> Calls:
    """What an engine has of these calls; `forward` and `frame` return the maps [H, W, D], so that engines can be compared.

    - `forward` and `backward` of compositing alone
    - `frame`: project, bin and composite, without gradients
    - `step`: a frame, and the gradients of all tensors of the Gaussians
    - `labels`: the best of D classes at each pixel, from scores of the Gaussians (`rasterize_labels`)
    - `uplift`: a map [H, W, D] summed into the Gaussians (`accumulate_pixels`), without projection and binning
    """
    if name.startswith("kfgs "):
        engine = name.removeprefix("kfgs ")
        return _compositing(engine, inputs) | _whole(engine, inputs)
    return engines_gsplat.calls(name, inputs)


# kfgs -----------------------------------------------------------------------------------------------------------------


def composite_projected(
    projected: Projected, features: Tensor, tiles: Tiles, engine: str
) -> tuple[Tensor, Tensor]:  # maps, alphas
    """Composite the features [N, D] of all Gaussians."""
    splats = projected.means2d, projected.conics, projected.opacities
    return composite(*splats, features, tiles, index=projected.index, engine=engine)


def _compositing(engine: str, inputs: Inputs) -> Calls:
    names = "means2d", "conics", "opacities"
    floats = {name: getattr(inputs.projected, name).detach().requires_grad_() for name in names}
    features = inputs.gaussians.features.detach().requires_grad_()
    projected = inputs.projected._replace(**floats)
    graph: list[tuple[Tensor, Tensor]] = []  # of one forward pass, made when it is first wanted

    def forward() -> Tensor:
        with torch.no_grad():
            return composite_projected(projected, features, inputs.tiles, engine)[0]

    def backward() -> Any:
        if not graph:
            graph.append(composite_projected(projected, features, inputs.tiles, engine))
        upstream = inputs.grad_maps, inputs.grad_alphas
        return torch.autograd.grad(graph[0], [*floats.values(), features], upstream, retain_graph=True)

    return {"forward": forward, "backward": backward}


def _whole(engine: str, inputs: Inputs) -> Calls:
    names = "means", "quats", "scales", "opacities", "features"
    leaves = {name: getattr(inputs.gaussians, name).detach().clone().requires_grad_() for name in names}
    cloud, camera, projected = inputs.gaussians.replace(**leaves), inputs.camera, inputs.projected

    def frame() -> Tensor:
        with torch.no_grad():
            return rasterize(inputs.gaussians, camera, engine=engine).map

    def step() -> Any:
        rendering = rasterize(cloud, camera, engine=engine)
        outputs, upstream = (rendering.map, rendering.alpha), (inputs.grad_maps, inputs.grad_alphas)
        return torch.autograd.grad(outputs, list(leaves.values()), upstream)

    def labels() -> Any:
        return rasterize_labels(inputs.gaussians, camera, engine=engine)

    def uplift() -> Any:
        splats = projected.means2d, projected.conics, projected.opacities
        return accumulate_pixels(*splats, inputs.grad_maps, inputs.tiles, engine=engine)

    return {"frame": frame, "step": step, "labels": labels, "uplift": uplift}


# pairs ----------------------------------------------------------------------------------------------------------------


class Pairs(NamedTuple):
    """How much there is to do in a case, whoever does it."""

    visible: int  # M
    listed: int  # (tile, Gaussian)
    composited: int  # (pixel, Gaussian) with alpha >= 1/255, before the pixel stops


def count_pairs(inputs: Inputs) -> Pairs:
    """Count by trying every listed pair at every pixel, on the CPU."""
    p, tiles = inputs.projected, inputs.tiles
    arrays = (v.detach().cpu().numpy() for v in (p.means2d, p.conics, p.opacities, tiles.rows, tiles.offsets))
    composited = _count(*arrays, tiles.width, tiles.height, tiles.tile_size)
    return Pairs(len(p.index), int(tiles.offsets[-1]), int(composited))


@numba.njit(error_model="numpy")
def _count(means2d, conics, opacities, rows, offsets, width, height, side):
    columns, found = -(-width // side), 0
    for tile in range(len(offsets) - 1):
        left, top = tile % columns * side, tile // columns * side
        for i in range(top, min(top + side, height)):
            for j in range(left, min(left + side, width)):
                light = 1.0
                for at in range(offsets[tile], offsets[tile + 1]):
                    m = rows[at]
                    dx, dy = j + 0.5 - means2d[m, 0], i + 0.5 - means2d[m, 1]
                    power = dx * (0.5 * conics[m, 0] * dx + conics[m, 1] * dy) + 0.5 * conics[m, 2] * dy * dy
                    if power > 5.6:  # ln 255 = 5.54: no opacity reaches further
                        continue
                    alpha = min(0.99, opacities[m] * math.exp(-power))
                    if alpha < 1 / 255:
                        continue
                    light *= 1 - alpha
                    if light < 1e-4:
                        break
                    found += 1
    return found
