"""The fused projection on the CPU: `project`'s equations for one Gaussian after another, compiled by numba.

With kornia's functions torch would write some forty arrays. Here a Gaussian's numbers stay in registers, and the backward
pass recomputes what it needs. A Gaussian's numbers depend on no other Gaussian, so results are equal to the bit on any
number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..contract import Cloud, Pinhole
from .memory import flat
from .project_backward import differentiate_band
from .project_forward import make_lens, project_band
from .threads import find_reach, run_bands

_SHARE = 16384
"""Gaussians of a band: few, so that all threads end together, but many compared with the cost of a call."""


def project(cloud: Cloud, pinhole: Pinhole) -> tuple[Tensor, ...]:
    """Project and cull: means2d [M, 2], conics [M, 3], depths [M], opacities [M], extents [M, 2] and index [M]."""
    return _Project.apply(pinhole, *cloud)  # type: ignore[no-any-return]


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pinhole: Pinhole, *values: Tensor) -> tuple[Tensor, ...]:
        cloud = Cloud(*values)
        means, N = cloud.means, len(cloud.means)
        bands = _bands(N)
        shapes = (N, 2), (N, 3), (N,), (N,), (N, 2)
        scratch = [*(means.new_empty(shape) for shape in shapes), means.new_empty(N, dtype=torch.int64)]
        counts, arrays = np.empty(bands, np.int64), tuple(flat(value) for value in scratch)
        gaussians = tuple(flat(value) for value in cloud)
        run_bands(
            project_band, bands, bands, make_lens(pinhole), gaussians, find_reach(cloud.opacities), arrays, counts
        )
        ends = np.cumsum(counts)
        outputs = [value.new_empty((int(ends[-1]), *value.shape[1:])) for value in scratch]

        def collect(band: int) -> None:
            begin, count = N * band // bands, int(counts[band])
            for value, output in zip(scratch, outputs, strict=True):
                output.numpy()[ends[band] - count : ends[band]] = value.numpy()[begin : begin + count]

        run_bands(collect, bands)
        ctx.pinhole = pinhole
        ctx.save_for_backward(*cloud, outputs[5])
        ctx.mark_non_differentiable(*outputs[4:])
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *cloud, index = ctx.saved_tensors
        kind = flat(cloud[0]).dtype  # numpy's zeros: pages of new memory are not cleared again
        bands, out = _bands(len(index)), [torch.from_numpy(np.zeros(value.shape, kind)) for value in cloud]
        given, targets = tuple(flat(grad) for grad in grads[:4]), tuple(flat(value) for value in out)
        gaussians = tuple(flat(value) for value in cloud[:3])
        run_bands(differentiate_band, bands, bands, make_lens(ctx.pinhole), gaussians, flat(index), given, targets)
        return None, *out


def _bands(count: int) -> int:
    return max(1, -(-count // _SHARE))
