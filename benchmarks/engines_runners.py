"""What is measured: for every engine, kfgs's own and the peers, calls that do one thing each on the same input."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import engines_gsplat
import numba
import numpy as np
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

PROTOTYPE = Path(__file__).resolve().parents[2] / "shared" / "reference" / "engine_prototype"
"""The numba SIMD prototype and the pure-torch engine that it was compared with; not part of kfgs."""

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
    """Kfgs's engines that run on the device (on a GPU without the slow reference), then the peers that are there."""
    mine = [f"kfgs {name}" for name in available_engines(device.type)]
    if device.type == "cuda":
        peers = engines_gsplat.NAMES if engines_gsplat.fault() is None else ()
        return [name for name in mine if name != "kfgs reference"] + [*peers]
    return mine + (["prototype", "torch tile-batched"] if PROTOTYPE.is_dir() else [])


def missing(device: torch.device = CPU) -> list[str]:
    """What could be measured on the device, but is not there, one line each."""
    if device.type == "cpu":
        return [] if PROTOTYPE.is_dir() else [f"the prototype and its torch engine: no folder {PROTOTYPE}"]
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
    if name in engines_gsplat.NAMES:
        return engines_gsplat.calls(name, inputs)
    if name == "torch tile-batched":
        return _torch_tile(inputs)
    return _prototype_wide(inputs) if inputs.case.channels % 64 == 0 else _prototype_narrow(inputs)


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


# the prototypes -------------------------------------------------------------------------------------------------------


def prototype(module: str) -> Any:
    """A module of the prototype's folder."""
    if str(PROTOTYPE) not in sys.path:
        sys.path.append(str(PROTOTYPE))
    return importlib.import_module(module)


@cache
def _wide_kernels() -> dict[str, Any]:
    return prototype("nbh").gen()


class _Arrays(NamedTuple):
    """The input as the prototype's kernels take it."""

    splats: tuple[np.ndarray, ...]  # means2d, conics, opacities
    features: np.ndarray  # [M, D]
    rows: np.ndarray
    offsets: np.ndarray
    columns: int
    lines: int
    pixels: int  # of the padded image


def _arrays(inputs: Inputs) -> _Arrays:
    p, (lines, columns) = inputs.projected, inputs.tiles.grid
    splats = tuple(v.detach().numpy() for v in (p.means2d, p.conics, p.opacities))
    features = inputs.gaussians.features.detach()[p.index].numpy()
    rows, offsets = inputs.tiles.rows.numpy(), inputs.tiles.offsets.numpy()
    return _Arrays(splats, features, rows, offsets, columns, lines, columns * lines * 256)


def _padded(map: Tensor, a: _Arrays) -> Tensor:
    """A map [H, W, D] padded to whole tiles, as [H', W', D]."""
    out = torch.zeros(a.lines * 16, a.columns * 16, map.shape[2])
    out[: map.shape[0], : map.shape[1]] = map
    return out


def _prototype_narrow(inputs: Inputs) -> Calls:
    """Its kernels for few channels (compiled for each number of them). Buffers are made in each call, as it does.

    `forward` leaves out packing the rows, and `backward` summing the threads' rows and turning moments into gradients:
    the prototype does these within its projection, which is in `frame` and in the step.
    """
    nbx2, engine = prototype("nbx2"), prototype("engine")
    channels, a, workers = inputs.case.channels, _arrays(inputs), torch.get_num_threads()
    numba.set_num_threads(workers)
    kernels, M = engine.kernels(channels), len(a.features)
    packed = nbx2.aligned(M * kernels["ST"])
    nbx2.pack(*a.splats, a.features, packed, kernels["ST"])
    shares = engine.balance(a.offsets, workers)
    grad = _padded(inputs.grad_maps, a).permute(2, 0, 1).contiguous().view(-1).numpy()
    grad_alpha = _padded(inputs.grad_alphas[..., None], a).view(-1).numpy()
    lists = packed, a.rows, a.offsets, shares, a.columns, a.lines
    kept: dict[str, Any] = {}

    def forward() -> Tensor:
        maps, left = torch.empty(channels * a.pixels), torch.empty(a.pixels)
        ends = np.empty(a.columns * a.lines, np.int64)
        kernels["fwd"](*lists, maps.numpy(), left.numpy(), ends, workers)
        kept["trace"] = maps.numpy(), left.numpy(), ends
        image = maps.view(channels, a.lines * 16, a.columns * 16)
        return image.permute(1, 2, 0)[: inputs.case.height, : inputs.case.width]

    def backward() -> Any:
        if not kept:
            forward()
        rows = torch.empty(workers, M * kernels["ROW"]).numpy()
        engine.zero2(rows, workers)
        kernels["bwd"](*lists, *kept["trace"], grad, grad_alpha, rows, workers)
        return rows

    parameters = prototype_parameters(inputs.gaussians)
    camera = prototype_camera(inputs.camera)

    def frame() -> Any:
        with torch.no_grad():
            return engine.Render.apply(*parameters, camera, inputs.case.width, inputs.case.height)

    return {"forward": forward, "backward": backward, "frame": frame}


def _prototype_wide(inputs: Inputs) -> Calls:
    """Its kernels for multiples of 64 channels; they have no projection, so no `frame`."""
    nbx2, engine, kernels = prototype("nbx2"), prototype("engine"), _wide_kernels()
    channels, a, workers = inputs.case.channels, _arrays(inputs), torch.get_num_threads()
    numba.set_num_threads(workers)
    M = len(a.features)
    packed = nbx2.aligned(M * 16)
    nbx2.pack(*a.splats, np.zeros((M, 0), np.float32), packed, 8)
    packed = packed[: M * 8].copy()
    features = nbx2.aligned(M * channels)
    features[:] = a.features.ravel()
    shares = engine.balance(a.offsets, workers)
    grad, grad_alpha = nbx2.aligned(a.pixels * channels), _padded(inputs.grad_alphas[..., None], a).view(-1).numpy()
    grad[:] = _padded(inputs.grad_maps, a).view(-1).numpy()
    lists = packed, features, channels, a.rows, a.offsets, shares, a.columns, a.lines
    kept: dict[str, Any] = {}

    def forward() -> Tensor:
        maps, left = nbx2.aligned(a.pixels * channels), np.empty(a.pixels, np.float32)
        ends = np.empty(a.columns * a.lines, np.int64)
        kernels["fwd"](*lists, maps, left, ends, workers)
        kept["trace"] = maps, left, ends
        image = torch.from_numpy(maps).view(a.lines * 16, a.columns * 16, channels)
        return image[: inputs.case.height, : inputs.case.width]

    def backward() -> Any:
        if not kept:
            forward()
        rows, moments = np.zeros((workers, M * channels), np.float32), np.zeros((workers, M * 16), np.float32)
        kernels["bwd"](*lists, *kept["trace"], grad, grad_alpha, rows, moments, workers)
        return rows, moments

    return {"forward": forward, "backward": backward}


def _torch_tile(inputs: Inputs) -> Calls:
    tile = prototype("torch_tile")
    p, (lines, columns) = inputs.projected, inputs.tiles.grid
    features = inputs.gaussians.features.detach()[p.index]
    leaves = [v.detach().requires_grad_() for v in (p.means2d, p.conics, p.opacities, features)]
    lists = inputs.tiles.rows, inputs.tiles.offsets, columns, lines, 16, 16
    graph: list[Any] = []

    def image(maps: Tensor) -> Tensor:
        return tile.untile(maps, columns, lines, 16, 16)[: inputs.case.height, : inputs.case.width]

    def run() -> tuple[Tensor, Tensor]:
        maps, left = tile.Composite.apply(*leaves, *lists)
        return image(maps), 1 - image(left[..., None])[..., 0]

    def forward() -> Tensor:
        with torch.no_grad():
            return run()[0]

    def backward() -> Any:
        if not graph:
            graph.append(run())
        return torch.autograd.grad(graph[0], leaves, (inputs.grad_maps, inputs.grad_alphas), retain_graph=True)

    return {"forward": forward, "backward": backward}


def prototype_parameters(gaussians: Gaussians) -> list[Tensor]:
    """Raw values in the prototype's order: means, log scales, quaternions, logits, features."""
    logits = torch.logit(gaussians.opacities.detach(), eps=1e-6)
    values = gaussians.means, gaussians.scales.detach().log(), gaussians.quats, logits, gaussians.features
    return [value.detach().clone() for value in values]


def prototype_camera(camera: Camera) -> np.ndarray:
    """Rotation, translation, focal lengths, principal point, size and near plane, as one array."""
    R, t, K = camera.viewmat[:3, :3].reshape(-1), camera.viewmat[:3, 3], camera.K
    rest = torch.tensor([K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height, 0.2])
    return torch.cat([R, t, rest]).numpy().astype(np.float32)


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
    return Pairs(len(p.index), len(tiles.rows), int(composited))


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
