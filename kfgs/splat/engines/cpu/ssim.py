"""SSIM of training, compiled: its mean over the windows of a picture, and the gradient in one walk there and back.

Not part of an engine: `kfgs.splat.engines.table.compiled_ssim` gives it to who trains on a CPU.

Channels stay side by side, so a vector holds neighbouring numbers. Each row of windows is blurred downwards, then along; the
gradient takes the same two steps back. A blurred row stays in cache. No two shares of rows write the same memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from .cache import cached_njit, inner_njit
from .memory import flat, take_memory
from .simd import (
    LANES,
    add_outer,
    fma,
    lanes_below,
    load,
    load_many,
    load_part,
    select,
    spread,
    spread_many,
    store,
    store_many,
    store_part,
    sum_lanes,
    zero_many,
)
from .square import aligned
from .threads import run_bands

WINDOW = 11
"""Pixels of the Gaussian window's side."""

ONE, THREE, FOUR = (0,), (0,) * 3, (0,) * 4
_BAND = 32  # rows of a share


@torch.no_grad()
def mean_ssim(
    picture: Tensor,  # [H, W, D] contiguous, float32 or float64 on the CPU, at least 11 pixels on each side
    target: Tensor,  # [H, W, D] likewise
    counted: Tensor | None,  # [H - 10, W - 10] bool, which windows count, at least one; None = all
    window: Tensor,  # [11] weights of the window along an axis; symmetric, sum 1
    constants: tuple[float, float],  # (K1 peak)^2 and (K2 peak)^2, which keep flat windows finite
    mix: tuple[float, float] = (1.0, 0.0),
) -> tuple[Tensor, Tensor]:  # [], [H, W, D]
    """Mean SSIM over the (counted) windows inside the picture, and a gradient in `picture`.

    The gradient is that of mix[0] times the SSIM plus mix[1] times the mean absolute difference.
    """
    height, width, channels = picture.shape
    rows, across = height - WINDOW + 1, (width - WINDOW + 1) * channels
    weights, padded = window.numpy(), -(-across // LANES) * LANES
    kind = weights.dtype.type
    mask = np.empty((0, 0), kind) if counted is None else np.zeros((rows, padded), kind)
    if counted is not None:
        mask[:, :across] = np.repeat(counted.numpy(), channels, axis=1)
    count = rows * across if counted is None else int(counted.sum()) * channels
    slopes, out = take_memory(picture, 3 * rows * padded), take_memory(picture, *picture.shape)
    bands = -(-rows // _BAND)
    sums = np.empty(bands)
    shared = bands, weights, (height, width * channels, channels), (flat(picture), flat(target)), slopes.numpy()
    run_bands(compare_band, bands, *shared, (kind(constants[0]), kind(constants[1])), mask.ravel(), sums)
    run_bands(spread_band, bands, *shared, (kind(mix[0] / count), kind(mix[1] / out.numel())), flat(out))
    return picture.new_tensor(sums.sum() / count), out


@inner_njit(forceinline=True)
def _along(values: Any, j: int, step: int, window: Any) -> Any:
    """The window's weighted sums, of numbers `step` apart, that begin at LANES places from j on."""
    total = load(values, j + 5 * step) * window[5]
    for k in range(5):
        total = fma(load(values, j + k * step) + load(values, j + (10 - k) * step), window[k], total)
    return total


@cached_njit()
def compare_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    shape: tuple[int, int, int],  # rows, numbers in a row (W D), D
    pictures: Any,  # two [H W D]
    slopes: Any,  # [3 * (H - 10) * padded], written; 0 beyond a row's last window
    constants: tuple[Any, Any],
    counted: Any,  # [(H - 10) * padded] 1 or 0, or empty
    sums: Any,  # [bands], written
) -> None:
    """Sum SSIM over a share of the windows; keep its slopes in the windows' means of a, a^2 and a b."""
    picture, target = pictures
    height, length, channels = shape
    rows, across = height - WINDOW + 1, length - (WINDOW - 1) * channels
    padded, room = len(slopes) // (3 * rows), length + (WINDOW - 1) * channels + 2 * LANES
    blurred = aligned(4 * room, window)  # down the window: of a, b, a^2 + b^2 and a b
    blurred[:] = 0
    total = 0.0
    for i in range(rows * band // bands, rows * (band + 1) // bands):
        for j in range(0, length, LANES):
            inside, (s_a, s_b, s_square, s_ab) = lanes_below(window, length - j), zero_many(FOUR, window)
            for k in range(WINDOW):
                at = (i + k) * length + j
                a, b = load_part(picture, at, inside), load_part(target, at, inside)
                near, far = a * window[k], b * window[k]
                s_a, s_b, s_ab = s_a + near, s_b + far, fma(near, b, s_ab)
                s_square = fma(far, b, fma(near, a, s_square))
            store_many(blurred, j, room, (s_a, s_b, s_square, s_ab))
        for j in range(0, padded, LANES):
            m_a, m_b = _along(blurred, j, channels, window), _along(blurred, room + j, channels, window)
            m_square = _along(blurred, 2 * room + j, channels, window)
            m_ab = _along(blurred, 3 * room + j, channels, window)
            # SSIM = (2 m_a m_b + c1) (2 cov + c2) / ((m_a^2 + m_b^2 + c1) (var_a + var_b + c2))
            both, squares = m_a * m_b, fma(m_a, m_a, m_b * m_b)
            light, structure = both * 2 + constants[0], (m_ab - both) * 2 + constants[1]
            under_light, under_structure = squares + constants[0], m_square - squares + constants[1]
            scale = 1 / (under_light * under_structure)
            value = light * structure * scale
            difference = (under_structure - under_light) * scale  # 1 / under_light - 1 / under_structure
            counts = lanes_below(window, across - j)
            if len(counted):
                counts = counts & (load(counted, i * padded + j) > 0)
            by_a = (m_b * (structure - light) * scale - m_a * value * difference) * 2
            store(slopes, i * padded + j, select(counts, by_a, 0))
            store(slopes, (rows + i) * padded + j, select(counts, value * under_light * scale * -1, 0))
            store(slopes, (2 * rows + i) * padded + j, select(counts, light * scale * 2, 0))
            total += float(sum_lanes(select(counts, value, 0)))
    sums[band] = total


@cached_njit()
def spread_band(
    band: int,
    bands: int,
    window: Any,  # [11]
    shape: tuple[int, int, int],  # rows, numbers in a row (W D), D
    pictures: Any,  # two [H W D]
    slopes: Any,  # [3 * (H - 10) * padded]
    factors: tuple[Any, Any],  # of the slopes, and of the sign of the difference
    out: Any,  # [H W D], written
) -> None:
    """Carry the windows' slopes back to a share of the picture's rows, and add those of the absolute difference."""
    picture, target = pictures
    height, length, channels = shape
    rows, first = height - WINDOW + 1, (WINDOW - 1) * channels
    padded = len(slopes) // (3 * rows)
    room = padded + 2 * first + 2 * LANES  # zeros beside the windows
    blurred = aligned(3 * room, window)
    blurred[:] = 0
    for i in range(height * band // bands, height * (band + 1) // bands):
        for j in range(0, padded, LANES):
            up = zero_many(THREE, window)
            for k in range(max(0, i + WINDOW - height), min(WINDOW, i + 1)):
                values = load_many(THREE, slopes, (i - k) * padded + j, rows * padded)
                up = add_outer(up, spread_many(ONE, window, k, 1), values)
            store_many(blurred, first + j, room, up)
        for j in range(0, length, LANES):
            inside, at = lanes_below(window, length - j), i * length + j
            a, b = load_part(picture, at, inside), load_part(target, at, inside)
            slope = fma(a * 2, _along(blurred, room + j, channels, window), _along(blurred, j, channels, window))
            slope = fma(b, _along(blurred, 2 * room + j, channels, window), slope) * factors[0]
            apart = spread(window, factors[1])
            store_part(out, at, inside, slope + select(a > b, apart, select(a < b, apart * -1, 0)))
