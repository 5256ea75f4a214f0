"""Mean absolute difference of two maps and its gradient, compiled by numba: one walk over both."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from .cache import cached_njit
from .memory import take_memory
from .simd import (
    LANES,
    bits,
    fetch,
    lanes_below,
    load_part,
    maximum,
    put,
    select,
    spread,
    store_part,
    sum_lanes,
)
from .square import INLINE, OPTIONS
from .threads import run_bands

__all__ = ["absolute"]

_SHARE = 8192  # pixels of a band
_RUN = 64 * LANES  # numbers that are summed in the maps' own precision
_ALL = np.uint32(0xFFFF)


@torch.no_grad()
def absolute(
    picture: Tensor,  # [H, W, D]
    target: Tensor,  # [H, W, D]
) -> tuple[Tensor, Tensor]:  # [], [H, W, D]
    """The mean of |picture - target| over the known pixels' channels (0 if none is known), and its gradient in `picture`.

    Args:
        picture: contiguous float32 or float64 on the CPU.
        target: of the same shape and dtype, contiguous. A pixel with NaN in a channel is unknown and does not count.
    """
    channels, pixels = picture.shape[2], picture.shape[0] * picture.shape[1]
    a, b = (value.detach().view(-1).numpy() for value in (picture, target))
    out, bands = take_memory(picture, *picture.shape), max(1, -(-pixels // _SHARE))
    sums, counts = np.zeros(bands), np.zeros(bands, np.int64)
    slope = a.dtype.type(1 / max(1, len(a)))
    run_bands(absolute_band, bands, bands, (a, b), channels, slope, out.view(-1).numpy(), sums, counts)
    known = max(1, int(counts.sum()))
    if known < pixels:
        out *= pixels / known
    return picture.new_tensor(sums.sum() / (known * channels)), out


@cached_njit(**OPTIONS)
def absolute_band(
    band: int, bands: int, maps: Any, channels: int, slope: Any, out: Any, sums: Any, counts: Any
) -> None:
    """A share of the pixels.

    Args:
        band: which share.
        bands: how many shares.
        maps: picture and target [H W D].
        channels: D.
        slope: of a positive difference.
        out: [H W D], written: slope, -slope or 0.
        sums: [bands], written: of the absolute differences.
        counts: [bands], written: known pixels.
    """
    pixels = len(out) // channels
    first, last = pixels * band // bands, pixels * (band + 1) // bands
    total, known = _whole_share(maps, first * channels, last * channels, slope, out)
    count = last - first
    if not known:
        total, count = _share_with_holes(maps, first, last, channels, slope, out)
    sums[band], counts[band] = total, count


@njit(**INLINE)
def _whole_share(maps: Any, first: int, last: int, slope: Any, out: Any) -> tuple[float, bool]:
    """The sum over some numbers, and whether all of the target's are known; else the sum is wrong."""
    picture, target = maps
    total, nothing = 0.0, spread(out, 0)
    for begin in range(first, last, _RUN):
        apart, seen = spread(out, 0), _ALL
        end = min(begin + _RUN, last)
        for at in range(begin, end, LANES):
            inside = lanes_below(out, end - at)
            a, b = load_part(picture, at, inside), load_part(target, at, inside)
            difference = a - b
            seen &= bits(b <= b)
            apart = apart + maximum(difference, b - a)
            store_part(out, at, inside, select(difference > 0, slope, select(difference < 0, -slope, nothing)))
        if seen != _ALL:
            return 0.0, False
        total += float(sum_lanes(apart))
    return total, True


@njit(**INLINE)
def _share_with_holes(maps: Any, first: int, last: int, channels: int, slope: Any, out: Any) -> tuple[float, int]:
    """The same, pixel by pixel; and how many are known."""
    picture, target = maps
    total, count = 0.0, 0
    for pixel in range(first, last):
        known = True
        for at in range(pixel * channels, (pixel + 1) * channels):
            known = known and not np.isnan(fetch(target, at))
        count += known
        for at in range(pixel * channels, (pixel + 1) * channels):
            put(out, at, 0)
            if known:
                difference = fetch(picture, at) - fetch(target, at)
                total += abs(difference)
                if difference > 0:
                    put(out, at, slope)
                elif difference < 0:
                    put(out, at, -slope)
    return total, count
