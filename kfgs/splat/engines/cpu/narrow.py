"""The compiled kernels of one square for few channels, which stay in registers, one vector per channel.

Forward, the Gaussians of a block are walked with the block's transmittance and sums in registers. Backward, the blocks
of a Gaussian are walked with the Gaussian's gradients in registers: sums over pixels are made once for all blocks. The
first channels are done in the same pass as the weights; a wider map then uses the weights for LANES channels at a time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from .cache import inner_njit
from .simd import (
    LANES,
    add_dot,
    add_outer,
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
    LIGHT,
    PIXELS,
    PREFETCH_AHEAD,
    Rows,
    Square,
    X,
    Y,
    list_hits,
    weigh_pixels,
)

MOMENTS = FEATURES
"""Leading columns of a gradient row: sums of v, v dx, v dy, v dx^2, v dx dy, v dy^2 over a Gaussian's pixels, with v the
slope of the loss in log(alpha). The features' gradients follow."""

FEW, FIRST, GROUP = (0,) * 4, (0,) * (LANES - MOMENTS), (0,) * LANES
"""Channels per pass: the compiler knows a tuple's length. FIRST fills a row with the moments; FEW is enough for colours."""

MOST_CHANNELS = len(FIRST) + LANES
"""The most channels that are summed in registers, one vector each; more are multiplied as small matrices (`wide`)."""

CONTEST_CHUNK, CHECK_EVERY = 32, 8
"""Where only the largest channel is wanted: as CHUNK, because half of the blocks are decided after so many; and after how many
Gaussians of a block this is tested."""

MOST_DRAWN = math.ceil(math.log(TRANSMITTANCE_MIN) / math.log1p(-ALPHA_MIN))
"""The most Gaussians that a pixel draws, 2,345: each takes at least ALPHA_MIN of its light."""

BEHIND, SHARE, GRADS = 0, PIXELS, 2 * PIXELS
"""Planes of the backward pass: the part of the loss that comes from Gaussians behind; the slope of the loss in a weight apart
from its features; and the loss's gradient in each channel."""


class Passes(NamedTuple):
    """How the channels are cut."""

    first: tuple[int, ...]  # as long as the first pass has channels
    more: tuple[int, ...]  # empty if there is no other pass
    channels: int  # of all passes


def plan_passes(channels: int) -> Passes:
    """One pass for few channels; else LANES channels in each pass after the first."""
    if channels <= len(FEW):
        return Passes(FEW, (), len(FEW))
    rest = -(-max(channels - len(FIRST), 0) // LANES) * LANES
    return Passes(FIRST, (0,) if rest else (), len(FIRST) + rest)


class Contest(NamedTuple):
    """When a block is done although light is left: the largest channel is wanted, and no other can overtake it."""

    planes: int  # of the sums, which compete
    favour: Any  # of one channel over another, the most of a Gaussian of weight 1; infinite: sums are wanted, too
    rounding: Any  # the most by which rounding does, see `round_off`


@inner_njit(forceinline=True)
def composite_square(
    rows: Rows,
    span: tuple[int, int, int],  # where the square's list begins and ends, and where its trace begins
    square: Square,
    dark: Any,  # bits of blocks without pixels
    passes: Passes,
    sums: Any,  # [channels * PIXELS], added to
    weights: Any,  # [CHUNK * LANES], scratch
    trace: Any,  # written: bits of the blocks in which each Gaussian changed the light; None: there is no backward pass
    columns: Any,  # four channels to composite in place of the first four; None: all
    contest: Any,  # Contest, or None: all Gaussians count
) -> int:
    """Composite a square's Gaussians; returns where in the list it was done."""
    start, end, into = span
    position, counts = start, square.counts
    step = CHUNK if contest is None or contest.favour == np.inf else CONTEST_CHUNK
    while position < end and dark != ALL_BLOCKS:
        stop = min(position + step, end)
        list_hits(rows, (position, stop), dark, square, trace, into + position - start)
        for block in range(BLOCKS):
            if counts[block] and not _composite_block(
                rows, square, block, passes, sums, weights, trace, into - start, columns, contest
            ):
                dark |= np.uint32(1) << np.uint32(block)
        position = stop
    return position


@inner_njit(forceinline=True)
def _composite_block(
    rows: Rows,
    square: Square,
    block: int,
    passes: Passes,
    sums: Any,
    weights: Any,
    trace: Any,
    into: int,
    columns: Any,
    contest: Any,
) -> bool:
    """Composite the listed Gaussians into one block; returns whether some pixel has not stopped and is not decided."""
    values, length, order = rows
    state, hits, first = square.state, square.hits, passes.first
    p, listed, count = block * LANES, block * CHUNK, square.counts[block]
    bit = np.uint32(1) << np.uint32(block)
    x, y, light, final = load(state, X + p), load(state, Y + p), load(state, LIGHT + p), load(state, FINAL + p)
    total = load_many(first, sums, p, PIXELS)
    for k in range(count):
        j = np.int64(fetch(hits, listed + k))
        at = np.int64(fetch(order, j)) * length
        _, _, _, alpha = weigh_pixels(values, at, x, y)
        before = light
        weight = alpha * light
        light = light * (1 - alpha)  # falls further after a pixel has stopped, so that it never starts again
        drawn = light >= TRANSMITTANCE_MIN
        weight = select(drawn, weight, 0)
        final = select(drawn, light, final)
        if columns is None:
            total = add_outer(total, (weight,), spread_many(first, values, at + FEATURES, 1))
        else:
            a, b = fetch(values, at + FEATURES + columns[0]), fetch(values, at + FEATURES + columns[1])
            c, d = fetch(values, at + FEATURES + columns[2]), fetch(values, at + FEATURES + columns[3])
            chosen = spread(values, a), spread(values, b), spread(values, c), spread(values, d)
            total = add_outer(total, (weight,), chosen)
        if len(passes.more) > 0:
            store(weights, k * LANES, weight)
        if columns is not None and contest.favour < np.inf and k % CHECK_EVERY == CHECK_EVERY - 1:
            store_many(sums, p, PIXELS, total)
            if not any_of((light >= TRANSMITTANCE_MIN) & _undecided(sums, p, light, contest)):
                break
        # a Gaussian that stops a pixel changes it, although it is not drawn itself
        if trace is not None and not any_of((before >= TRANSMITTANCE_MIN) & (alpha > 0)):
            put(trace, into + j, np.uint32(fetch(trace, into + j)) & ~bit)
    store(state, LIGHT + p, light)
    store(state, FINAL + p, final)
    store_many(sums, p, PIXELS, total)
    if len(passes.more) > 0:
        for channel in range(len(first), passes.channels, LANES):
            plane = channel * PIXELS + p
            total = load_many(GROUP, sums, plane, PIXELS)
            for k in range(count):
                at = np.int64(fetch(order, np.int64(fetch(hits, listed + k)))) * length + FEATURES + channel
                total = add_outer(total, (load(weights, k * LANES),), spread_many(GROUP, values, at, 1))
            store_many(sums, plane, PIXELS, total)
    going = light >= TRANSMITTANCE_MIN
    if contest is not None and contest.favour < np.inf:
        going = going & _undecided(sums, p, light, contest)
    return any_of(going)


@inner_njit(forceinline=True)
def _undecided(sums: Any, p: int, light: Any, contest: Contest) -> Any:
    """Pixels of a block where another channel may still become the largest, or where the best is not positive yet."""
    planes, favour, rounding = contest
    best, second = load(sums, p), spread(sums, -np.inf)
    for k in range(1, planes):
        value = load(sums, k * PIXELS + p)
        second = maximum(second, minimum(best, value))
        best = maximum(best, value)
    return minimum(best - second - light * favour - rounding, best) <= 0


@inner_njit(forceinline=True)
def round_off(count: int, peak: Any, like: Any) -> Any:
    """The most by which rounding changes the difference of two sums of `count` weighted features, none larger than `peak`.

    Each step rounds a sum by half of a unit of its last digit, and the light by less than three halves: at most 4 units with
    two sums. 4 more steps are for the comparison itself. What is below `tiny` has a fixed last digit.
    """
    kind = np.finfo(like.dtype)
    return like.dtype.type(4 * (min(count, MOST_DRAWN) + 4) * float(kind.eps) * max(float(peak), float(kind.tiny)))


@inner_njit(forceinline=True)
def differentiate_square(
    rows: Rows,
    span: tuple[int, int, int],  # where the list begins, where the forward pass was done, where its trace begins
    square: Square,
    passes: Passes,
    planes: Any,  # BEHIND, SHARE and GRADS
    weights: Any,  # [PIXELS], scratch for the passes after the first
    trace: Any,  # bits of the blocks in which each Gaussian changed the light
    slots: Any,  # the row of `out` of each place in the list
    out: Any,  # gradient rows, as long as packed ones
) -> None:
    """Add the gradients of one square's pixels to the rows of its Gaussians.

    Front to back, like the forward pass. What lies behind is the whole minus what was in front, so alphas need not be stored.
    """
    values, length, order = rows
    start, end, into = span
    state, first = square.state, passes.first
    for j in range(start, end):
        touched = np.uint32(fetch(trace, into + j - start))
        if touched == 0:
            continue
        prefetch(values, np.int64(fetch(order, min(j + PREFETCH_AHEAD, end - 1))) * length)
        at = np.int64(fetch(order, j)) * length
        zero = spread(values, 0)
        v_1, v_x, v_y, v_xx, v_xy, v_yy = zero, zero, zero, zero, zero, zero
        by_channel = zero_many(first, values)
        remaining = touched
        while remaining:
            p = trailing_zeros(remaining) * LANES
            remaining &= remaining - np.uint32(1)
            dx, dy, full, alpha = weigh_pixels(values, at, load(state, X + p), load(state, Y + p))
            light = load(state, LIGHT + p)
            weight = alpha * light
            clear = 1 - alpha
            light = light * clear
            store(state, LIGHT + p, light)
            drawn = light >= TRANSMITTANCE_MIN
            weight = select(drawn, weight, 0)
            grads = load_many(first, planes, GRADS + p, PIXELS)
            slope = add_dot(load(planes, SHARE + p), grads, spread_many(first, values, at + FEATURES, 1))
            by_channel = add_outer(by_channel, (weight,), grads)
            if len(passes.more) > 0:
                store(weights, p, weight)
                for channel in range(len(first), passes.channels, LANES):
                    others = load_many(GROUP, planes, GRADS + channel * PIXELS + p, PIXELS)
                    slope = add_dot(slope, others, spread_many(GROUP, values, at + FEATURES + channel, 1))
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
        if len(passes.more) > 0:
            for channel in range(len(first), passes.channels, LANES):
                place = row + MOMENTS + channel
                sums = _sum_group(weights, planes, GRADS + channel * PIXELS, touched)
                store(out, place, load(out, place) + sums)


@inner_njit(forceinline=True)
def _sum_group(weights: Any, planes: Any, start: int, touched: Any) -> Any:
    """Weights times LANES planes, summed over the pixels of the touched blocks."""
    total = zero_many(GROUP, planes)
    while touched:
        p = trailing_zeros(touched) * LANES
        touched &= touched - np.uint32(1)
        total = add_outer(total, (load(weights, p),), load_many(GROUP, planes, start + p, PIXELS))
    return sum_many(total)
