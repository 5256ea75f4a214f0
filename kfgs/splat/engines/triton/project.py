"""The projection and the lists of tiles on a GPU: a handful of kernels, and two or three numbers that the host waits for."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..contract import Cloud, Pinhole
from .kernels_project import differentiate_projection_kernel, project_kernel
from .kernels_tiles import count_kernel, list_kernel

BLOCK = 128  # Gaussians, or candidates, of a program: one for each thread

FUSED = {"enable_fp_fusion": True}  # a * b + c in one instruction


def on_device(tensor: Tensor) -> AbstractContextManager[Any]:
    """Triton launches on the current GPU: make it the tensor's."""
    return torch.cuda.device(tensor.device) if tensor.is_cuda else nullcontext()


def project(cloud: Cloud, pinhole: Pinhole) -> tuple[Tensor, ...]:
    """Project and cull: means2d [M, 2], conics [M, 3], depths [M], opacities [M], extents [M, 2] and index [M]."""
    return _Project.apply(pinhole, *cloud)  # type: ignore[no-any-return]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pinhole: Pinhole, *cloud: Tensor) -> tuple[Tensor, ...]:
        means, N = cloud[0], len(cloud[0])
        camera = pinhole.viewmat.contiguous(), pinhole.K.contiguous()
        options = N, pinhole.width, pinhole.height, float(pinhole.near), float(pinhole.low_pass)
        kept, grid = torch.empty(N, dtype=torch.int32, device=means.device), (-(-N // BLOCK),)
        with on_device(means):
            project_kernel[grid](*cloud, *camera, kept, *[None] * 7, *options, BLOCK, **FUSED)
            ends = kept.cumsum(0, dtype=torch.int32)
            M = int(ends[-1]) if N else 0
            outputs = [means.new_empty(shape) for shape in ((M, 2), (M, 3), (M,), (M,), (M, 2))]
            outputs.append(torch.empty(M, dtype=torch.int64, device=means.device))
            project_kernel[grid](*cloud, *camera, kept, ends, *outputs, *options, BLOCK, **FUSED)
        ctx.options = *options[:3], options[4]
        ctx.save_for_backward(*cloud[:3], *camera, kept, ends)
        ctx.set_materialize_grads(False)  # most have no gradient in depths
        ctx.mark_non_differentiable(*outputs[4:])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        out = [*(torch.empty_like(value) for value in saved[:3]), saved[0].new_empty(len(saved[0]))]
        given = [None if grad is None else grad.contiguous() for grad in grads[:4]]
        with on_device(saved[0]):
            differentiate_projection_kernel[(-(-len(saved[0]) // BLOCK),)](
                *saved, *given, *out, *ctx.options, BLOCK, **FUSED
            )
        return None, *out


def bin(
    means2d: Tensor, conics: Tensor, depths: Tensor, opacities: Tensor, extents: Tensor, size: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Rows [P] and offsets [T + 1] of `Tiles`: the pairs in order of depth, sorted by tile.

    On a GPU the rows of candidates that touch no tile follow at the end: the host would have to wait for where to cut.
    """
    width, height, side = size
    columns, M, device = -(-width // side), len(depths), depths.device
    count = columns * -(-height // side)
    kind = torch.int16 if count < 2**15 else torch.int32  # half the bits are sorted in half the time
    order, hits = depths.sort(stable=True).indices, torch.empty(M, dtype=torch.int64, device=device)
    with on_device(depths):
        count_kernel[(-(-M // BLOCK),)](order, means2d, extents, hits, M, width, height, side, BLOCK, **FUSED)
        ends = hits.cumsum(0)
        total = int(ends[-1]) if M else 0
        rows, tiles = (torch.empty(total, dtype=of, device=device) for of in (torch.int32, kind))
        list_kernel[(-(-total // BLOCK),)](
            order, ends, means2d, conics, opacities, extents, rows, tiles,
            total, M, width, height, columns, count, side, BLOCK, **FUSED,
        )  # fmt: skip
    tiles, by_tile = tiles.sort(stable=True)
    offsets = torch.searchsorted(tiles, torch.arange(count + 1, dtype=kind, device=device))
    return rows[by_tile if device.type == "cuda" else by_tile[: int(offsets[-1])]], offsets
