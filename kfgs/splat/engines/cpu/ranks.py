"""The compiled kernels over a band of tiles that rank channels: composite class scores, and keep each pixel's best classes.

The sums of a square stay in cache, and only the best classes and their scores are written. There is no backward pass, so
nothing is traced. The sums are those of `composite_band`, to the bit.

If labels alone are wanted, a block of pixels is done when its best classes lead by more than the light that is left could
change: after about half of its Gaussians.

If only the best class is wanted and no score is negative, most classes need no sum: a class can win only where some
Gaussian of the tile gives it a fair share, at least one C-th of all that it gives (`find_candidates`). Elsewhere its sum
is below the mean of all sums. With the votes of a room of 18 classes, a tile has 3 such classes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import narrow, wide
from .bands import SIXTEEN
from .cache import cached_njit, inner_njit
from .simd import LANES, fetch, load, load_many, put, select, spread, store, store_many, transpose
from .square import (
    BLOCK_SIDE,
    BLOCKS,
    CHUNK,
    FINAL,
    PIXELS,
    Rows,
    View,
    aligned,
    find_place,
    make_square,
    squares_of,
    start_square,
)


@inner_njit(forceinline=True)
def _rank_block(
    planes: Any,  # channel c of the pixels is the vector at place + c * stride
    place: int,
    stride: int,
    channels: int,  # how many there are, at least 1
    final: Any,  # the pixels' transmittance: 1 where nothing was drawn, and the channels are then -1
    ranked: Any,  # channels and sums [top * LANES] each, written; numbers of the data's type, exact below 2^24
    columns: Any,  # [channels], how the channels are named
) -> None:
    """The best channels of a block's 16 pixels, the best first; of equal ones the lowest first."""
    names, values = ranked
    drawn = final < 1
    last, chosen = spread(planes, np.inf), spread(planes, -1)
    for rank in range(0, len(names), LANES):
        best, which = spread(planes, -np.inf), spread(planes, 0)
        for k in range(channels):
            value, channel = load(planes, place + k * stride), fetch(columns, k)
            better = value > best
            if rank > 0:  # what comes after the channel chosen before, by value, then by number
                better = better & ((value < last) | ((value <= last) & (chosen < channel)))
            best, which = select(better, value, best), select(better, channel, which)
        store(names, rank, select(drawn, which, -1))
        store(values, rank, select(drawn, best, 0))
        last, chosen = best, which


@inner_njit(forceinline=True)
def _write_ranks(ranked: Any, final: Any, box: Any, block: int, images: Any, width: int) -> None:
    """Labels, scores and alphas of a block's pixels, as far as they lie in the box."""
    names, values = ranked
    labels, scores, alphas = images
    top = len(names) // LANES
    left, up = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    for y in range(min(box[3] - up, BLOCK_SIDE)):
        for x in range(min(box[2] - left, BLOCK_SIDE)):
            pixel, lane = (up + y) * width + left + x, y * BLOCK_SIDE + x
            put(alphas, pixel, 1 - final[lane])
            for rank in range(top):
                put(labels, pixel * top + rank, np.int64(names[rank * LANES + lane]))
                put(scores, pixel * top + rank, values[rank * LANES + lane])


@cached_njit()
def find_candidates(band: int, bands: int, features: Any, channels: int, index: Any, masks: Any, favours: Any) -> None:
    """The channels of which a Gaussian gives at least a fair share, as bits; all channels if it gives less than nothing.

    A thousandth less than the fair share is enough: sums of up to 8,000 Gaussians do not round by more. A Gaussian that
    gives nothing counts for the first channel, which wins where all are 0.

    Args:
        band: which share of the Gaussians.
        bands: how many shares.
        features: [N * D].
        channels: D, at most 64.
        index: [M], the features' row of each Gaussian; empty if row m belongs to Gaussian m.
        masks: [M] uint64, written.
        favours: [M * 2], written: the largest feature minus the smallest (infinite if one is not finite), and the largest
            absolute value.
    """
    count = len(masks)
    for m in range(count * band // bands, count * (band + 1) // bands):
        at = (fetch(index, m) if len(index) else m) * channels
        total, least, most = 0.0, np.inf, -np.inf
        for channel in range(channels):
            value = float(fetch(features, at + channel))
            total += value
            least, most = min(least, value), max(most, value)
        put(favours, 2 * m, most - least if abs(total) < np.inf else np.inf)
        put(favours, 2 * m + 1, max(most, -least))
        share, mask = 0.999 * total / channels, np.uint64(0)
        for channel in range(channels):
            if fetch(features, at + channel) >= share:
                mask |= np.uint64(1) << np.uint64(channel)
        mask = mask if total > 0 else np.uint64(1)
        masks[m] = mask if least >= 0 and total < np.inf else ~np.uint64(0)


@inner_njit(forceinline=True)
def _gather_columns(
    contest: Any, order: Any, start: int, end: int, channels: int, columns: Any
) -> tuple[int, float, float]:
    """Write the channels that may win among some Gaussians; returns how many, and the largest favour and absolute feature."""
    masks, favours = contest
    mask, favour, peak = np.uint64(0), 0.0, 0.0
    for j in range(start, end):
        m = np.int64(fetch(order, j))
        mask |= fetch(masks, m)
        favour, peak = max(favour, fetch(favours, 2 * m)), max(peak, fetch(favours, 2 * m + 1))
    count = 0
    for channel in range(channels):
        columns[count] = channel
        count += np.int64((mask >> np.uint64(channel)) & np.uint64(1))  # type: ignore[assignment]
    return count, favour, peak


@cached_njit()
def rank_band(
    band: int,
    view: View,
    rows: Rows,
    passes: Any,  # narrow.Passes; None with many channels
    source: Any,  # wide.Source; None with few channels, which are packed
    channels: int,  # D
    candidates: Any,  # masks and favours from `find_candidates`; empty: every channel may be among the best
    early: bool,  # stop where the best channel is certain: scores and alphas are then not complete
    images: Any,  # labels and scores [H * W * top] and alphas [H * W], written
) -> None:
    """Rank the channels at the pixels of one band."""
    top, stride = len(images[0]) // len(images[2]), wide.padded_length(channels)
    square = make_square(rows.values)
    ranked = aligned(top * LANES, rows.values), aligned(top * LANES, rows.values)
    every, some = np.arange(channels), np.zeros(channels + len(narrow.FEW), np.int64)
    if passes is not None:
        sums, weights = aligned(passes.channels * PIXELS, rows.values), aligned(CHUNK * LANES, rows.values)
    if source is not None:
        sums, planes = aligned(PIXELS * stride, rows.values), aligned(stride * LANES, rows.values)
        kept = wide.make_kept(rows.values)
    for number in squares_of(view, band):
        place = find_place(view, number)
        dark = start_square(square, place.box)
        span, count, names = (place.start, place.end, place.start), channels, every
        if passes is not None:
            few, favour, peak = channels, np.inf, 0.0
            if len(candidates[0]):
                few, favour, peak = _gather_columns(candidates, view.order, place.start, place.end, channels, some)
            favour = rows.values.dtype.type(favour if early else np.inf)
            rounding = narrow.round_off(place.end - place.start, peak, rows.values)
            if few <= len(narrow.FEW) < channels:
                count, names = few, some
                sums[: len(narrow.FEW) * PIXELS] = 0
                columns, plan = (some[0], some[1], some[2], some[3]), narrow.Passes(narrow.FEW, (), len(narrow.FEW))
                contest = narrow.Contest(few, favour, rounding)
                narrow.composite_square(rows, span, square, dark, plan, sums, weights, None, columns, contest)
            else:
                sums[:] = 0
                contest = narrow.Contest(channels, favour, rounding)
                narrow.composite_square(rows, span, square, dark, passes, sums, weights, None, None, contest)
        if source is not None:
            _, filled = wide.composite_square(rows, span, square, dark, source, sums, kept, None)
        for block in range(BLOCKS):
            p = block * LANES
            final = load(square.state, FINAL + p)
            if passes is not None:
                _rank_block(sums, p, PIXELS, count, final, ranked, names)
            if source is not None:
                if (filled >> np.uint32(block)) & 1:
                    for channel in range(0, stride, LANES):
                        pixels = load_many(SIXTEEN, sums, p * stride + channel, stride)
                        store_many(planes, channel * LANES, LANES, transpose(pixels))
                _rank_block(planes, 0, LANES, channels, final, ranked, every)
            _write_ranks(ranked, square.state[FINAL + p : FINAL + p + LANES], place.box, block, images, view.width)
