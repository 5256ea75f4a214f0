"""The compiled kernels over a band of tiles, forward: compositing and accumulation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from . import narrow as narrow
from . import wide as wide
from .cache import cached_njit
from .simd import (
    LANES,
    add_scaled,
    lanes_below,
    load,
    load_many,
    put,
    spread_many,
    store,
    store_many,
    store_part,
    transpose,
)
from .square import (
    BLOCK_SIDE,
    BLOCKS,
    CHUNK,
    FINAL,
    INLINE,
    OPTIONS,
    PIXELS,
    STATE,
    Picture,
    View,
    aligned,
    read_block,
    square_box,
    start_square,
    write_block,
)

SIXTEEN = (0,) * LANES
"""A block's pixels, or as many channels."""


@njit(**INLINE)
def whole_planes(passes: Any, channels: int) -> int:
    """Planes that hold the channels of all passes, and of whole vectors of channels."""
    return max(passes[2], wide.padded_length(channels))


@njit(**INLINE)
def _write_alphas(state: Any, box: tuple[int, int, int, int], alphas: Any, finals: Any, width: int) -> None:
    """Transmittance of a square's pixels, and 1 - transmittance."""
    left, top, right, bottom = box
    for y in range(bottom - top):
        for x in range(right - left):
            p = (y // BLOCK_SIDE * BLOCK_SIDE + x // BLOCK_SIDE) * LANES + y % BLOCK_SIDE * BLOCK_SIDE + x % BLOCK_SIDE
            put(finals, (top + y) * width + left + x, state[FINAL + p])
            put(alphas, (top + y) * width + left + x, 1 - state[FINAL + p])


@cached_njit(**OPTIONS)
def composite_narrow(
    band: int, view: View, rows: Any, length: int, passes: Any, background: Any, images: Any, trace: Any
) -> None:
    """Composite the tiles of one band, with few channels.

    Args:
        band: which.
        view: the tiles.
        rows: packed Gaussians with their features.
        length: of a packed row.
        passes: from `plan_passes`.
        background: D numbers, and zeros up to a whole vector.
        images: maps [H * W * D], alphas [H * W] and transmittances [H * W], written.
        trace: written: per tile and square how many Gaussians were looked at, then the blocks that each was drawn in.
    """
    maps, alphas, finals = images
    channels = len(maps) // len(alphas)
    picture, planes = Picture(maps, view.width, channels), whole_planes(passes, channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    sums, weights = aligned(planes * PIXELS, rows), aligned(CHUNK * LANES, rows)
    sums[:] = 0
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    block_sums = aligned(LANES * LANES, rows)
    squares = view.across**2
    drawn = trace[squares * (len(view.offsets) - 1) :]
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(squares):
            box = square_box(view, tile, square)
            if box[0] >= box[2] or box[1] >= box[3]:
                continue
            dark = start_square(state, corners, box)
            sums[: passes[2] * PIXELS] = 0
            span = start, end, start * squares + square * (end - start)
            scratch = corners, sums, weights, hits, counts
            packed = rows, length, view.order
            done = narrow.composite_square(packed, span, state, dark, passes, scratch, drawn, None, None)
            trace[tile * squares + square] = done - start
            _write_alphas(state, box, alphas, finals, view.width)
            for block in range(BLOCKS):
                p = block * LANES
                final = load(state, FINAL + p)
                for channel in range(0, channels, LANES):
                    total = load_many(SIXTEEN, sums, channel * PIXELS + p, PIXELS)
                    total = add_scaled(total, final, spread_many(SIXTEEN, background, channel, 1))
                    store_many(block_sums, 0, LANES, transpose(total))
                    write_block(picture, box, block, channel, block_sums, 0, LANES)


@cached_njit(**OPTIONS)
def composite_wide(
    band: int, view: View, rows: Any, length: int, features: Any, begins: Any, background: Any, images: Any, trace: Any
) -> None:
    """As `composite_narrow`, with many channels: the Gaussians are packed without features.

    The features are flat; the row that Gaussian m shows begins at `begins[m]`.
    """
    maps, alphas, finals = images
    channels = len(maps) // len(alphas)
    stride = wide.padded_length(channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    sums = aligned(PIXELS * stride, rows)
    kept = wide.make_kept(rows)
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    squares = view.across**2
    drawn = trace[squares * (len(view.offsets) - 1) :]
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(squares):
            box = square_box(view, tile, square)
            if box[0] >= box[2] or box[1] >= box[3]:
                continue
            dark = start_square(state, corners, box)
            span = start, end, start * squares + square * (end - start)
            scratch = corners, sums, kept, hits, counts
            packed, source = (rows, length, view.order), (features, begins, channels)
            done, filled = wide.composite_square(packed, span, state, dark, source, scratch, drawn)
            trace[tile * squares + square] = done - start
            _write_alphas(state, box, alphas, finals, view.width)
            for y in range(box[3] - box[1]):
                for x in range(box[2] - box[0]):
                    block = y // BLOCK_SIDE * BLOCK_SIDE + x // BLOCK_SIDE
                    p = block * LANES + y % BLOCK_SIDE * BLOCK_SIDE + x % BLOCK_SIDE
                    at = ((box[1] + y) * view.width + box[0] + x) * channels
                    summed = (filled >> np.uint32(block)) & 1
                    _write_pixel(maps, at, channels, sums, p * stride, summed, background, state[FINAL + p])


@njit(**INLINE)
def _write_pixel(
    maps: Any, at: int, channels: int, sums: Any, place: int, filled: int, background: Any, final: Any
) -> None:
    """A pixel's sums, if it has any, and what shows through."""
    whole = channels // LANES * LANES
    lanes = lanes_below(maps, channels - whole)
    for channel in range(0, whole, LANES):
        value = load(background, channel) * final
        if filled:
            value = value + load(sums, place + channel)
        store(maps, at + channel, value)
    if whole < channels:
        value = load(background, whole) * final
        if filled:
            value = value + load(sums, place + whole)
        store_part(maps, at + whole, lanes, value)


@cached_njit(**OPTIONS)
def accumulate_band(
    band: int, view: View, rows: Any, length: int, pixels: Any, channels: int, slots: Any, firsts: Any, out: Any
) -> None:
    """Sum one band's pixels into its own rows of `out`, weighted: the weights' sum follows the channels.

    Args:
        band: which.
        view: the tiles.
        rows: packed Gaussians without features.
        length: of a packed row.
        pixels: [H * W * D].
        channels: D.
        slots: [P] from `number_slots`.
        firsts: [B + 1], where the bands' rows begin.
        out: [R * padded_length(D + 1)], written.
    """
    width = wide.padded_length(channels + 1)
    picture = Picture(pixels, view.width, channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes, weights = aligned(width * PIXELS, rows), aligned(PIXELS, rows)
    planes[:] = 0
    scratch = aligned(LANES * LANES, rows)
    own = out[firsts[band] * width : firsts[band + 1] * width]
    own[:] = 0
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(view.across**2):
            box = square_box(view, tile, square)
            if start == end or box[0] >= box[2] or box[1] >= box[3]:
                continue
            dark = start_square(state, corners, box)
            for block in range(BLOCKS):
                for channel in range(0, channels, LANES):
                    read_block(picture, box, block, channel, scratch, 0, LANES)
                    values = transpose(load_many(SIXTEEN, scratch, 0, LANES))
                    store_many(planes, channel * PIXELS + block * LANES, PIXELS, values)
            planes[channels * PIXELS : (channels + 1) * PIXELS] = 1
            packed = rows, length, view.order
            narrow.accumulate_square(packed, (start, end), state, dark, corners, planes, weights, slots, width, own)
