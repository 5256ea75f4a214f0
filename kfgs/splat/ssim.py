"""SSIM of pictures (Wang 2004) by torch and kornia, on any device; `engines.cpu.ssim` is compiled for the CPU."""

from __future__ import annotations

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from ..cameras.resample import from_bchw, to_bchw

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_CONSTANTS = 0.01**2, 0.03**2
"""(K1 peak)^2 and (K2 peak)^2 of SSIM, for colours in [0, 1]."""


def window_weights(dtype: torch.dtype) -> Tensor:  # [11], on the CPU
    """The Gaussian weights of a window along one axis; their sum is 1."""
    return get_gaussian_kernel1d(SSIM_WINDOW, SSIM_SIGMA, dtype=torch.float64)[0].to(dtype)


def ssim_windows(picture: Tensor, target: Tensor) -> Tensor:  # [H, W, D] x 2 -> [H - 10, W - 10, D]
    """SSIM of every window that lies in the picture, differentiable: `kornia.metrics.ssim` up to rounding.

    The five moments are filtered at once: a third fewer kernels in a step of training, whose launches keep a GPU waiting.
    """
    x, y = to_bchw(picture), to_bchw(target)
    weights = window_weights(picture.dtype).to(picture.device)[None]
    moments = torch.cat([x, y, x * x, y * y, x * y], dim=1).contiguous()  # as five pictures, slower on a CPU
    a, b, aa, bb, ab = filter2d_separable(moments, weights, weights, padding="valid").chunk(5, dim=1)
    product, squares, (c1, c2) = a * b, a * a + b * b, SSIM_CONSTANTS
    similar = (2 * product + c1) * (2 * (ab - product) + c2) / ((squares + c1) * (aa + bb - squares + c2))
    return from_bchw(similar)
