"""The GPU engine: compositing by Triton kernels, float32, any number of channels.

Nothing in this file waits for the GPU: sizes come from shapes, and where each pixel stopped is a tensor. Programs add to a
Gaussian's gradients by atomics, in any order. So two runs of the backward pass, and of `accumulate`, agree to rounding;
two runs of the forward pass agree to the bit. Kernels have more than eight parameters, because a launch takes flat pointers.

With TRITON_INTERPRET=1 in the environment before triton is imported, the same kernels run on CPU tensors, slowly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor

from ..contract import CompiledEngine, Composited, Ranked, Splats, Tiles
from .kernels import accumulate_kernel, composite_kernel
from .kernels_backward import differentiate_kernel
from .kernels_rank import rank_kernel
from .project import bin, on_device, project

INTERPRETED = not isinstance(composite_kernel, triton.JITFunction)
"""Whether triton interprets the kernels. They then run in numpy, on the CPU."""

PRECISION = "tf32x3"
"""Rounding of matrix products of many channels: tensor cores multiply numbers of 11 bits (tf32), which alone would be wrong
by 5e-4. Three products of high and low parts have float32's accuracy, still on the tensor cores. Up to `SMALLEST` channels
plain float32 is faster, and the interpreter has no other."""


class Launch(NamedTuple):
    """How a kernel is cut into programs; see `kernels`."""

    pixels: int  # most pixels of a program
    chunk: int  # Gaussians at a time
    block: int  # most channels at a time
    warps: int  # for `pixels` pixels; fewer pixels get fewer warps


LAUNCHES = {
    "composite": (Launch(64, 16, 16, 2), Launch(64, 16, 128, 2)),
    "rank": (Launch(64, 16, 16, 2), Launch(64, 16, 64, 2)),
    "accumulate": (Launch(64, 16, 16, 1), Launch(64, 16, 64, 2)),
    "differentiate": (Launch(64, 16, 16, 2), Launch(64, 16, 32, 2)),
}
"""For up to `SMALLEST` channels, and for more: the fastest of some twenty each on an H200 (110,000 Gaussians, 640x480, 9 and 512
channels). A warp has 32 threads, so each holds a chunk of one pixel or two, and no running product or sum crosses threads.
Some registers spill; programs with fewer of them, or with twice the pixels, took longer."""

SMALLEST = 16
"""Least size of an axis of a tensor-core product: less is padded."""

MOST_RANKED = 64
"""Most channels that a pixel keeps in registers; for more of them the map is sorted."""


class TritonEngine(CompiledEngine):
    """The engine that `kfgs.splat` takes on a GPU."""

    devices = ("cuda", "cpu") if INTERPRETED else ("cuda",)
    dtypes = (torch.float32,)
    tile_size = 8  # a Gaussian reaches fewer of the pixels of a larger tile, and all of them are computed
    projects = True
    project, bin = staticmethod(project), staticmethod(bin)  # type: ignore[assignment]

    def forward(self, splats: Splats, tiles: Tiles) -> Composited:
        """Composite as the contract says.

        The trace is how many Gaussians of its tile's list each pixel passed before it stopped, and the bits of its final
        transmittance, of which 1 - alpha would keep few digits behind what is opaque; `_room(H * W)` numbers each.
        """
        means2d, conics, opacities, features, background, index = splats
        rows, offsets, width, height, tile_size = tiles
        D = features.shape[1]
        maps, alphas = features.new_empty(height, width, D), features.new_empty(height, width)
        trace = torch.empty(2 * _room(height * width), dtype=torch.int32, device=features.device)
        stops, lights = trace.chunk(2)
        if len(rows) == 0:
            stops.zero_()
            lights.view(torch.float32).fill_(1.0)
            return Composited(maps.copy_(background.expand_as(maps)), alphas.zero_(), trace)
        options = launch_options("composite", D, tile_size)
        grid = _programs(options, tiles), -(-D // options["BLOCK"])
        with on_device(means2d):
            composite_kernel[grid](
                means2d, conics, opacities, features, background, index, rows, offsets,
                maps, alphas, stops, lights.view(torch.float32), width, height, tiles.grid[1], D, **options,
            )  # fmt: skip
        return Composited(maps, alphas, trace)

    def backward(
        self, grads: tuple[Tensor, Tensor], wanted: list[bool], splats: Splats, tiles: Tiles, result: Composited
    ) -> list[Tensor | None]:
        (grad_maps, grad_alphas), (maps, alphas, trace) = grads, result
        means2d, conics, opacities, features, _, index = splats
        rows, offsets, width, height, tile_size = tiles
        of_splats, of_features = any(wanted[:3]), bool(wanted[3])
        stops, lights = trace.chunk(2)
        M = len(means2d) if of_splats else 0
        room = _room(M)
        parts = means2d.new_zeros(6 * room).split((2 * room, 3 * room, room))  # one kernel clears all three
        shapes = [(M, *value.shape[1:]) for value in splats[:3]]
        results = [part[: math.prod(shape)].view(shape) for part, shape in zip(parts, shapes, strict=True)]
        results.append(torch.zeros_like(features) if of_features else features.new_empty(0))
        if (of_splats or of_features) and len(rows):
            D = features.shape[1]
            options = launch_options("differentiate", D, tile_size)
            with on_device(means2d):
                differentiate_kernel[(_programs(options, tiles),)](
                    means2d, conics, opacities, features, index, rows, offsets, maps, alphas, stops,
                    grad_maps, grad_alphas, *results,
                    width, height, tiles.grid[1], D, **options, OF_SPLATS=of_splats, OF_FEATURES=of_features,
                )  # fmt: skip
        light = lights.view(torch.float32)[: height * width].view(height, width)
        of_background = torch.einsum("hwd,hw->d", grad_maps, light) if wanted[4] else None
        return [grad if want else None for grad, want in zip((*results, of_background), wanted, strict=True)]

    def accumulate(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, tiles: Tiles
    ) -> tuple[Tensor, Tensor]:
        rows, offsets, width, height, tile_size = tiles
        M, D = len(opacities), pixels.shape[2]
        sums, weights = pixels.new_zeros(M, D), pixels.new_zeros(M)
        if len(rows):
            options = launch_options("accumulate", D, tile_size)
            grid = _programs(options, tiles), -(-D // options["BLOCK"])
            with on_device(means2d):
                accumulate_kernel[grid](
                    means2d, conics, opacities, pixels, rows, offsets, sums, weights,
                    width, height, tiles.grid[1], D, **options,
                )  # fmt: skip
        return sums, weights

    def rank(self, splats: Splats, tiles: Tiles, top: int, early: bool) -> Ranked:
        """The best channels of each pixel, as the contract says; `early` makes no difference."""
        means2d, conics, opacities, features, _, index = splats
        rows, offsets, width, height, tile_size = tiles
        if top > MOST_RANKED:
            return super().rank(splats, tiles, top, early)
        labels = torch.full((height, width, top), -1, dtype=torch.int64, device=features.device)
        scores, alphas = features.new_zeros(height, width, top), features.new_zeros(height, width)
        if len(rows):
            D = features.shape[1]
            options = launch_options("rank", D, tile_size) | {"TOP": triton.next_power_of_2(top)}
            with on_device(means2d):
                rank_kernel[(_programs(options, tiles),)](
                    means2d, conics, opacities, features, index, rows, offsets, labels, scores, alphas,
                    width, height, tiles.grid[1], D, top, **options,
                )  # fmt: skip
        return Ranked(labels, scores, alphas)


ENGINE = TritonEngine()


def launch_options(kernel: str, channels: int, tile_size: int) -> dict[str, Any]:
    """The sizes a kernel of `LAUNCHES` is compiled for, and its warps; several programs share a larger tile."""
    launch = LAUNCHES[kernel][channels > SMALLEST]
    pixels = min(launch.pixels, max(SMALLEST, triton.next_power_of_2(tile_size**2)))
    return {
        "SIDE": tile_size,
        "PARTS": -(-(tile_size**2) // pixels),
        "PIXELS": pixels,
        "CHUNK": launch.chunk,
        "BLOCK": min(launch.block, max(SMALLEST, triton.next_power_of_2(channels))),
        "PRECISION": "ieee" if INTERPRETED or channels <= SMALLEST else PRECISION,
        "num_warps": max(1, launch.warps * pixels // launch.pixels),
        "num_stages": 1,  # loading a block of channels ahead takes registers that the backward pass does not have
        "enable_fp_fusion": True,  # a * b + c in one instruction
    }


def _programs(options: dict[str, Any], tiles: Tiles) -> int:
    return tiles.grid[0] * tiles.grid[1] * options["PARTS"]


def _room(count: int) -> int:
    """Numbers for an array of `count` and what follows it at a multiple of 16 bytes: elsewhere Triton compiles again."""
    return -(-count // 4) * 4
