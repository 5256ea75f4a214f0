"""The compiled kernels of one square for many channels, and of accumulation for any: weights first, then a product in blocks.

The weights of a block's Gaussians are a small matrix [n, 16 pixels], its sums weights^T features [16, D], and what the
backward pass needs are features grads^T [n, 16] and weights grads [n, D]. Each product is cut into pieces whose sums fill
the registers: 4 x 4 vectors, so that 8 loads feed 16 multiplications. Channels run along the vectors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..contract import ALPHA_MAX, TRANSMITTANCE_MIN
from .cache import inner_njit
from .simd import (
    LANES,
    add_dot,
    add_outer,
    any_of,
    fetch,
    lanes_below,
    load,
    load_many,
    load_part,
    put,
    reciprocal,
    regroup,
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
    FINAL,
    LIGHT,
    PIXELS,
    Rows,
    Square,
    X,
    Y,
    aligned,
    list_hits,
    weigh_pixels,
)

FOUR, SIXTEEN = (0,) * 4, (0,) * 16


@inner_njit(forceinline=True)
def padded_length(channels: int) -> int:
    """Numbers in a row of whole vectors."""
    return -(-channels // LANES) * LANES


class Source(NamedTuple):
    """The features, which stay where they are."""

    values: Any  # [N * D]
    begins: Any  # [M], where each Gaussian's row begins: its number times D, by way of the index
    channels: int  # D


class Kept(NamedTuple):
    """What `weigh_block` keeps of the Gaussians that a block draws; room for three more, for products take four at a time."""

    weights: Any  # [(CHUNK + 3) * LANES]
    ratios: Any  # the same of alpha / (1 - alpha), 0 where alpha has no gradient
    places: Any  # [CHUNK] in the list
    begins: Any  # [CHUNK] in the features


@inner_njit(forceinline=True)
def make_kept(like: Any) -> Kept:
    """Memory of the array's type."""
    numbers = aligned(2 * (CHUNK + 3) * LANES, like)
    half = (CHUNK + 3) * LANES
    return Kept(numbers[:half], numbers[half:], np.empty(CHUNK, np.int64), np.empty(CHUNK, np.int64))


@inner_njit(forceinline=True)
def weigh_block(rows: Rows, block: int, square: Square, begins: Any, kept: Kept, ratios: Any) -> tuple[int, bool]:
    """Composite the listed Gaussians into a block's transmittance, keeping those that are drawn.

    Without `begins` or `ratios` (None), the part of `kept` that takes them is not written.

    Returns:
        How many Gaussians are drawn, and whether some pixel has not stopped.
    """
    values, length, order = rows
    state = square.state
    p, listed, drawn_count = block * LANES, block * CHUNK, 0
    x, y, light, final = load(state, X + p), load(state, Y + p), load(state, LIGHT + p), load(state, FINAL + p)
    for k in range(square.counts[block]):
        j = np.int64(fetch(square.hits, listed + k))
        number = np.int64(fetch(order, j))
        _, _, full, alpha = weigh_pixels(values, number * length, x, y)
        weight = alpha * light
        clear = 1 - alpha
        light = light * clear
        drawn = light >= TRANSMITTANCE_MIN
        weight = select(drawn, weight, 0)
        final = select(drawn, light, final)
        store(kept.weights, drawn_count * LANES, weight)
        put(kept.places, drawn_count, j)
        if ratios is not None:
            store(ratios, drawn_count * LANES, select(drawn & (full <= ALPHA_MAX), alpha * reciprocal(clear), 0))
        if begins is not None:
            put(kept.begins, drawn_count, fetch(begins, number))
        if any_of(weight > 0):
            drawn_count += 1
    store(state, LIGHT + p, light)
    store(state, FINAL + p, final)
    return drawn_count, any_of(light >= TRANSMITTANCE_MIN)


@inner_njit(forceinline=True)
def add_colors(
    sums: Any,  # rows of `stride` numbers, one per pixel; the block's begin at `into`
    into: int,
    stride: int,
    kept: Kept,
    source: Source,
    count: int,  # Gaussians
    fresh: bool,  # whether there is nothing in `sums` yet
) -> None:
    """sums[pixel, c] += weights[k, pixel] features[k, c] for a block's 16 pixels."""
    for channel in range(0, source.channels, LANES):
        lanes, at = lanes_below(sums, source.channels - channel), into + channel
        total = zero_many(SIXTEEN, sums) if fresh else load_many(SIXTEEN, sums, at, stride)
        for k in range(count):
            value = load_part(source.values, fetch(kept.begins, k) + channel, lanes)
            total = add_outer(total, spread_many(SIXTEEN, kept.weights, k * LANES, 1), (value,))
        store_many(sums, at, stride, total)


@inner_njit(forceinline=True)
def composite_square(
    rows: Rows,
    span: tuple[int, int, int],  # where the square's list begins and ends, and where its trace begins
    square: Square,
    dark: Any,  # bits of blocks without pixels
    source: Source,
    sums: Any,  # [PIXELS, padded D] in the order of blocks, written
    kept: Kept,
    trace: Any,  # written: bits of the blocks that each Gaussian touches; None: there is no backward pass
) -> tuple[int, Any]:
    """Composite a square's Gaussians; returns where in the list it stopped, and a bit mask of the blocks with sums."""
    start, end, into = span
    stride = padded_length(source.channels)
    position, filled, counts = start, np.uint32(0), square.counts
    while position < end and dark != ALL_BLOCKS:
        stop = min(position + CHUNK, end)
        list_hits(rows, (position, stop), dark, square, trace, into + position - start)
        for block in range(BLOCKS):
            if counts[block]:
                bit = np.uint32(1) << np.uint32(block)
                count, lit = weigh_block(rows, block, square, source.begins, kept, None)
                add_colors(sums, block * LANES * stride, stride, kept, source, count, (filled & bit) == 0)
                filled |= bit
                if not lit:
                    dark |= bit
        position = stop
    return position, filled


@inner_njit(forceinline=True)
def differentiate_square(
    rows: Rows,
    span: tuple[int, int, int],  # where the list begins, where the forward pass was done, where its trace begins
    square: Square,
    source: Source,
    grads: Any,  # [PIXELS, padded D] the loss's gradient in the maps, in the order of blocks, 0 outside of the image
    planes: Any,  # the loss that comes from what is still behind, then the slope in a weight apart from its features
    kept: Kept,
    slopes: Any,  # [(CHUNK + 3) * LANES], scratch
    trace: Any,  # bits of the blocks that each Gaussian may be drawn in
    slots: Any,  # the row of `out` of each place in the list
    out: Any,  # gradient rows: LANES numbers, of which the first are the moments, then padded D
    geometry: bool,  # whether the moments are wanted
) -> None:
    """Add the gradients of one square's pixels to the rows of its Gaussians."""
    start, end, into = span
    stride = padded_length(source.channels)
    hits, counts = square.hits, square.counts
    for position in range(start, end, CHUNK):
        counts[:] = 0
        for j in range(position, min(position + CHUNK, end)):  # list again what the forward pass found
            touched = np.uint32(fetch(trace, into + j - start))
            while touched:
                block = trailing_zeros(touched)
                touched &= touched - np.uint32(1)
                number = fetch(counts, block)
                put(hits, block * CHUNK + number, j)
                put(counts, block, number + 1)
        for block in range(BLOCKS):
            if counts[block] == 0:
                continue
            count, _ = weigh_block(rows, block, square, source.begins, kept, kept.ratios)
            corner = block * LANES * stride
            if geometry:
                multiply_features(slopes, source, kept.begins, grads, corner, stride, count)
                add_moments(rows, block, square.state, planes, kept, slopes, count, slots, LANES + stride, out)
            add_features(out, LANES + stride, slots, kept, grads, corner, stride, count)


@inner_njit(forceinline=True)
def multiply_features(
    slopes: Any, source: Source, begins: Any, grads: Any, corner: int, stride: int, count: int
) -> None:
    """slopes[k, pixel] = sum_c features[k, c] grads[pixel, c] for a block's 16 pixels, 4 Gaussians at a time."""
    features, channels = source.values, source.channels
    for k in range(0, count, 4):
        last = count - 1
        four = (
            np.int64(fetch(begins, k)),
            np.int64(fetch(begins, min(k + 1, last))),
            np.int64(fetch(begins, min(k + 2, last))),
            np.int64(fetch(begins, min(k + 3, last))),
        )
        a = _multiply_quad(features, four, grads, corner, stride, channels)
        b = _multiply_quad(features, four, grads, corner + 4 * stride, stride, channels)
        c = _multiply_quad(features, four, grads, corner + 8 * stride, stride, channels)
        d = _multiply_quad(features, four, grads, corner + 12 * stride, stride, channels)
        store_many(slopes, k * LANES, LANES, regroup((a, b, c, d)))


@inner_njit(forceinline=True)
def _multiply_quad(features: Any, four: Any, grads: Any, row: int, stride: int, channels: int) -> Any:
    """Products of four Gaussians (quarters of the vector) with four pixels (places in a quarter)."""
    f0, f1, f2, f3 = four
    whole = channels // LANES * LANES
    total = zero_many(SIXTEEN, grads)
    for c in range(0, whole, LANES):
        values = (load(features, f0 + c), load(features, f1 + c), load(features, f2 + c), load(features, f3 + c))
        total = add_outer(total, values, load_many(FOUR, grads, row + c, stride))
    if whole < channels:
        lanes = lanes_below(grads, channels - whole)
        values = (
            load_part(features, f0 + whole, lanes),
            load_part(features, f1 + whole, lanes),
            load_part(features, f2 + whole, lanes),
            load_part(features, f3 + whole, lanes),
        )
        total = add_outer(total, values, load_many(FOUR, grads, row + whole, stride))
    return sum_many(total)


@inner_njit(forceinline=True)
def add_moments(
    rows: Rows,
    block: int,
    state: Any,
    planes: Any,
    kept: Kept,
    slopes: Any,
    count: int,
    slots: Any,
    width: int,
    out: Any,
) -> None:
    """Add the sums of v, v dx, v dy, v dx^2, v dx dy, v dy^2 over a block to the Gaussians' rows, front to back."""
    values, length, order = rows
    weights, ratios, places, _ = kept
    p = block * LANES
    x, y = load(state, X + p), load(state, Y + p)
    behind, share = load(planes, p), load(planes, PIXELS + p)
    for k in range(count):
        j = np.int64(fetch(places, k))
        at = np.int64(fetch(order, j)) * length
        dx, dy = x - fetch(values, at), y - fetch(values, at + 1)
        own = load(weights, k * LANES) * (load(slopes, k * LANES) + share)
        behind = behind - own
        ratio = load(ratios, k * LANES)
        v = select(ratio > 0, own - ratio * behind, 0)
        u_x, u_y = v * dx, v * dy
        sums = sum_many((v, u_x, u_y, u_x * dx, u_x * dy, u_y * dy))
        row = np.int64(fetch(slots, j)) * width
        store(out, row, load(out, row) + sums)
    store(planes, p, behind)


@inner_njit(forceinline=True)
def add_features(
    out: Any, width: int, slots: Any, kept: Kept, grads: Any, corner: int, stride: int, count: int
) -> None:
    """out[k, c] += weights[k, pixel] grads[pixel, c], summed over a block's 16 pixels; a row of `out` ends in the channels."""
    for channel in range(0, stride, LANES):
        pixels = load_many(SIXTEEN, grads, corner + channel, stride)
        for k in range(count):
            place = (np.int64(fetch(slots, np.int64(fetch(kept.places, k)))) + 1) * width - stride + channel
            total = add_dot(spread(out, 0), spread_many(SIXTEEN, kept.weights, k * LANES, 1), pixels)
            store(out, place, load(out, place) + total)


@inner_njit(forceinline=True)
def accumulate_square(
    rows: Rows,
    span: tuple[int, int],  # where the square's list begins and ends
    square: Square,
    dark: Any,  # bits of blocks without pixels
    pixels: Any,  # [PIXELS, width] what is summed, in the order of blocks
    kept: Kept,
    slots: Any,  # the row of `out` of each place in the list
    width: int,  # of a row of `out`
    out: Any,  # added to
) -> None:
    """Add weights times pixels to the rows of one square's Gaussians (`Engine.accumulate`)."""
    position, end = span
    while position < end and dark != ALL_BLOCKS:
        stop = min(position + CHUNK, end)
        list_hits(rows, (position, stop), dark, square, None, 0)
        for block in range(BLOCKS):
            if square.counts[block]:
                count, lit = weigh_block(rows, block, square, None, kept, None)
                add_features(out, width, slots, kept, pixels, block * LANES * width, width, count)
                if not lit:
                    dark |= np.uint32(1) << np.uint32(block)
        position = stop
