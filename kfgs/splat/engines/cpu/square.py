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

from ..contract import ALPHA_MAX, ALPHA_MIN
from .cache import cached_njit, inner_njit
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
"""Planes of a square's state: pixel centres; the transmittance, which falls also after a pixel has stopped; and the
transmittance with which the pixel stopped."""
STATE = 4 * PIXELS

_LISTED, _WORDS = 32, 8
"""Gaussians whose bits are listed together, and the 64-bit words that hold these."""
_SIXTEEN_BITS = np.uint64(0xFFFF)
_1, _2, _4, _8, _16, _32 = (np.uint64(1 << k) for k in range(6))
_BITS, _PAIRS = np.uint64(0x0000555500005555), np.uint64(0x0000000033333333)
_NIBBLES, _BYTES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x00FF00FF00FF00FF)

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
_LOG2_E = math.log2(math.e)


@inner_njit(forceinline=True)
def aligned(count: int, like: Any) -> Any:
    """Memory for `count` numbers of the array's type that begins on a cache line; a vector in two cache lines costs double."""
    size = like.itemsize
    room = np.empty(count + 64 // size, like.dtype)
    skip = -(room.ctypes.data // size) % (64 // size)
    return room[skip : skip + count]


@inner_njit(forceinline=True)
def row_length(channels: int) -> int:
    """Numbers in a packed row: whole vectors, so that rows stay aligned."""
    return (FEATURES + channels + LANES - 1) // LANES * LANES


@cached_njit()
def pack_rows(
    band: int,
    bands: int,
    splats: Any,  # means2d [M * 2], conics [M * 3] and opacities [M]
    features: Any,  # [N * D]
    channels: int,  # D; 0 if the features stay where they are
    index: Any,  # [M] the features' row of each Gaussian; empty if row m belongs to Gaussian m
    rows: Any,  # [M * row_length(D)], written; 0 beyond the features
) -> None:
    """Pack one of `bands` equal shares of the Gaussians."""
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


class Rows(NamedTuple):
    """The packed Gaussians, and the tiles' lists of them."""

    values: Any  # [M * length]
    length: int  # of a row
    order: Any  # [P] the Gaussians' numbers, tile by tile, front to back


class Square(NamedTuple):
    """The working memory for one square; see `start_square` and `list_hits`."""

    state: Any  # [STATE]
    corners: Any  # [2 * BLOCKS] x of each block's first pixel centre, then y
    hits: Any  # [BLOCKS * CHUNK] int32, the places in the list that touch each block
    counts: Any  # [BLOCKS] int32, how many


class Place(NamedTuple):
    """Where a square lies in the image and in the lists."""

    box: tuple[int, int, int, int]  # left, top, right and bottom pixel, cut off at the tile's and the image's border
    start: int  # its Gaussians are order[start:end]
    end: int
    trace: int  # where its part of the trace begins


@inner_njit()
def squares_of(view: View, band: int) -> Any:
    """The numbers of the squares of a band's tiles, front to back. Not a generator: numba frees nothing that one is given."""
    return range(view.bounds[band] * view.across**2, view.bounds[band + 1] * view.across**2)


@inner_njit()
def find_place(view: View, number: int) -> Place:
    """Where a square lies; beyond a border it has neither pixels nor Gaussians."""
    tile, square = number // view.across**2, number % view.across**2
    columns = (view.width + view.tile_size - 1) // view.tile_size
    start, end = view.offsets[tile], view.offsets[tile + 1]
    tile_x, tile_y = tile % columns * view.tile_size, tile // columns * view.tile_size
    left, top = tile_x + square % view.across * SQUARE_SIDE, tile_y + square // view.across * SQUARE_SIDE
    right = min(left + SQUARE_SIDE, tile_x + view.tile_size, view.width)
    bottom = min(top + SQUARE_SIDE, tile_y + view.tile_size, view.height)
    trace = start * view.across**2 + square * (end - start)
    return Place((left, top, right, bottom), start, end if left < right and top < bottom else start, trace)


@inner_njit(forceinline=True)
def make_square(like: Any) -> Square:
    """Memory for squares of the array's type."""
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    return Square(aligned(STATE, like), aligned(2 * BLOCKS, like), hits, counts)


@inner_njit(forceinline=True)
def start_square(square: Square, box: tuple[int, int, int, int]) -> Any:
    """Place the pixel centres, with no light outside of the box; returns the bits of the blocks without any pixel."""
    state, corners = square.state, square.corners
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


@inner_njit(forceinline=True)
def touched_blocks(rows: Any, at: int, corners: Any, epsilon: Any) -> Any:
    """Bits of the blocks where alpha may reach ALPHA_MIN, of the packed Gaussian at rows[at:].

    The smallest value of the form over the rectangle of a block's pixel centres is compared with that of ALPHA_MIN, all
    blocks at once. The form is convex and 0 at the mean. If the mean lies outside, the minimum is on one of the (at most
    two) sides that face it: on each, the minimum of a parabola, clamped to the side. `epsilon` is the type's rounding unit.
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


@inner_njit(forceinline=True)
def weigh_pixels(rows: Any, at: int, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
    """Offsets from the mean, opacity * density, and alpha (0 where skipped) of one Gaussian at a block's pixels."""
    dx, dy = x - fetch(rows, at + MEAN_X), y - fetch(rows, at + MEAN_Y)
    u = fma(dy, fetch(rows, at + LEAN), dx)
    power = fma(u * u, -fetch(rows, at + SQUARE), fma(dy * dy, -fetch(rows, at + REST), fetch(rows, at + LOG_OPACITY)))
    full = exp2(power)
    return dx, dy, full, select(power >= LOG2_ALPHA_MIN, minimum(full, ALPHA_MAX), 0)


@inner_njit(forceinline=True)
def list_hits(rows: Rows, span: tuple[int, int], dark: Any, square: Square, trace: Any, into: int) -> None:
    """List, for each block of a square, the places in span that touch it, without the blocks whose bits are in `dark`.

    The touched blocks' bits of each Gaussian are kept in trace[into:]; None: there is no backward pass.
    """
    values, length, order = rows
    first, stop = span
    epsilon = values.dtype.type(np.finfo(values.dtype).eps)
    hits, counts = square.hits, square.counts
    counts[:] = 0
    words = np.empty(_WORDS, np.uint64)
    for begin in range(first, stop, _LISTED):
        words[:] = 0
        for j in range(begin, min(begin + _LISTED, stop)):
            prefetch(values, np.int64(fetch(order, min(j + PREFETCH_AHEAD, stop - 1))) * length)
            touched = touched_blocks(values, np.int64(fetch(order, j)) * length, square.corners, epsilon) & ~dark
            if trace is not None:
                put(trace, into + j - first, touched)
            k = j - begin
            put(words, k // 4, fetch(words, k // 4) | (np.uint64(touched) << np.uint64(k % 4 * BLOCKS)))
        _transpose_bits(words)
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


@inner_njit(forceinline=True)
def _transpose_bits(words: Any) -> None:
    """Turn the blocks of each of 16 Gaussians into the Gaussians of each of 16 blocks: first for 16 of them, then for 16 more.

    Four words hold a square matrix of 16 x 16 bits, row by row, four rows in each. Its off-diagonal quarters change places,
    then those of each quarter, and so on.
    """
    for half in range(0, _WORDS, 4):
        a, b, c, d = words[half], words[half + 1], words[half + 2], words[half + 3]
        t, u = ((a >> _8) ^ c) & _BYTES, ((b >> _8) ^ d) & _BYTES
        a, b, c, d = a ^ (t << _8), b ^ (u << _8), c ^ t, d ^ u
        t, u = ((a >> _4) ^ b) & _NIBBLES, ((c >> _4) ^ d) & _NIBBLES
        a, b, c, d = a ^ (t << _4), b ^ t, c ^ (u << _4), d ^ u
        words[half], words[half + 1] = _transpose_word(a), _transpose_word(b)
        words[half + 2], words[half + 3] = _transpose_word(c), _transpose_word(d)


@inner_njit(forceinline=True)
def _transpose_word(word: Any) -> Any:
    """The last two steps, within four rows."""
    t = ((word >> _2) ^ (word >> _32)) & _PAIRS
    word = word ^ (t << _2) ^ (t << _32)
    t = ((word >> _1) ^ (word >> _16)) & _BITS
    return word ^ (t << _1) ^ (t << _16)
