"""SSIM of two pictures and its gradient in one of them, compiled by numba: some ten times faster than convolutions.

Channels stay side by side, so every inner loop runs over neighbouring numbers. Each row of windows is blurred downwards,
then along; the gradient takes the same two steps back. No two shares of rows write the same memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from .cache import cached_njit
from .project_math import OPTIONS
from .threads import run_bands

__all__ = ["similarity"]

WINDOW = 11
"""Pixels of the Gaussian window's side."""

_LAST = WINDOW - 1
_BAND = 32  # rows of a share
_FAST = {"contract", "nsz", "arcp", "reassoc"}


@torch.no_grad()
def similarity(
    picture: Tensor,  # [H, W, D]
    target: Tensor,  # [H, W, D]
    counted: Tensor | None,  # [H - 10, W - 10] bool
    window: Tensor,  # [11] weights of the window along an axis; symmetric, sum 1
    constants: tuple[float, float],
) -> tuple[Tensor, Tensor]:  # [] , [H, W, D]
    """Mean SSIM over the (counted) windows inside the picture, and its gradient in `picture`.

    Args:
        picture: contiguous float32 or float64 on the CPU, at least 11 pixels on each side.
        target: of the same shape and dtype, contiguous.
        counted: which windows count, at least one; None = all.
        window: of the picture's dtype.
        constants: (K1 peak)^2 and (K2 peak)^2, which keep flat windows finite.
    """
    height, width, channels = picture.shape
    a, b = (value.detach().numpy().reshape(height, width * channels) for value in (picture, target))
    rows, across = height - _LAST, (width - _LAST) * channels
    kind = a.dtype.type
    mask = np.empty((0, 0), bool) if counted is None else np.repeat(counted.numpy(), channels, axis=1)
    count = rows * across if counted is None else int(mask.sum())
    slopes, out = np.empty((3, rows, across), a.dtype), np.empty_like(a)
    bands = -(-rows // _BAND)
    sums = np.empty(bands)
    weights, limits = window.numpy(), (kind(constants[0]), kind(constants[1]))
    pair = Pair(a, b, channels)
    run_bands(compare_band, bands, bands, weights, limits, pair, mask, slopes, sums)
    run_bands(spread_band, bands, bands, weights, kind(1 / count), pair, slopes, out)
    return picture.new_tensor(sums.sum() / count), torch.from_numpy(out).view_as(picture)


class Pair(NamedTuple):
    """Two pictures, their channels side by side."""

    picture: Any  # [H, W D]
    target: Any  # [H, W D]
    channels: int  # D


@njit(fastmath=_FAST, inline="always", **OPTIONS)
def _along(values: Any, j: Any, step: Any, w: Any) -> Any:
    """The window's weighted sum of 11 numbers, `step` apart, from `values[j]` on."""
    return (
        w[0] * (values[j] + values[j + 10 * step])
        + w[1] * (values[j + step] + values[j + 9 * step])
        + w[2] * (values[j + 2 * step] + values[j + 8 * step])
        + w[3] * (values[j + 3 * step] + values[j + 7 * step])
        + w[4] * (values[j + 4 * step] + values[j + 6 * step])
        + w[5] * values[j + 5 * step]
    )


@cached_njit(fastmath=_FAST, **OPTIONS)
def compare_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    constants: tuple[Any, Any],
    pair: Pair,
    counted: Any,  # [H - 10, (W - 10) D] bool, or empty
    slopes: Any,  # [3, H - 10, (W - 10) D], written
    sums: Any,  # [bands], written
) -> None:
    """Sum SSIM over a share of the windows; keep its slopes in the windows' means of a, a^2 and a b."""
    picture, target, channels = pair
    rows, length = picture.shape[0] - 10, picture.shape[1]
    across = length - 10 * channels
    w = (window[0], window[1], window[2], window[3], window[4], window[5])
    v_a, v_b = np.empty(length, window.dtype), np.empty(length, window.dtype)
    v_aa, v_bb, v_ab = np.empty(length, window.dtype), np.empty(length, window.dtype), np.empty(length, window.dtype)
    found = np.empty(across, window.dtype)
    one, two = window.dtype.type(1), window.dtype.type(2)
    total = 0.0
    for i in range(rows * band // bands, rows * (band + 1) // bands):
        for values in (v_a, v_b, v_aa, v_bb, v_ab):
            values[:] = 0
        for k in range(11):
            weight, row_a, row_b = window[k], picture[i + k], target[i + k]
            for j in range(length):
                a, b = row_a[j], row_b[j]
                wa, wb = weight * a, weight * b
                v_a[j] += wa
                v_b[j] += wb
                v_aa[j] += wa * a
                v_bb[j] += wb * b
                v_ab[j] += wa * b
        by_a, by_aa, by_ab = slopes[0, i], slopes[1, i], slopes[2, i]
        for j in range(across):
            m_a, m_b = _along(v_a, j, channels, w), _along(v_b, j, channels, w)
            m_aa, m_bb, m_ab = _along(v_aa, j, channels, w), _along(v_bb, j, channels, w), _along(v_ab, j, channels, w)
            # SSIM = (2 m_a m_b + c1) (2 cov + c2) / ((m_a^2 + m_b^2 + c1) (var_a + var_b + c2))
            light, shape = two * m_a * m_b + constants[0], two * (m_ab - m_a * m_b) + constants[1]
            per_light = one / (m_a * m_a + m_b * m_b + constants[0])
            per_shape = one / ((m_aa - m_a * m_a) + (m_bb - m_b * m_b) + constants[1])
            scale = per_light * per_shape
            value = light * shape * scale
            found[j] = value
            by_a[j] = two * m_b * (shape - light) * scale - two * m_a * value * (per_light - per_shape)
            by_aa[j] = -value * per_shape
            by_ab[j] = two * light * scale
        if counted.size:
            for j in range(across):
                if not counted[i, j]:
                    found[j] = 0
                    by_a[j] = 0
                    by_aa[j] = 0
                    by_ab[j] = 0
        row_sum = 0.0
        for j in range(across):
            row_sum += found[j]
        total += row_sum
    sums[band] = total


@cached_njit(fastmath=_FAST, **OPTIONS)
def spread_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    factor: Any,
    pair: Pair,
    slopes: Any,  # [3, H - 10, (W - 10) D]
    out: Any,  # [H, W D], written
) -> None:
    """Carry the windows' slopes back to a share of the picture's rows, times `factor`."""
    picture, target, channels = pair
    height, length = picture.shape
    across, first = length - 10 * channels, 10 * channels
    w = (window[0], window[1], window[2], window[3], window[4], window[5])
    wide = length + first  # zeros beside the windows
    v_a, v_aa, v_ab = np.zeros(wide, window.dtype), np.zeros(wide, window.dtype), np.zeros(wide, window.dtype)
    two = window.dtype.type(2)
    for i in range(height * band // bands, height * (band + 1) // bands):
        for values in (v_a, v_aa, v_ab):
            values[:] = 0
        for k in range(max(0, i + 11 - height), min(11, i + 1)):
            weight = window[k]
            by_a, by_aa, by_ab = slopes[0, i - k], slopes[1, i - k], slopes[2, i - k]
            for j in range(across):
                v_a[j + first] += weight * by_a[j]
                v_aa[j + first] += weight * by_aa[j]
                v_ab[j + first] += weight * by_ab[j]
        a, b, row = picture[i], target[i], out[i]
        for j in range(length):
            row[j] = factor * (
                _along(v_a, j, channels, w)
                + two * a[j] * _along(v_aa, j, channels, w)
                + b[j] * _along(v_ab, j, channels, w)
            )
