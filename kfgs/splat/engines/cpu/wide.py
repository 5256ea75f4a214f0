"""The compiled kernels of one square for many channels: weights first, then a product with the features in blocks.

The weights of a block's Gaussians are a small matrix [n, 16 pixels], its sums weights^T features [16, D], and what the
backward pass needs are features grads^T [n, 16] and weights grads [n, D]. Each product is cut into pieces whose sums fill
the registers: 4 x 4 vectors, so that 8 loads feed 16 multiplications. Channels run along the vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..contract import ALPHA_MAX, TRANSMITTANCE_MIN
from .simd import (
    LANES,
    add_outer,
    add_scaled,
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
    zero_many,
)
from .square import (
    ALL_BLOCKS,
    BLOCKS,
    CHUNK,
    FINAL,
    INLINE,
    LIGHT,
    PIXELS,
    X,
    Y,
    aligned,
    list_bits,
    list_hits,
    weigh_pixels,
)

FOUR, SIXTEEN = (0,) * 4, (0,) * 16
STEP = 4 * LANES
"""Channels of one piece."""


@njit(**INLINE)
def padded_length(channels: int) -> int:
    """Numbers in a row of whole vectors."""
    return -(-channels // LANES) * LANES


@njit(**INLINE)
def make_kept(like: Any) -> tuple[Any, Any, Any, Any]:
    """Room for what `weigh_block` keeps; three more, because products take four Gaussians at a time."""
    numbers = aligned(2 * (CHUNK + 3) * LANES, like)
    places = np.empty(2 * CHUNK, np.int64)
    return numbers[: (CHUNK + 3) * LANES], numbers[(CHUNK + 3) * LANES :], places[:CHUNK], places[CHUNK:]


@njit(**INLINE)
def weigh_block(
    packed: Any, block: int, state: Any, hits: Any, count: int, sources: Any, kept: Any
) -> tuple[int, bool]:
    """Composite the listed Gaussians into a block's transmittance, keeping those that are drawn.

    Args:
        packed: rows, their length, and the list of the Gaussians' numbers.
        block: which.
        state: the square's planes; LIGHT and FINAL move on.
        hits: see `list_hits`.
        count: Gaussians listed for the block.
        sources: where in the features each Gaussian's row begins: its number times D, by way of the index.
        kept: written: weights and ratios alpha / (1 - alpha) [CHUNK * LANES] (a ratio is 0 where alpha has no gradient),
            places in the list and places in the features [CHUNK].

    Returns:
        How many Gaussians are drawn, and whether some pixel has not stopped.
    """
    rows, length, order = packed
    weights, ratios, places, begins = kept
    p, listed, drawn_count = block * LANES, block * CHUNK, 0
    x, y, light, final = load(state, X + p), load(state, Y + p), load(state, LIGHT + p), load(state, FINAL + p)
    for k in range(count):
        j = np.int64(fetch(hits, listed + k))
        number = np.int64(fetch(order, j))
        _, _, full, alpha = weigh_pixels(rows, number * length, x, y)
        weight = alpha * light
        clear = 1 - alpha
        light = light * clear
        drawn = light >= TRANSMITTANCE_MIN
        weight = select(drawn, weight, 0)
        final = select(drawn, light, final)
        store(weights, drawn_count * LANES, weight)
        store(ratios, drawn_count * LANES, select(drawn & (full <= ALPHA_MAX), alpha * reciprocal(clear), 0))
        put(places, drawn_count, j)
        put(begins, drawn_count, fetch(sources, number))
        if any_of(weight > 0):
            drawn_count += 1
    store(state, LIGHT + p, light)
    store(state, FINAL + p, final)
    return drawn_count, any_of(light >= TRANSMITTANCE_MIN)


@njit(**INLINE)
def add_colors(
    sums: Any, into: int, stride: int, weights: Any, features: Any, begins: Any, count: int, channels: int, fresh: bool
) -> None:
    """sums[pixel, c] += weights[k, pixel] features[k, c] for a block's 16 pixels.

    Args:
        sums: rows of `stride` numbers, one per pixel.
        into: where the block's first row begins.
        stride: between rows.
        weights: [count, LANES].
        features: flat.
        begins: [count], where in `features` each Gaussian's row begins.
        count: Gaussians.
        channels: D.
        fresh: whether there is nothing in `sums` yet.
    """
    whole = channels // STEP * STEP
    for pixel in range(0, LANES, 4):
        row = into + pixel * stride
        for channel in range(0, whole, STEP):
            total = zero_many(SIXTEEN, sums)
            if not fresh:
                total = load_tile(sums, row + channel, stride)
            for k in range(count):
                values = load_many(FOUR, features, fetch(begins, k) + channel, LANES)
                total = add_outer(total, spread_many(FOUR, weights, k * LANES + pixel, 1), values)
            store_tile(sums, row + channel, stride, total)
        for channel in range(whole, channels, LANES):
            lanes = lanes_below(sums, channels - channel)
            column = zero_many(FOUR, sums)
            if not fresh:
                column = load_many(FOUR, sums, row + channel, stride)
            for k in range(count):
                value = load_part(features, fetch(begins, k) + channel, lanes)
                column = add_outer(column, spread_many(FOUR, weights, k * LANES + pixel, 1), (value,))
            store_many(sums, row + channel, stride, column)


@njit(**INLINE)
def load_tile(values: Any, start: int, stride: int) -> Any:
    """4 rows of 4 vectors."""
    a, b = load_many(FOUR, values, start, LANES), load_many(FOUR, values, start + stride, LANES)
    c, d = load_many(FOUR, values, start + 2 * stride, LANES), load_many(FOUR, values, start + 3 * stride, LANES)
    return a + b + c + d


@njit(**INLINE)
def store_tile(values: Any, start: int, stride: int, tile: Any) -> None:
    """The inverse of `load_tile`."""
    store_many(values, start, LANES, tile[0:4])
    store_many(values, start + stride, LANES, tile[4:8])
    store_many(values, start + 2 * stride, LANES, tile[8:12])
    store_many(values, start + 3 * stride, LANES, tile[12:16])


@njit(**INLINE)
def composite_square(
    packed: Any, span: tuple[int, int, int], state: Any, dark: Any, wide: Any, scratch: Any, trace: Any
) -> tuple[int, Any]:
    """Composite a square's Gaussians; returns where in the list it stopped, and a bit mask of the blocks with sums.

    The arguments are those of `narrow.composite_square`, but `wide` is features (flat), where each Gaussian's row begins,
    and D; `scratch` is corners, sums [PIXELS, padded D] in the order of blocks, kept (see `weigh_block`), hits and counts.
    """
    rows, length, order = packed
    features, sources, channels = wide
    start, end, into = span
    corners, sums, kept, hits, counts = scratch
    stride = padded_length(channels)
    position, filled = start, np.uint32(0)
    while position < end and dark != ALL_BLOCKS:
        stop = min(position + CHUNK, end)
        list_hits(rows, length, order, (position, stop, into + position - start), dark, corners, hits, counts, trace)
        for block in range(BLOCKS):
            if counts[block]:
                bit = np.uint32(1) << np.uint32(block)
                count, lit = weigh_block(packed, block, state, hits, counts[block], sources, kept)
                place, fresh = block * LANES * stride, (filled & bit) == 0
                add_colors(sums, place, stride, kept[0], features, kept[3], count, channels, fresh)
                filled |= bit
                if not lit:
                    dark |= bit
        position = stop
    return position, filled


@njit(**INLINE)
def differentiate_square(
    packed: Any,
    span: tuple[int, int, int],
    state: Any,
    wide: Any,
    grads: Any,
    planes: Any,
    scratch: Any,
    trace: Any,
    slots: Any,
    out: Any,
    geometry: bool,
) -> None:
    """Add the gradients of one square's pixels to the rows of its Gaussians.

    Args:
        packed: rows, their length, and the list of the Gaussians' numbers.
        span: where the square's list begins, where the forward pass was done, and where its trace begins.
        state: the square's planes, see `start_square`.
        wide: features (flat), where each Gaussian's row begins, and D.
        grads: the loss's gradient in the maps, [PIXELS, padded D] in the order of blocks, 0 outside of the image.
        planes: the loss that comes from what is still behind, then the slope in a weight apart from its features.
        scratch: kept, see `weigh_block`; slopes [(CHUNK + 3) * LANES]; hits; counts.
        trace: the blocks that each Gaussian may be drawn in.
        slots: the row of `out` of each place in the list.
        out: gradient rows: LANES numbers, of which the first are the moments, then padded D.
        geometry: whether the moments are wanted.
    """
    features, _, channels = wide
    kept, slopes, hits, counts = scratch
    start, end, into = span
    stride = padded_length(channels)
    for position in range(start, end, CHUNK):
        stop = min(position + CHUNK, end)
        list_traced(position, stop, into - start, hits, counts, trace)
        for block in range(BLOCKS):
            if counts[block] == 0:
                continue
            count, _ = weigh_block(packed, block, state, hits, counts[block], wide[1], kept)
            corner = block * LANES * stride
            if geometry:
                multiply_features(slopes, features, kept[3], grads, corner, stride, count, channels)
                add_moments(packed, block, state, planes, kept, slopes, count, slots, LANES + stride, out)
            add_features(out, LANES + stride, slots, kept, grads, corner, stride, count)


@njit(**INLINE)
def list_traced(first: int, stop: int, into: int, hits: Any, counts: Any, trace: Any) -> None:
    """List again, for each block, the Gaussians that the forward pass found to touch it."""
    counts[:] = 0
    for j in range(first, stop):
        list_bits(np.uint32(fetch(trace, into + j)), j, hits, counts)


@njit(**INLINE)
def multiply_features(
    slopes: Any, features: Any, begins: Any, grads: Any, corner: int, stride: int, count: int, channels: int
) -> None:
    """slopes[k, pixel] = sum_c features[k, c] grads[pixel, c] for a block's 16 pixels, 4 Gaussians at a time."""
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


@njit(**INLINE)
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


@njit(**INLINE)
def add_moments(
    packed: Any,
    block: int,
    state: Any,
    planes: Any,
    kept: Any,
    slopes: Any,
    count: int,
    slots: Any,
    width: int,
    out: Any,
) -> None:
    """Add the sums of v, v dx, v dy, v dx^2, v dx dy, v dy^2 over a block to the Gaussians' rows, front to back."""
    rows, length, order = packed
    weights, ratios, places, _ = kept
    p = block * LANES
    x, y = load(state, X + p), load(state, Y + p)
    behind, share = load(planes, p), load(planes, PIXELS + p)
    for k in range(count):
        j = np.int64(fetch(places, k))
        at = np.int64(fetch(order, j)) * length
        dx, dy = x - fetch(rows, at), y - fetch(rows, at + 1)
        own = load(weights, k * LANES) * (load(slopes, k * LANES) + share)
        behind = behind - own
        ratio = load(ratios, k * LANES)
        v = select(ratio > 0, own - ratio * behind, 0)
        u_x, u_y = v * dx, v * dy
        sums = sum_many((v, u_x, u_y, u_x * dx, u_x * dy, u_y * dy))
        row = np.int64(fetch(slots, j)) * width
        store(out, row, load(out, row) + sums)
    store(planes, p, behind)


@njit(**INLINE)
def add_features(out: Any, width: int, slots: Any, kept: Any, grads: Any, corner: int, stride: int, count: int) -> None:
    """out[k, c] += weights[k, pixel] grads[pixel, c], summed over a block's 16 pixels, 4 Gaussians at a time."""
    weights, _, places, _ = kept
    whole = stride // STEP * STEP
    for k in range(0, count, 4):
        n = min(4, count - k)
        for i in range(n, 4):  # what fills up the four weighs nothing
            store(weights, (k + i) * LANES, 0)
        r0 = np.int64(fetch(slots, np.int64(fetch(places, k)))) * width + LANES
        r1 = np.int64(fetch(slots, np.int64(fetch(places, k + min(1, n - 1))))) * width + LANES
        r2 = np.int64(fetch(slots, np.int64(fetch(places, k + min(2, n - 1))))) * width + LANES
        r3 = np.int64(fetch(slots, np.int64(fetch(places, k + min(3, n - 1))))) * width + LANES
        for channel in range(0, whole, STEP):
            total = zero_many(SIXTEEN, out)
            for pixel in range(LANES):
                values = load_many(FOUR, grads, corner + pixel * stride + channel, LANES)
                total = add_outer(total, spread_many(FOUR, weights, k * LANES + pixel, LANES), values)
            _add_vectors(out, r0 + channel, total[0:4])
            _add_vectors(out, r1 + channel, total[4:8])
            _add_vectors(out, r2 + channel, total[8:12])
            _add_vectors(out, r3 + channel, total[12:16])
        for channel in range(whole, stride, LANES):
            column = zero_many(FOUR, out)
            for pixel in range(LANES):
                value = load(grads, corner + pixel * stride + channel)
                column = add_outer(column, spread_many(FOUR, weights, k * LANES + pixel, LANES), (value,))
            _add_vectors(out, r0 + channel, column[0:1])
            _add_vectors(out, r1 + channel, column[1:2])
            _add_vectors(out, r2 + channel, column[2:3])
            _add_vectors(out, r3 + channel, column[3:4])


@njit(**INLINE)
def _add_vectors(out: Any, place: int, vectors: Any) -> None:
    """Add neighbouring vectors to what is there."""
    store_many(out, place, LANES, add_scaled(vectors, spread(out, 1), load_many(vectors, out, place, LANES)))
