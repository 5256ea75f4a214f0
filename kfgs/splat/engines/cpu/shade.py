"""View-dependent colour on the CPU: `evaluate_sh`'s equations for one visible Gaussian after another, and their gradient.

torch would copy the visible rows of coefficients, write a dozen arrays of harmonics, and do both again backward.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...sh import C1, C2, C3, SH_C0, fill_harmonics
from .cache import cached_njit, inner_njit
from .memory import flat, take_memory
from .project_forward import PLAIN
from .threads import run_bands

_SHARE = 8192  # Gaussians of a band
_SHORTEST = 1e-12  # a direction is divided by its length or by this, as torch's `normalize` does
_fill_harmonics = inner_njit(fastmath=PLAIN)(fill_harmonics)


def shade(sh: Tensor, means: Tensor, center: Tensor, index: Tensor) -> Tensor:
    """Colours [M, 3] of the rows `index` [M] of the coefficients [N, K, 3], seen from `center` [3]."""
    return _Shade.apply(sh, means, center, index)  # type: ignore[no-any-return]


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, center: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(sh, means, center, index)
        out = sh.new_empty(len(index), 3)
        _run(_shade_band, index, sh.shape[1], sh, means, center, index, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        sh, means, _, index = ctx.saved_tensors
        out = take_memory(sh, *sh.shape).zero_(), take_memory(means, *means.shape).zero_()  # zero for what was not seen
        _run(_differentiate_band, index, sh.shape[1], grad, *ctx.saved_tensors, *out)
        return *out, None, None


def _run(kernel: Any, index: Tensor, K: int, *tensors: Tensor) -> None:
    """Run a kernel over equal shares of the visible Gaussians."""
    bands = max(1, -(-len(index) // _SHARE))
    run_bands(kernel, bands, bands, int(K), *(flat(tensor) for tensor in tensors))


@cached_njit(fastmath=PLAIN)
def _shade_band(band: int, bands: int, K: int, sh: Any, means: Any, center: Any, index: Any, out: Any) -> None:
    count = len(index)
    basis = np.full(16, SH_C0, sh.dtype)
    for m in range(count * band // bands, count * (band + 1) // bands):
        row = max(index[m], 0)
        x, y, z, _ = _direction(means, center, row)
        _fill_harmonics(basis, K, x, y, z)
        for c in range(3):
            out[3 * m + c] = max(_color(basis, sh, row, K, c), basis.dtype.type(0))


@cached_njit(fastmath=PLAIN)
def _differentiate_band(
    band: int, bands: int, K: int, grads: Any, sh: Any, means: Any, center: Any, index: Any, out_sh: Any, out_means: Any
) -> None:
    count = len(index)
    basis, by_basis, slopes = np.full(16, SH_C0, sh.dtype), np.empty(16, sh.dtype), np.empty(3, sh.dtype)
    zero = sh.dtype.type(0)
    for m in range(count * band // bands, count * (band + 1) // bands):
        row = max(index[m], 0)
        x, y, z, scale = _direction(means, center, row)
        _fill_harmonics(basis, K, x, y, z)
        by_basis[:K] = 0
        for c in range(3):
            grad = grads[3 * m + c] if _color(basis, sh, row, K, c) >= zero else zero
            for k in range(K):
                out_sh[3 * (row * K + k) + c] = grad * basis[k]
                by_basis[k] += grad * sh[3 * (row * K + k) + c]
        if K == 1:
            continue
        _turn(slopes, by_basis, K, x, y, z)
        along = slopes[0] * x + slopes[1] * y + slopes[2] * z
        if scale * basis.dtype.type(_SHORTEST) >= 1:  # no direction: divided by a constant
            along = zero
        out_means[3 * row] = scale * (slopes[0] - along * x)
        out_means[3 * row + 1] = scale * (slopes[1] - along * y)
        out_means[3 * row + 2] = scale * (slopes[2] - along * z)


@inner_njit(fastmath=PLAIN)
def _direction(means: Any, center: Any, row: int) -> tuple[Any, Any, Any, Any]:
    """The unit vector from the camera to the Gaussian, and 1 / the distance."""
    x, y, z = means[3 * row] - center[0], means[3 * row + 1] - center[1], means[3 * row + 2] - center[2]
    one = means.dtype.type(1)
    scale = one / max(np.sqrt(x * x + y * y + z * z), means.dtype.type(_SHORTEST))
    return x * scale, y * scale, z * scale, scale


@inner_njit(fastmath=PLAIN)
def _color(basis: Any, sh: Any, row: int, K: int, c: int) -> Any:
    """One channel before it is clamped."""
    total = basis.dtype.type(0)
    for k in range(K):
        total += basis[k] * sh[3 * (row * K + k) + c]
    return total + basis.dtype.type(0.5)


@inner_njit(fastmath=PLAIN)
def _turn(slopes: Any, g: Any, K: int, x: Any, y: Any, z: Any) -> None:
    """The slopes of sum_k g_k Y_k in x, y and z."""
    dx, dy, dz = -C1 * g[3], -C1 * g[1], C1 * g[2]
    if K > 4:
        dx += C2[0] * (y * g[4] - z * g[7]) - 2 * C2[1] * x * g[6] + 2 * C2[2] * x * g[8]
        dy += C2[0] * (x * g[4] - z * g[5]) - 2 * C2[1] * y * g[6] - 2 * C2[2] * y * g[8]
        dz += -C2[0] * (y * g[5] + x * g[7]) + 4 * C2[1] * z * g[6]
    if K > 9:
        xx, yy, zz, xy, yz, zx = x * x, y * y, z * z, x * y, y * z, z * x
        dx += -6 * C3[0] * xy * g[9] + C3[1] * yz * g[10] + 2 * C3[2] * xy * g[11] - 6 * C3[3] * zx * g[12]
        dx += -C3[2] * (4 * zz - 3 * xx - yy) * g[13] + 2 * C3[4] * zx * g[14] - 3 * C3[0] * (xx - yy) * g[15]
        dy += -3 * C3[0] * (xx - yy) * g[9] + C3[1] * zx * g[10] - C3[2] * (4 * zz - xx - 3 * yy) * g[11]
        dy += -6 * C3[3] * yz * g[12] + 2 * C3[2] * xy * g[13] - 2 * C3[4] * yz * g[14] + 6 * C3[0] * xy * g[15]
        dz += C3[1] * xy * g[10] - 8 * C3[2] * yz * g[11] + 3 * C3[3] * (2 * zz - xx - yy) * g[12]
        dz += -8 * C3[2] * zx * g[13] + C3[4] * (xx - yy) * g[14]
    slopes[0], slopes[1], slopes[2] = dx, dy, dz
