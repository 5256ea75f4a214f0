"""The fused projection on the CPU: `project`'s equations for one Gaussian after another, compiled by numba.

With kornia's functions torch would write some forty arrays. Here a Gaussian's numbers stay in registers, and the backward
pass recomputes what it needs. A Gaussian's numbers depend on no other Gaussian, so results are equal to the bit on any
number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..contract import Cloud, Pinhole
from .project_backward import differentiate_band
from .project_forward import project_band
from .project_math import make_lens
from .reach import find_reach
from .threads import run_bands

__all__ = ["project", "project_backward"]

_SHARE = 16384
"""Gaussians of a band: few, so that all threads end together, but many compared with the cost of a call."""


@torch.no_grad()
def project(cloud: Cloud, pinhole: Pinhole) -> tuple[Tensor, ...]:
    """Project and cull: means2d [M, 2], conics [M, 3], depths [M], opacities [M], extents [M, 2] and index [M]."""
    means = cloud.means
    N = len(means)
    bands = _bands(N)
    shapes = (N, 2), (N, 3), (N,), (N,), (N, 2)
    scratch = [*(means.new_empty(shape) for shape in shapes), means.new_empty(N, dtype=torch.int64)]
    counts = np.empty(bands, np.int64)
    lens = make_lens(pinhole)
    run_bands(
        project_band,
        bands,
        bands,
        lens,
        flat_arrays(*cloud),
        find_reach(cloud.opacities),
        flat_arrays(*scratch),
        counts,
    )

    ends = np.cumsum(counts)
    outputs = [value.new_empty((int(ends[-1]), *value.shape[1:])) for value in scratch]

    def collect(band: int) -> None:
        begin, count = N * band // bands, int(counts[band])
        for value, output in zip(scratch, outputs, strict=True):
            _array(output)[ends[band] - count : ends[band]] = _array(value)[begin : begin + count]

    run_bands(collect, bands)
    return tuple(outputs)


@torch.no_grad()
def project_backward(grads: Sequence[Tensor], cloud: Cloud, pinhole: Pinhole, index: Tensor) -> list[Tensor]:
    """Gradients of the loss in the cloud, given those in means2d, conics, depths and opacities."""
    bands, out = _bands(len(cloud.means)), [torch.empty_like(value) for value in cloud]
    lens = make_lens(pinhole)
    run_bands(
        differentiate_band,
        bands,
        bands,
        lens,
        flat_arrays(*cloud[:3]),
        _array(index),
        flat_arrays(*grads),
        flat_arrays(*out),
    )
    return out


def _bands(count: int) -> int:
    return max(1, -(-count // _SHARE))


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor's memory as numpy sees it."""
    return tensor.detach().numpy()


def flat_arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    """Contiguous tensors as one-dimensional arrays on the same memory."""
    return tuple(_array(tensor.view(-1)) for tensor in tensors)
