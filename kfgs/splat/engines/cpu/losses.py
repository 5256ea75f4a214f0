"""The compiled losses of training: mean absolute difference, SSIM, and their gradients.

Not part of an engine: `kfgs.splat.engines.table.compiled_losses` gives this module to who trains or decodes on a CPU.

In SSIM channels stay side by side, so a vector holds neighbouring numbers. Each row of windows is blurred downwards, then along;
the gradient takes the same two steps back. A blurred row stays in cache. No two shares of rows write the same memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from .cache import cached_njit
from .memory import flat, take_memory
from .perceptron import decide as decide
from .simd import (
    LANES,
    bits,
    fetch,
    fma,
    lanes_below,
    load,
    load_part,
    maximum,
    put,
    select,
    spread,
    store,
    store_part,
    sum_lanes,
)
from .square import INLINE, OPTIONS, aligned
from .threads import run_bands

WINDOW = 11
"""Pixels of the Gaussian window's side."""

_LAST = WINDOW - 1
_BAND = 32  # rows of a share of SSIM
_SHARE = 8192  # pixels of a share of the absolute difference
_RUN = 64 * LANES  # numbers that are summed in the maps' own precision
_ALL = np.uint32(0xFFFF)


@torch.no_grad()
def absolute(
    picture: Tensor,  # [H, W, D] contiguous, float32 or float64 on the CPU
    target: Tensor,  # [H, W, D] likewise; a pixel with NaN in a channel is unknown and does not count
) -> tuple[Tensor, Tensor]:  # [], [H, W, D]
    """The mean of |picture - target| over the known pixels' channels (0 if none is known), and its gradient in `picture`."""
    channels, pixels = picture.shape[2], picture.shape[0] * picture.shape[1]
    a, out, bands = flat(picture), take_memory(picture, *picture.shape), max(1, -(-pixels // _SHARE))
    sums, counts = np.zeros(bands), np.zeros(bands, np.int64)
    slope = a.dtype.type(1 / max(1, len(a)))
    run_bands(absolute_band, bands, bands, a, flat(target), channels, slope, flat(out), sums, counts)
    known = max(1, int(counts.sum()))
    if known < pixels:
        out *= pixels / known
    return picture.new_tensor(sums.sum() / (known * channels)), out


@cached_njit(**OPTIONS)
def absolute_band(
    band: int,
    bands: int,
    picture: Any,  # [H W D]
    target: Any,  # [H W D]
    channels: int,
    slope: Any,  # of a positive difference
    out: Any,  # [H W D], written: slope, -slope or 0
    sums: Any,  # [bands], written: of the absolute differences
    counts: Any,  # [bands], written: known pixels
) -> None:
    """A share of the pixels, as numbers in a row; where pixels are unknown, once more one by one."""
    pixels = len(out) // channels
    first, last = pixels * band // bands, pixels * (band + 1) // bands
    total, seen, nothing = 0.0, _ALL, spread(out, 0)
    for begin in range(first * channels, last * channels, _RUN):
        apart, end = spread(out, 0), min(begin + _RUN, last * channels)
        for at in range(begin, end, LANES):
            inside = lanes_below(out, end - at)
            a, b = load_part(picture, at, inside), load_part(target, at, inside)
            difference = a - b
            seen &= bits(b <= b)
            apart = apart + maximum(difference, b - a)
            store_part(out, at, inside, select(difference > 0, slope, select(difference < 0, -slope, nothing)))
        total += float(sum_lanes(apart))
    sums[band], counts[band] = total, last - first
    if seen == _ALL:
        return
    sums[band] = 0
    for pixel in range(first, last):
        size, known = 0.0, True
        for at in range(pixel * channels, (pixel + 1) * channels):
            size += abs(fetch(picture, at) - fetch(target, at))
            known = known and not np.isnan(fetch(target, at))
        if known:
            sums[band] += size
        else:
            out[pixel * channels : (pixel + 1) * channels] = 0
            counts[band] -= 1


@torch.no_grad()
def similarity(
    picture: Tensor,  # [H, W, D] contiguous, float32 or float64 on the CPU, at least 11 pixels on each side
    target: Tensor,  # [H, W, D] likewise
    counted: Tensor | None,  # [H - 10, W - 10] bool, which windows count, at least one; None = all
    window: Tensor,  # [11] weights of the window along an axis; symmetric, sum 1
    constants: tuple[float, float],  # (K1 peak)^2 and (K2 peak)^2, which keep flat windows finite
    mix: tuple[float, float] = (1.0, 0.0),
) -> tuple[Tensor, Tensor, Tensor]:  # [], [], [H, W, D]
    """Mean SSIM over the (counted) windows inside the picture, mean absolute difference, and a gradient in `picture`.

    The gradient is that of mix[0] times the SSIM plus mix[1] times the absolute difference.
    """
    height, width, channels = picture.shape
    a, b = flat(picture), flat(target)
    rows, across = height - _LAST, (width - _LAST) * channels
    padded = -(-across // LANES) * LANES
    kind = a.dtype.type
    mask = np.empty((0, 0), bool) if counted is None else np.repeat(counted.numpy(), channels, axis=1)
    count = rows * across if counted is None else int(mask.sum())
    slopes, out = take_memory(picture, 3 * rows * padded), take_memory(picture, *picture.shape)
    bands = -(-rows // _BAND)
    sums = np.empty((2, bands))
    shape = Shape(height, width * channels, channels, padded)
    limits, factors = (kind(constants[0]), kind(constants[1])), (kind(mix[0] / count), kind(mix[1] / len(a)))
    run_bands(compare_band, bands, bands, window.numpy(), limits, shape, (a, b), mask, slopes.numpy(), sums[0])
    run_bands(
        spread_band, bands, bands, window.numpy(), factors, shape, (a, b), slopes.numpy(), out.view(-1).numpy(), sums[1]
    )
    return picture.new_tensor(sums[0].sum() / count), picture.new_tensor(sums[1].sum() / len(a)), out


class Shape(NamedTuple):
    """Of pictures whose channels lie side by side."""

    height: int
    length: int  # numbers in a row: W D
    channels: int  # D
    padded: int  # numbers from one row of slopes to the next: (W - 10) D, up to whole vectors


@njit(**INLINE)
def _along(values: Any, j: Any, step: Any, w: Any) -> Any:
    """The window's weighted sums, of numbers `step` apart, that begin at LANES places from j on."""
    total = load(values, j + 5 * step) * w[5]
    total = fma(load(values, j) + load(values, j + 10 * step), w[0], total)
    total = fma(load(values, j + step) + load(values, j + 9 * step), w[1], total)
    total = fma(load(values, j + 2 * step) + load(values, j + 8 * step), w[2], total)
    total = fma(load(values, j + 3 * step) + load(values, j + 7 * step), w[3], total)
    return fma(load(values, j + 4 * step) + load(values, j + 6 * step), w[4], total)


@cached_njit(**OPTIONS)
def compare_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    constants: tuple[Any, Any],
    shape: Shape,
    pictures: Any,  # two [H W D]
    counted: Any,  # [H - 10, (W - 10) D] bool, or empty
    slopes: Any,  # [3 * (H - 10) * padded], written
    sums: Any,  # [bands], written
) -> None:
    """Sum SSIM over a share of the windows; keep its slopes in the windows' means of a, a^2 and a b."""
    picture, target = pictures
    height, length, channels, padded = shape
    rows, across = height - 10, length - 10 * channels
    w = (window[0], window[1], window[2], window[3], window[4], window[5])
    room = length + 10 * channels + 2 * LANES
    v_a, v_b = aligned(room, window), aligned(room, window)
    v_square, v_ab = aligned(room, window), aligned(room, window)
    for values in (v_a, v_b, v_square, v_ab):
        values[:] = 0
    similar = aligned(padded, window)
    total = 0.0
    for i in range(rows * band // bands, rows * (band + 1) // bands):
        for j in range(0, length, LANES):
            inside = lanes_below(window, length - j)
            zero = spread(window, 0)
            s_a, s_b, s_square, s_ab = zero, zero, zero, zero
            for k in range(11):
                at = (i + k) * length + j
                a, b = load_part(picture, at, inside), load_part(target, at, inside)
                weighted, other = a * window[k], b * window[k]
                s_a, s_b = s_a + weighted, s_b + other
                s_square = fma(other, b, fma(weighted, a, s_square))
                s_ab = fma(weighted, b, s_ab)
            store(v_a, j, s_a)
            store(v_b, j, s_b)
            store(v_square, j, s_square)
            store(v_ab, j, s_ab)
        by_a, by_square, by_ab = i * padded, (rows + i) * padded, (2 * rows + i) * padded
        for j in range(0, padded, LANES):
            m_a, m_b = _along(v_a, j, channels, w), _along(v_b, j, channels, w)
            m_square, m_ab = _along(v_square, j, channels, w), _along(v_ab, j, channels, w)
            # SSIM = (2 m_a m_b + c1) (2 cov + c2) / ((m_a^2 + m_b^2 + c1) (var_a + var_b + c2))
            both, squares = m_a * m_b, fma(m_a, m_a, m_b * m_b)
            light, structure = both * 2 + constants[0], (m_ab - both) * 2 + constants[1]
            under_light, under_structure = squares + constants[0], m_square - squares + constants[1]
            scale = 1 / (under_light * under_structure)
            value = light * structure * scale
            store(similar, j, value)
            difference = (under_structure - under_light) * scale  # 1 / under_light - 1 / under_structure
            store(slopes, by_a + j, (m_b * (structure - light) * scale - m_a * value * difference) * 2)
            store(slopes, by_square + j, value * under_light * scale * -1)
            store(slopes, by_ab + j, light * scale * 2)
        if counted.size:
            for j in range(across):
                if not counted[i, j]:
                    put(similar, j, 0)
                    put(slopes, by_a + j, 0)
                    put(slopes, by_square + j, 0)
                    put(slopes, by_ab + j, 0)
        for j in range(across):
            total += fetch(similar, j)
    sums[band] = total


@cached_njit(**OPTIONS)
def spread_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    factors: tuple[Any, Any],  # of the slopes and of the sign of the difference
    shape: Shape,
    pictures: Any,  # two [H W D]
    slopes: Any,  # [3 * (H - 10) * padded]
    out: Any,  # [H W D], written
    sums: Any,  # [bands], written: the absolute difference
) -> None:
    """Carry the windows' slopes back to a share of the picture's rows, and add those of the absolute difference."""
    picture, target = pictures
    height, length, channels, padded = shape
    rows, first = height - 10, 10 * channels
    across = length - first
    w = (window[0], window[1], window[2], window[3], window[4], window[5])
    room = padded + 2 * first + 2 * LANES  # zeros beside the windows
    v_a, v_square, v_ab = aligned(room, window), aligned(room, window), aligned(room, window)
    for values in (v_a, v_square, v_ab):
        values[:] = 0
    total = 0.0
    for i in range(height * band // bands, height * (band + 1) // bands):
        for j in range(0, padded, LANES):
            inside, zero = lanes_below(window, across - j), spread(window, 0)
            s_a, s_square, s_ab = zero, zero, zero
            for k in range(max(0, i + 11 - height), min(11, i + 1)):
                at = (i - k) * padded + j
                s_a = fma(load(slopes, at), window[k], s_a)
                s_square = fma(load(slopes, at + rows * padded), window[k], s_square)
                s_ab = fma(load(slopes, at + 2 * rows * padded), window[k], s_ab)
            store_part(v_a, first + j, inside, s_a)
            store_part(v_square, first + j, inside, s_square)
            store_part(v_ab, first + j, inside, s_ab)
        apart = spread(window, 0)
        for j in range(0, length, LANES):
            inside, at = lanes_below(window, length - j), i * length + j
            a, b = load_part(picture, at, inside), load_part(target, at, inside)
            slope = fma(a * 2, _along(v_square, j, channels, w), _along(v_a, j, channels, w))
            slope = fma(b, _along(v_ab, j, channels, w), slope) * factors[0]
            difference = a - b
            apart = apart + maximum(difference, b - a)
            sign = select(difference > 0, factors[1], select(difference < 0, -factors[1], spread(window, 0)))
            store_part(out, at, inside, slope + sign)
        total += float(sum_lanes(apart))
    sums[band] = total
