"""The compiled kernels over a band of tiles, forward: compositing and accumulation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from . import narrow, wide
from .cache import cached_njit, inner_njit
from .simd import (
    LANES,
    add_outer,
    lanes_below,
    load,
    load_many,
    load_part,
    put,
    spread_many,
    store,
    store_many,
    store_part,
    stream,
    transpose,
)
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

SIXTEEN = (0,) * LANES
"""A block's pixels, or as many channels."""


class Picture(NamedTuple):
    """A map as a flat array."""

    values: Any  # [H * W * D]
    width: int
    channels: int


class Trace(NamedTuple):
    """What the forward pass leaves for the backward pass."""

    finals: Any  # [H * W] transmittance of each pixel; 1 - alpha would keep few digits of it
    seen: Any  # int32, for each square how many Gaussians of its list were looked at
    drawn: Any  # int32, for each square and Gaussian of its list the blocks in which it was drawn, as bits


@inner_njit(forceinline=True)
def read_block(picture: Picture, box: Any, block: int, channel: int, into: Any, place: int, stride: int) -> None:
    """Copy LANES channels of a block's pixel p to into[place + p * stride:]; 0 beyond the box and the last channel."""
    values, width, channels = picture
    lanes = lanes_below(values, channels - channel)
    left, top = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    columns, rows = min(box[2] - left, BLOCK_SIDE), min(box[3] - top, BLOCK_SIDE)
    nothing = lanes_below(values, 0)
    for y in range(BLOCK_SIDE):
        at = ((top + y) * width + left) * channels + channel
        for x in range(BLOCK_SIDE):
            wanted = lanes if x < columns and y < rows else nothing
            store(into, place + (y * BLOCK_SIDE + x) * stride, load_part(values, at + x * channels, wanted))


@inner_njit(forceinline=True)
def write_block(picture: Picture, box: Any, block: int, channel: int, source: Any, place: int, stride: int) -> None:
    """The inverse of `read_block`: writes nothing outside of the box or beyond the last channel."""
    values, width, channels = picture
    lanes = lanes_below(values, channels - channel)
    left, top = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    for y in range(min(box[3] - top, BLOCK_SIDE)):
        at = ((top + y) * width + left) * channels + channel
        for x in range(min(box[2] - left, BLOCK_SIDE)):
            vector = load(source, place + (y * BLOCK_SIDE + x) * stride)
            store_part(values, at + x * channels, lanes, vector)


@cached_njit()
def composite_band(
    band: int,
    view: View,
    rows: Rows,
    passes: Any,  # narrow.Passes; None with many channels
    source: Any,  # wide.Source; None with few channels, which are packed
    background: Any,  # D numbers, and zeros up to a whole vector
    maps: Any,  # [H * W * D], written
    alphas: Any,  # [H * W], written
    trace: Trace,  # written
) -> None:
    """Composite the tiles of one band."""
    channels = len(maps) // len(alphas)
    picture, stride = Picture(maps, view.width, channels), wide.padded_length(channels)
    square = make_square(rows.values)
    if passes is not None:  # numba leaves out a branch only where its argument is None
        sums, weights = aligned(max(passes.channels, stride) * PIXELS, rows.values), aligned(CHUNK * LANES, rows.values)
        sums[:] = 0
        pixels = aligned(LANES * LANES, rows.values)
    if source is not None:
        sums, kept = aligned(PIXELS * stride, rows.values), wide.make_kept(rows.values)
        streams = channels == stride and maps.ctypes.data % 64 == 0  # a pixel's row is whole cache lines
    for number in squares_of(view, band):
        place = find_place(view, number)
        dark = start_square(square, place.box)
        span = place.start, place.end, place.trace
        if passes is not None:
            sums[: passes.channels * PIXELS] = 0
            done = narrow.composite_square(rows, span, square, dark, passes, sums, weights, trace.drawn, None, None)
            for block in range(BLOCKS):
                p = block * LANES
                final = load(square.state, FINAL + p)
                for channel in range(0, channels, LANES):
                    total = load_many(SIXTEEN, sums, channel * PIXELS + p, PIXELS)
                    total = add_outer(total, (final,), spread_many(SIXTEEN, background, channel, 1))
                    store_many(pixels, 0, LANES, transpose(total))
                    write_block(picture, place.box, block, channel, pixels, 0, LANES)
        if source is not None:
            done, filled = wide.composite_square(rows, span, square, dark, source, sums, kept, trace.drawn)
        trace.seen[number] = done - place.start
        left, top, right, bottom = place.box
        for y in range(bottom - top):
            for x in range(right - left):
                block = y // BLOCK_SIDE * BLOCK_SIDE + x // BLOCK_SIDE
                p = block * LANES + y % BLOCK_SIDE * BLOCK_SIDE + x % BLOCK_SIDE
                pixel, final = (top + y) * view.width + left + x, square.state[FINAL + p]
                put(trace.finals, pixel, final)
                put(alphas, pixel, 1 - final)
                if source is not None:
                    summed = (filled >> np.uint32(block)) & 1
                    for channel in range(0, channels, LANES):
                        value = load(background, channel) * final
                        if summed:
                            value = value + load(sums, p * stride + channel)
                        if streams:
                            stream(maps, pixel * channels + channel, value)
                        else:
                            lanes = lanes_below(maps, channels - channel)
                            store_part(maps, pixel * channels + channel, lanes, value)


@cached_njit()
def accumulate_band(
    band: int,
    view: View,
    rows: Rows,  # without features
    pixels: Any,  # [H * W * D]
    channels: int,  # D
    slots: Any,  # [P] from `number_slots`
    firsts: Any,  # [B + 1], where the bands' rows begin
    out: Any,  # [R * padded_length(D + 1)], written
) -> None:
    """Sum one band's pixels into its own rows of `out`, weighted: the weights' sum follows the channels."""
    width = wide.padded_length(channels + 1)
    picture, square = Picture(pixels, view.width, channels), make_square(rows.values)
    values, kept = aligned(PIXELS * width, rows.values), wide.make_kept(rows.values)
    values[:] = 0
    own = out[firsts[band] * width : firsts[band + 1] * width]
    own[:] = 0
    for number in squares_of(view, band):
        place = find_place(view, number)
        if place.start == place.end:
            continue
        dark = start_square(square, place.box)
        for block in range(BLOCKS):
            for channel in range(0, channels, LANES):
                read_block(picture, place.box, block, channel, values, block * LANES * width + channel, width)
        values[channels::width] = 1
        wide.accumulate_square(rows, (place.start, place.end), square, dark, values, kept, slots, width, own)
