"""The fused projection on the CPU: `project`'s equations for one Gaussian after another, compiled by numba.

With kornia's functions torch would write some forty arrays. Here a Gaussian's numbers stay in registers, forward and
backward, and the backward pass recomputes what it needs. Each band writes its own rows, and a Gaussian's numbers depend on
no other Gaussian, so results are equal to the bit on any number of threads.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .project_backward import differentiate_band
from .project_forward import project_band
from .project_math import make_lens
from .reach import find_reach
from .threads import run_bands

__all__ = ["project", "project_backward"]

_SHARE = 16384
"""Gaussians of a band: few enough that all threads end at about the same time, and many compared with the cost of a call."""


@torch.no_grad()
def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near: float,
    low_pass: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project and cull as `kfgs.splat.project` says.

    Args:
        means: contiguous, like all that follow, float32 or float64, on the CPU.
        quats: (w, x, y, z), normalised here.
        scales: standard deviations.
        opacities: activated.
        viewmat: world to camera.
        K: of a pinhole without skew.
        width: of the picture, pixels.
        height: of the picture, pixels.
        near: smallest depth.
        low_pass: added variance, pixels^2.

    Returns:
        means2d [M, 2], conics [M, 3], depths [M], opacities [M], extents [M, 2] and index [M] int64, increasing.
    """
    N = len(means)
    bands = _bands(N)
    shapes = (N, 2), (N, 3), (N,), (N,), (N, 2)
    scratch = [*(means.new_empty(shape) for shape in shapes), means.new_empty(N, dtype=torch.int64)]
    counts = np.empty(bands, np.int64)
    lens = make_lens(_array(viewmat), _array(K), width, height, near, low_pass)
    gaussians = _flat(means, quats, scales, opacities)
    run_bands(project_band, bands, bands, lens, gaussians, find_reach(opacities), _flat(*scratch), counts)

    ends = np.cumsum(counts)
    outputs = [value.new_empty((int(ends[-1]), *value.shape[1:])) for value in scratch]

    def collect(band: int) -> None:
        begin, count = N * band // bands, int(counts[band])
        for value, output in zip(scratch, outputs, strict=True):
            _array(output)[ends[band] - count : ends[band]] = _array(value)[begin : begin + count]

    run_bands(collect, bands)
    means2d, conics, depths, seen, extents, index = outputs
    return means2d, conics, depths, seen, extents, index


@torch.no_grad()
def project_backward(
    grad_means2d: Tensor,  # [M, 2]
    grad_conics: Tensor,  # [M, 3]
    grad_depths: Tensor,  # [M]
    grad_opacities: Tensor,  # [M]
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near: float,
    low_pass: float,
    index: Tensor,  # [M] int64
) -> list[Tensor]:
    """Gradients of the loss in means [N, 3], quats [N, 4], scales [N, 3] and opacities [N]; zero for what was culled.

    The first four arguments are the loss's gradients in what `project` returned, contiguous; the others are the
    arguments of `project` and the index that it returned.
    """
    bands = _bands(len(means))
    grads = [torch.empty_like(value) for value in (means, quats, scales, opacities)]
    lens = make_lens(_array(viewmat), _array(K), width, height, near, low_pass)
    given = _flat(grad_means2d, grad_conics, grad_depths, grad_opacities)
    run_bands(differentiate_band, bands, bands, lens, _flat(means, quats, scales), _array(index), given, _flat(*grads))
    return grads


def _bands(count: int) -> int:
    return max(1, -(-count // _SHARE))


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor's memory as numpy sees it."""
    return tensor.detach().numpy()


def _flat(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    """Contiguous tensors as one-dimensional arrays on the same memory."""
    return tuple(_array(tensor.view(-1)) for tensor in tensors)
