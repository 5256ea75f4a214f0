"""The compiled kernels of one square for few channels, which stay in registers, one vector per channel.

Forward, the Gaussians of a block are walked with the block's transmittance and sums in registers. Backward, the blocks
of a Gaussian are walked with the Gaussian's gradients in registers: sums over pixels are made once for all blocks. The
first channels are done in the same pass as the weights; a wider map goes on with the weights, LANES channels at a time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ..contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .simd import (
    LANES,
    add_dot,
    add_scaled,
    any_of,
    fetch,
    load,
    load_many,
    maximum,
    minimum,
    prefetch,
    put,
    reciprocal,
    select,
    spread,
    spread_many,
    store,
    store_many,
    sum_many,
    trailing_zeros,
    zero_many,
)
from .square import (
    ALL_BLOCKS,
    BLOCKS,
    CHUNK,
    FEATURES,
    FINAL,
    INLINE,
    LIGHT,
    PIXELS,
    PREFETCH_AHEAD,
    X,
    Y,
    list_hits,
    touched_blocks,
    weigh_pixels,
)

MOMENTS = FEATURES
"""Leading columns of a gradient row: sums of v, v dx, v dy, v dx^2, v dx dy, v dy^2 over a Gaussian's pixels, with v the
slope of the loss in log(alpha). The features' gradients follow."""

FEW, FIRST, GROUP = (0,) * 4, (0,) * (LANES - MOMENTS), (0,) * LANES
"""Channels per pass: the compiler knows a tuple's length. FIRST fills a row with the moments; FEW is enough for colours."""

CONTEST_CHUNK, CHECK_EVERY = 32, 8
"""Where only the largest channel is wanted: as CHUNK, because half of the blocks are decided after so many; and after how many
Gaussians of a block it is asked."""

MOST_DRAWN = math.ceil(math.log(TRANSMITTANCE_MIN) / math.log1p(-ALPHA_MIN))
"""The most Gaussians that a pixel draws, 2,345: each takes at least ALPHA_MIN of its light."""

BEHIND, SHARE, GRADS = 0, PIXELS, 2 * PIXELS
"""Planes of the backward pass: the part of the loss that comes from Gaussians behind; the slope of the loss in a weight apart
from its features; and the loss's gradient in each channel."""


def plan_passes(channels: int) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """The first pass's tuple, one that is empty if there is no other pass, and the channels of all passes."""
    if channels <= len(FEW):
        return FEW, (), len(FEW)
    rest = -(-max(channels - len(FIRST), 0) // LANES) * LANES
    return FIRST, (0,) if rest else (), len(FIRST) + rest


@njit(**INLINE)
def composite_square(
    packed: Any,
    span: tuple[int, int, int],
    state: Any,
    dark: Any,
    passes: Any,
    scratch: Any,
    trace: Any,
    columns: Any,
    contest: Any,
) -> int:
    """Composite a square's Gaussians; returns where in the list it was done.

    Args:
        packed: rows, their length, and the list of the Gaussians' numbers.
        span: where the square's list begins and ends, and where its trace begins.
        state: the square's planes, see `start_square`.
        dark: bits of blocks without pixels.
        passes: from `plan_passes`.
        scratch: corners; sums, one plane per channel; weights [CHUNK * LANES]; hits [BLOCKS * CHUNK]; counts [BLOCKS].
        trace: written: the blocks in which each Gaussian changed the light, as bits; None: there is no backward pass.
        columns: four channels to composite in place of the first four; None: all.
        contest: None, or, where the largest channel may be all that is wanted: how many planes of the sums compete; the most
            by which a Gaussian of weight 1 favours one channel over another; and the most by which rounding does
            (`round_off`). A block is done when no channel can overtake. An infinite favour: the sums are wanted, too.
    """
    rows, length, order = packed
    start, end, into = span
    corners, _, _, hits, counts = scratch
    position = start
    step = CHUNK if contest is None or contest[1] == np.inf else CONTEST_CHUNK
    while position < end and dark != ALL_BLOCKS:
        stop = min(position + step, end)
        list_hits(rows, length, order, (position, stop, into + position - start), dark, corners, hits, counts, trace)
        for block in range(BLOCKS):
            if counts[block] and not _composite_block(
                packed, state, block, passes, scratch, trace, into - start, columns, contest
            ):
                dark |= np.uint32(1) << np.uint32(block)
        position = stop
    return position


@njit(**INLINE)
def _composite_block(
    packed: Any, state: Any, block: int, passes: Any, scratch: Any, trace: Any, into: int, columns: Any, contest: Any
) -> bool:
    """Composite the listed Gaussians into one block; returns whether some pixel has not stopped and is not decided."""
    rows, length, order = packed
    first, more, channels = passes
    _, sums, weights, hits, counts = scratch
    p, listed, count = block * LANES, block * CHUNK, counts[block]
    bit = np.uint32(1) << np.uint32(block)
    x, y, light, final = load(state, X + p), load(state, Y + p), load(state, LIGHT + p), load(state, FINAL + p)
    total = load_many(first, sums, p, PIXELS)
    for k in range(count):
        j = np.int64(fetch(hits, listed + k))
        at = np.int64(fetch(order, j)) * length
        _, _, _, alpha = weigh_pixels(rows, at, x, y)
        before = light
        weight = alpha * light
        light = light * (1 - alpha)  # falls on after a pixel has stopped, so that it never starts again
        drawn = light >= TRANSMITTANCE_MIN
        weight = select(drawn, weight, 0)
        final = select(drawn, light, final)
        if columns is None:
            total = add_scaled(total, weight, spread_many(first, rows, at + FEATURES, 1))
        else:
            total = add_scaled(total, weight, _spread_columns(rows, at + FEATURES, columns))
        if len(more) > 0:
            store(weights, k * LANES, weight)
        if columns is not None and contest[1] < np.inf and k % CHECK_EVERY == CHECK_EVERY - 1:
            store_many(sums, p, PIXELS, total)
            if not any_of((light >= TRANSMITTANCE_MIN) & _undecided(sums, p, light, contest)):
                break
        # a Gaussian that stops a pixel changes it, although it is not drawn itself
        if trace is not None and not any_of((before >= TRANSMITTANCE_MIN) & (alpha > 0)):
            put(trace, into + j, np.uint32(fetch(trace, into + j)) & ~bit)
    store(state, LIGHT + p, light)
    store(state, FINAL + p, final)
    store_many(sums, p, PIXELS, total)
    if len(more) > 0:
        for channel in range(len(first), channels, LANES):
            _add_group(packed, FEATURES + channel, hits, listed, count, weights, sums, channel * PIXELS + p)
    going = light >= TRANSMITTANCE_MIN
    if contest is not None and contest[1] < np.inf:
        going = going & _undecided(sums, p, light, contest)
    return any_of(going)


@njit(**INLINE)
def _undecided(sums: Any, p: int, light: Any, contest: tuple[int, Any, Any]) -> Any:
    """Pixels of a block where another channel may still become the largest, or where the best is not positive yet."""
    count, favour, rounding = contest
    best, second = load(sums, p), spread(sums, -np.inf)
    for k in range(1, count):
        value = load(sums, k * PIXELS + p)
        second = maximum(second, minimum(best, value))
        best = maximum(best, value)
    return minimum(best - second - light * favour - rounding, best) <= 0


@njit(**INLINE)
def round_off(count: int, peak: Any, like: Any) -> Any:
    """The most by which rounding changes the difference of two sums of `count` weighted features, none larger than `peak`.

    Each step rounds a sum by half of a unit of its last digit, and the light by less than three halves: at most 4 units with
    two sums. 4 more steps are for the comparison itself. What is below `tiny` has a fixed last digit.
    """
    kind = np.finfo(like.dtype)
    return like.dtype.type(4 * (min(count, MOST_DRAWN) + 4) * float(kind.eps) * max(float(peak), float(kind.tiny)))


@njit(**INLINE)
def _spread_columns(rows: Any, at: int, columns: Any) -> Any:
    """Four numbers of a row, each in every lane of a vector."""
    a, b, c, d = columns
    return (
        spread(rows, fetch(rows, at + a)),
        spread(rows, fetch(rows, at + b)),
        spread(rows, fetch(rows, at + c)),
        spread(rows, fetch(rows, at + d)),
    )


@njit(**INLINE)
def _add_group(
    packed: Any, column: int, hits: Any, listed: int, count: int, weights: Any, sums: Any, into: int
) -> None:
    """Add weights times features for LANES channels of a block."""
    rows, length, order = packed
    total = load_many(GROUP, sums, into, PIXELS)
    for k in range(count):
        at = np.int64(fetch(order, np.int64(fetch(hits, listed + k)))) * length + column
        total = add_scaled(total, load(weights, k * LANES), spread_many(GROUP, rows, at, 1))
    store_many(sums, into, PIXELS, total)


@njit(**INLINE)
def differentiate_square(
    packed: Any,
    span: tuple[int, int, int],
    state: Any,
    passes: Any,
    planes: Any,
    weights: Any,
    trace: Any,
    slots: Any,
    out: Any,
) -> None:
    """Add the gradients of one square's pixels to the rows of its Gaussians.

    Front to back, like the forward pass. What lies behind is the whole minus what was in front, so alphas need not be stored.

    Args:
        packed: rows, their length, and the list of the Gaussians' numbers.
        span: where the square's list begins, where the forward pass was done, and where its trace begins.
        state: the square's planes, see `start_square`.
        passes: from `plan_passes`.
        planes: BEHIND, SHARE and GRADS.
        weights: [PIXELS], for the passes after the first.
        trace: the blocks in which each Gaussian changed the light.
        slots: where in `out` the row of each place in the list begins.
        out: gradient rows, as long as packed ones.
    """
    rows, length, order = packed
    start, end, into = span
    first, more, channels = passes
    for j in range(start, end):
        touched = np.uint32(fetch(trace, into + j - start))
        if touched == 0:
            continue
        prefetch(rows, np.int64(fetch(order, min(j + PREFETCH_AHEAD, end - 1))) * length)
        at = np.int64(fetch(order, j)) * length
        zero = spread(rows, 0)
        v_1, v_x, v_y, v_xx, v_xy, v_yy = zero, zero, zero, zero, zero, zero
        by_channel = zero_many(first, rows)
        remaining = touched
        while remaining:
            p = trailing_zeros(remaining) * LANES
            remaining &= remaining - np.uint32(1)
            dx, dy, full, alpha = weigh_pixels(rows, at, load(state, X + p), load(state, Y + p))
            light = load(state, LIGHT + p)
            weight = alpha * light
            clear = 1 - alpha
            light = light * clear
            store(state, LIGHT + p, light)
            drawn = light >= TRANSMITTANCE_MIN
            weight = select(drawn, weight, 0)
            grads = load_many(first, planes, GRADS + p, PIXELS)
            slope = add_dot(load(planes, SHARE + p), grads, spread_many(first, rows, at + FEATURES, 1))
            by_channel = add_scaled(by_channel, weight, grads)
            if len(more) > 0:
                store(weights, p, weight)
                for channel in range(len(first), channels, LANES):
                    others = load_many(GROUP, planes, GRADS + channel * PIXELS + p, PIXELS)
                    slope = add_dot(slope, others, spread_many(GROUP, rows, at + FEATURES + channel, 1))
            own = weight * slope
            behind = load(planes, BEHIND + p) - own
            store(planes, BEHIND + p, behind)
            v = own - alpha * behind * reciprocal(clear)
            v = select(drawn & (full <= ALPHA_MAX), v, 0)
            u_x, u_y = v * dx, v * dy
            v_1, v_x, v_y = v_1 + v, v_x + u_x, v_y + u_y
            v_xx, v_xy, v_yy = v_xx + u_x * dx, v_xy + u_x * dy, v_yy + u_y * dy
        row = np.int64(fetch(slots, j)) * length
        sums = sum_many((v_1, v_x, v_y, v_xx, v_xy, v_yy) + by_channel)  # noqa: RUF005, numba does not unpack
        store(out, row, load(out, row) + sums)
        if len(more) > 0:
            for channel in range(len(first), channels, LANES):
                place = row + MOMENTS + channel
                sums = _sum_group(weights, planes, GRADS + channel * PIXELS, touched)
                store(out, place, load(out, place) + sums)


@njit(**INLINE)
def _sum_group(weights: Any, planes: Any, start: int, touched: Any) -> Any:
    """Weights times LANES planes, summed over the pixels of the touched blocks."""
    total = zero_many(GROUP, planes)
    while touched:
        p = trailing_zeros(touched) * LANES
        touched &= touched - np.uint32(1)
        total = add_scaled(total, load(weights, p), load_many(GROUP, planes, start + p, PIXELS))
    return sum_many(total)


@njit(**INLINE)
def accumulate_square(
    packed: Any,
    span: tuple[int, int],
    state: Any,
    dark: Any,
    corners: Any,
    planes: Any,
    weights: Any,
    slots: Any,
    width: int,
    out: Any,
) -> None:
    """Add weights times planes to the rows of one square's Gaussians: the contract's point 7.

    Args:
        packed: rows, their length, and the list of the Gaussians' numbers.
        span: where the square's list begins and ends.
        state: the square's planes, see `start_square`.
        dark: bits of blocks without pixels.
        corners: see `touched_blocks`.
        planes: what is summed, a multiple of LANES planes.
        weights: [PIXELS], scratch.
        slots: where in `out` the row of each place in the list begins.
        width: of a row of `out`, as many numbers as there are planes.
        out: sums.
    """
    rows, length, order = packed
    epsilon = rows.dtype.type(np.finfo(rows.dtype).eps)
    for j in range(span[0], span[1]):
        if dark == ALL_BLOCKS:
            break
        prefetch(rows, np.int64(fetch(order, min(j + PREFETCH_AHEAD, span[1] - 1))) * length)
        at = np.int64(fetch(order, j)) * length
        touched = touched_blocks(rows, at, corners, epsilon) & ~dark
        remaining = touched
        while remaining:
            block = trailing_zeros(remaining)
            p = block * LANES
            remaining &= remaining - np.uint32(1)
            _, _, _, alpha = weigh_pixels(rows, at, load(state, X + p), load(state, Y + p))
            light = load(state, LIGHT + p)
            light_behind = light * (1 - alpha)
            drawn = light_behind >= TRANSMITTANCE_MIN
            store(state, LIGHT + p, light_behind)
            store(weights, p, select(drawn, alpha * light, 0))
            if not any_of(drawn):
                dark |= np.uint32(1) << np.uint32(block)
        for channel in range(0, width, LANES):
            place = np.int64(fetch(slots, j)) * width + channel
            store(out, place, load(out, place) + _sum_group(weights, planes, channel * PIXELS, touched))
