"""What the compiled kernels share: packed Gaussians, and squares of pixels cut into blocks of one vector each.

Block b of a square is in row b // 4 and column b % 4; pixel p of a square is lane p % 16 of block p // 16. README.md
explains square, block, plane and packed row.

A Gaussian is packed into one row, so that it arrives in one cache line: its mean, the three numbers of its quadratic
form, the logarithm of its opacity, then its features. The form a dx^2 + 2 b dx dy + c dy^2 is kept as
a (dx + (b / a) dy)^2 + (c - b^2 / a) dy^2: both terms are positive, so that needles do not cancel in float32.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ..contract import ALPHA_MAX, ALPHA_MIN
from .bits import WORDS, transpose_bits
from .cache import cached_njit
from .simd import (
    LANES,
    bits,
    exp2,
    fetch,
    fma,
    lanes_below,
    load,
    load_part,
    maximum,
    minimum,
    prefetch,
    put,
    select,
    store,
    store_part,
    trailing_zeros,
)

SQUARE_SIDE = 16
"""Pixels along a square's side."""

PIXELS = SQUARE_SIDE * SQUARE_SIDE
BLOCK_SIDE = 4
"""Pixels along a block's side."""

BLOCKS = PIXELS // LANES
ALL_BLOCKS = np.uint32((1 << BLOCKS) - 1)

CHUNK = 64
"""Gaussians that a square lists at once."""

PREFETCH_AHEAD = 8
"""How many Gaussians ahead memory is prefetched."""

MEAN_X, MEAN_Y, SQUARE, LEAN, REST, LOG_OPACITY, FEATURES = range(7)
"""Columns of a packed row: with u = dx + LEAN dy, log2(opacity density) = LOG_OPACITY - SQUARE u^2 - REST dy^2."""

X, Y, LIGHT, FINAL = 0, PIXELS, 2 * PIXELS, 3 * PIXELS
"""Planes of a square's state: pixel centres; the transmittance, which goes on falling after a pixel has stopped; and the
transmittance with which the pixel stopped."""
STATE = 4 * PIXELS

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
INLINE: dict[str, Any] = OPTIONS | {"forceinline": True}

_LISTED = 32
"""Gaussians whose bits are listed together."""
_SIXTEEN_BITS = np.uint64(0xFFFF)

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
_LOG2_E = math.log2(math.e)


@njit(**INLINE)
def aligned(count: int, like: Any) -> Any:
    """Memory for `count` numbers of the array's type that begins on a cache line; a vector in two cache lines costs double."""
    size = like.itemsize
    room = np.empty(count + 64 // size, like.dtype)
    skip = -(room.ctypes.data // size) % (64 // size)
    return room[skip : skip + count]


@njit(**INLINE)
def row_length(channels: int) -> int:
    """Numbers in a packed row: whole vectors, so that rows stay aligned."""
    return (FEATURES + channels + LANES - 1) // LANES * LANES


@cached_njit(**OPTIONS)
def pack_rows(band: int, bands: int, splats: Any, features: Any, channels: int, index: Any, rows: Any) -> None:
    """Pack one share of the Gaussians.

    Args:
        band: which share.
        bands: how many shares.
        splats: means2d [M * 2], conics [M * 3] and opacities [M].
        features: [N * D].
        channels: D; 0 if the features stay where they are.
        index: [M], the features' row of each Gaussian; empty if row m belongs to Gaussian m.
        rows: [M * row_length(D)], written; 0 beyond the features.
    """
    means2d, conics, opacities = splats
    count, length = len(opacities), row_length(channels)
    lanes = lanes_below(rows, channels % LANES)
    whole = channels // LANES * LANES
    for m in range(count * band // bands, count * (band + 1) // bands):
        at = m * length
        for d in range(0, length, LANES):
            store(rows, at + d, 0)
        a, b, c = float(fetch(conics, 3 * m)), float(fetch(conics, 3 * m + 1)), float(fetch(conics, 3 * m + 2))
        rest = c - b * b / a  # in float64: b^2 / a cancels c
        opacity = fetch(opacities, m)
        put(rows, at + MEAN_X, fetch(means2d, 2 * m))
        put(rows, at + MEAN_Y, fetch(means2d, 2 * m + 1))
        put(rows, at + SQUARE, 0.5 * _LOG2_E * a)
        put(rows, at + LEAN, b / a)
        put(rows, at + REST, 0.5 * _LOG2_E * rest)
        put(rows, at + LOG_OPACITY, math.log2(opacity) if opacity > 0 and a > 0 and rest > 0 else -np.inf)
        source = (fetch(index, m) if len(index) else m) * channels
        for d in range(0, whole, LANES):
            store(rows, at + FEATURES + d, load(features, source + d))
        if whole < channels:
            store_part(rows, at + FEATURES + whole, lanes, load_part(features, source + whole, lanes))


class View(NamedTuple):
    """`Tiles` as arrays, and the bands of work: band b owns tiles bounds[b] to bounds[b + 1]."""

    order: Any  # [P] the Gaussians' numbers, tile by tile, front to back
    offsets: Any  # [T + 1] int64
    bounds: Any  # [B + 1] int64
    width: int
    height: int
    tile_size: int
    across: int  # squares along a tile's side, as far as the image reaches


@njit(**INLINE)
def square_box(view: View, tile: int, square: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom pixel of a square of a tile, cut off at the tile's and the image's border."""
    columns = (view.width + view.tile_size - 1) // view.tile_size
    tile_x, tile_y = tile % columns * view.tile_size, tile // columns * view.tile_size
    left, top = tile_x + square % view.across * SQUARE_SIDE, tile_y + square // view.across * SQUARE_SIDE
    right = min(left + SQUARE_SIDE, tile_x + view.tile_size, view.width)
    bottom = min(top + SQUARE_SIDE, tile_y + view.tile_size, view.height)
    return left, top, right, bottom


@njit(**INLINE)
def start_square(state: Any, corners: Any, box: tuple[int, int, int, int]) -> Any:
    """Place the pixel centres, with no light outside of the box; returns the bits of the blocks without any pixel."""
    left, top, right, bottom = box
    dark = np.uint32(0)
    for block in range(BLOCKS):
        x0, y0 = left + block % BLOCK_SIDE * BLOCK_SIDE, top + block // BLOCK_SIDE * BLOCK_SIDE
        corners[block], corners[BLOCKS + block] = x0 + 0.5, y0 + 0.5
        if x0 >= right or y0 >= bottom:
            dark |= np.uint32(1) << np.uint32(block)
        for lane in range(LANES):
            p = block * LANES + lane
            x, y = x0 + lane % BLOCK_SIDE, y0 + lane // BLOCK_SIDE
            state[X + p], state[Y + p] = x + 0.5, y + 0.5
            state[LIGHT + p] = state[FINAL + p] = 1 if x < right and y < bottom else 0
    return dark


@njit(**INLINE)
def touched_blocks(rows: Any, at: int, corners: Any, epsilon: Any) -> Any:
    """Bits of the blocks where alpha may reach ALPHA_MIN, of one packed Gaussian.

    The smallest value of the form over the rectangle of a block's pixel centres is compared with that of ALPHA_MIN, all
    blocks at once. The form is convex and 0 at the mean. If the mean lies outside, the minimum is on one of the (at most
    two) sides that face it: on each, the minimum of a parabola, clamped to the side.

    Args:
        rows: packed Gaussians.
        at: where the Gaussian begins.
        corners: [2 * BLOCKS], x of each block's first pixel centre, then y.
        epsilon: the rounding unit of the rows' type.
    """
    square, lean, rest = fetch(rows, at + SQUARE), fetch(rows, at + LEAN), fetch(rows, at + REST)
    left = load(corners, 0) - fetch(rows, at + MEAN_X)
    top = load(corners, BLOCKS) - fetch(rows, at + MEAN_Y)
    right, bottom = left + (BLOCK_SIDE - 1), top + (BLOCK_SIDE - 1)
    near_x = maximum(left, minimum(right, 0))
    near_y = maximum(top, minimum(bottom, 0))
    tilt = -(square * lean) / (square * lean * lean + rest)  # -b / c
    along_y = maximum(top, minimum(bottom, near_x * tilt))  # on the side x = near_x
    along_x = maximum(left, minimum(right, near_y * -lean))  # on the side y = near_y
    u, v = fma(along_y, lean, near_x), fma(near_y, lean, along_x)
    on_x = fma(u * square, u, along_y * along_y * rest)
    on_y = fma(v * square, v, near_y * near_y * rest)
    # Here and at the pixels, u is off by eps times the larger of its two parts, which may cancel, and the form follows.
    far = epsilon * fma(maximum(top * -1, bottom), abs(lean), maximum(left * -1, right))
    slack = far * fma(far, 8 * square, 10 * (1 + square)) + 64 * epsilon
    limit = fetch(rows, at + LOG_OPACITY) - LOG2_ALPHA_MIN
    return bits(minimum(on_x, on_y) <= slack + limit)


@njit(**INLINE)
def weigh_pixels(rows: Any, at: int, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Offsets from the mean, opacity * density, and alpha (0 where skipped) of one Gaussian at a block's pixels."""
    dx, dy = x - fetch(rows, at + MEAN_X), y - fetch(rows, at + MEAN_Y)
    u = fma(dy, fetch(rows, at + LEAN), dx)
    power = fma(u * u, -fetch(rows, at + SQUARE), fma(dy * dy, -fetch(rows, at + REST), fetch(rows, at + LOG_OPACITY)))
    full = exp2(power)
    return dx, dy, full, select(power >= LOG2_ALPHA_MIN, minimum(full, ALPHA_MAX), 0)


@njit(**INLINE)
def list_bits(touched: Any, j: int, hits: Any, counts: Any) -> None:
    """Append place j to the lists of the blocks whose bits are set."""
    while touched:
        block = trailing_zeros(touched)
        touched &= touched - np.uint32(1)
        number = fetch(counts, block)
        put(hits, block * CHUNK + number, j)
        put(counts, block, number + 1)


@njit(**INLINE)
def list_hits(
    rows: Any,
    length: int,
    order: Any,
    span: tuple[int, int, int],
    dark: Any,
    corners: Any,
    hits: Any,
    counts: Any,
    trace: Any,
) -> None:
    """List, for each block that has light, which Gaussians touch it.

    Args:
        rows: packed Gaussians.
        length: of a packed row.
        order: the Gaussians' numbers.
        span: which places in `order` (first, one past the last), and where the square's trace begins.
        dark: bits of blocks to leave out.
        corners: see `touched_blocks`.
        hits: [BLOCKS * CHUNK] int32, written: places in `order`.
        counts: [BLOCKS], written.
        trace: written: the touched blocks' bits of each Gaussian; None: there is no backward pass.
    """
    first, stop, into = span
    epsilon = rows.dtype.type(np.finfo(rows.dtype).eps)
    counts[:] = 0
    words = np.zeros(WORDS, np.uint64)
    for begin in range(first, stop, _LISTED):
        words[:] = 0
        for j in range(begin, min(begin + _LISTED, stop)):
            prefetch(rows, np.int64(fetch(order, min(j + PREFETCH_AHEAD, stop - 1))) * length)
            touched = touched_blocks(rows, np.int64(fetch(order, j)) * length, corners, epsilon) & ~dark
            if trace is not None:
                put(trace, into + j - first, touched)
            k = j - begin
            put(words, k // 4, fetch(words, k // 4) | (np.uint64(touched) << np.uint64(k % 4 * BLOCKS)))
        transpose_bits(words)
        for block in range(BLOCKS):
            shift = np.uint64(block % 4 * BLOCKS)
            low = (fetch(words, block // 4) >> shift) & _SIXTEEN_BITS
            high = (fetch(words, 4 + block // 4) >> shift) & _SIXTEEN_BITS
            touching, number = np.uint32(low | (high << np.uint64(16))), fetch(counts, block)
            while touching:
                put(hits, block * CHUNK + number, begin + trailing_zeros(touching))
                touching &= touching - np.uint32(1)
                number += 1
            put(counts, block, number)


class Picture(NamedTuple):
    """A map as a flat array."""

    values: Any  # [H * W * D]
    width: int
    channels: int


@njit(**INLINE)
def read_block(picture: Picture, box: Any, block: int, channel: int, into: Any, place: int, stride: int) -> None:
    """Copy LANES channels of a block's pixels; 0 outside of the box and beyond the last channel.

    Args:
        picture: the map.
        box: left, top, right and bottom of the square.
        block: which of its blocks.
        channel: the first channel.
        into: written: pixel p goes to into[place + p * stride:].
        place: see `into`.
        stride: see `into`.
    """
    values, width, channels = picture
    lanes = lanes_below(values, channels - channel)
    left, top = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    columns, rows = min(box[2] - left, BLOCK_SIDE), min(box[3] - top, BLOCK_SIDE)
    if columns == BLOCK_SIDE and rows == BLOCK_SIDE:
        for y in range(BLOCK_SIDE):
            at = ((top + y) * width + left) * channels + channel
            for x in range(BLOCK_SIDE):
                store(into, place + (y * BLOCK_SIDE + x) * stride, load_part(values, at + x * channels, lanes))
        return
    for y in range(BLOCK_SIDE):
        for x in range(BLOCK_SIDE):
            if x < columns and y < rows:
                at = ((top + y) * width + left + x) * channels + channel
                store(into, place + (y * BLOCK_SIDE + x) * stride, load_part(values, at, lanes))
            else:
                store(into, place + (y * BLOCK_SIDE + x) * stride, 0)


@njit(**INLINE)
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
