"""The compiled kernels over a band of tiles, backward."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from . import narrow as narrow
from . import wide as wide
from .bands import whole_planes
from .cache import cached_njit
from .simd import LANES, add_dot, load, load_many, spread, spread_many, store, store_many, transpose
from .square import (
    BLOCK_SIDE,
    BLOCKS,
    CHUNK,
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
)

SIXTEEN = (0,) * LANES
"""A block's pixels, or as many channels."""


@njit(**INLINE)
def _read_pixels(values: Any, width: int, box: Any, block: int, scratch: Any) -> Any:
    """A block's pixels of an image of one channel; 0 outside of the box."""
    left, top = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    store(scratch, 0, 0)
    for y in range(min(box[3] - top, BLOCK_SIDE)):
        for x in range(min(box[2] - left, BLOCK_SIDE)):
            scratch[y * BLOCK_SIDE + x] = values[(top + y) * width + left + x]
    return load(scratch, 0)


@njit(**INLINE)
def _start_backward(
    planes: Any, box: Any, block: int, pictures: Any, background: Any, scratch: Any, keep: bool
) -> None:
    """Fill the planes BEHIND and SHARE of one block, and GRADS if they are to be kept; 0 outside of the box.

    maps = sum w f + T background and alphas = sum w = 1 - T, so a weight's slope is f . grad + SHARE with
    SHARE = grad_alpha - background . grad, and all weights times their slopes are
    maps . grad - T background . grad + alphas SHARE.
    """
    maps, grad_maps, finals, grad_alphas = pictures
    p = block * LANES
    total, through = spread(planes, 0), spread(planes, 0)
    for channel in range(0, maps.channels, LANES):
        read_block(grad_maps, box, block, channel, scratch, 0, LANES)
        grads = transpose(load_many(SIXTEEN, scratch, 0, LANES))
        read_block(maps, box, block, channel, scratch, 0, LANES)
        total = add_dot(total, grads, transpose(load_many(SIXTEEN, scratch, 0, LANES)))
        through = add_dot(through, grads, spread_many(SIXTEEN, background, channel, 1))
        if keep:
            store_many(planes, narrow.GRADS + channel * PIXELS + p, PIXELS, grads)
    final = _read_pixels(finals, maps.width, box, block, scratch)
    share = _read_pixels(grad_alphas, maps.width, box, block, scratch) - through
    store(planes, narrow.SHARE + p, share)
    store(planes, narrow.BEHIND + p, total - final * through + (1 - final) * share)


@cached_njit(**OPTIONS)
def differentiate_narrow(
    band: int,
    view: View,
    rows: Any,
    length: int,
    passes: Any,
    background: Any,
    images: Any,
    trace: Any,
    slots: Any,
    firsts: Any,
    out: Any,
) -> None:
    """Sum the gradients of one band's tiles into its own rows of `out`, with few channels.

    Args:
        band: which.
        view: the tiles.
        rows: packed Gaussians with their features.
        length: of a packed row, and of a gradient row.
        passes: from `plan_passes`.
        background: D numbers, and zeros up to a whole vector.
        images: maps, the loss's gradient in them, transmittances, the loss's gradient in the alphas, all flat.
        trace: of the forward pass.
        slots: [P] from `number_slots`.
        firsts: [B + 1], where the bands' rows begin.
        out: [R * length], written.
    """
    maps, grad_maps, finals, grad_alphas = images
    channels, width = len(maps) // len(finals), view.width
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, finals, grad_alphas
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes = aligned((2 + whole_planes(passes, channels)) * PIXELS, rows)
    planes[:] = 0
    weights, scratch = aligned(PIXELS, rows), aligned(LANES * LANES, rows)
    squares = view.across**2
    drawn = trace[squares * (len(view.offsets) - 1) :]
    own = out[firsts[band] * length : firsts[band + 1] * length]
    own[:] = 0
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(squares):
            looked_at = trace[tile * squares + square]
            box = square_box(view, tile, square)
            if looked_at == 0 or box[0] >= box[2] or box[1] >= box[3]:
                continue
            start_square(state, corners, box)
            for block in range(BLOCKS):
                _start_backward(planes, box, block, pictures, background, scratch, True)
            span = start, start + looked_at, start * squares + square * (end - start)
            packed = rows, length, view.order
            narrow.differentiate_square(packed, span, state, passes, planes, weights, drawn, slots, own)


@cached_njit(**OPTIONS)
def differentiate_wide(
    band: int,
    view: View,
    rows: Any,
    length: int,
    source: Any,
    background: Any,
    images: Any,
    trace: Any,
    slots: Any,
    firsts: Any,
    out: Any,
    geometry: bool,
) -> None:
    """As `differentiate_narrow`, with many channels: the Gaussians are packed without features.

    `source` is the features (flat), where each Gaussian's row begins, and D. Rows of `out` have LANES + padded D numbers,
    of which the first are the moments, if `geometry` asks for them.
    """
    maps, grad_maps, finals, grad_alphas = images
    channels, width = source[2], view.width
    stride = wide.padded_length(channels)
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, finals, grad_alphas
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes, square_grads = aligned(2 * PIXELS, rows), aligned(PIXELS * stride, rows)
    scratch, slopes = aligned(LANES * LANES, rows), aligned((CHUNK + 3) * LANES, rows)
    kept = wide.make_kept(rows)
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    squares = view.across**2
    drawn = trace[squares * (len(view.offsets) - 1) :]
    own = out[firsts[band] * (LANES + stride) : firsts[band + 1] * (LANES + stride)]
    own[:] = 0
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(squares):
            looked_at = trace[tile * squares + square]
            box = square_box(view, tile, square)
            if looked_at == 0 or box[0] >= box[2] or box[1] >= box[3]:
                continue
            start_square(state, corners, box)
            for block in range(BLOCKS):
                if geometry:
                    _start_backward(planes, box, block, pictures, background, scratch, False)
                for channel in range(0, channels, LANES):
                    read_block(grads, box, block, channel, square_grads, block * LANES * stride + channel, stride)
            span = start, start + looked_at, start * squares + square * (end - start)
            packed, room = (rows, length, view.order), (kept, slopes, hits, counts)
            wide.differentiate_square(
                packed, span, state, source, square_grads, planes, room, drawn, slots, own, geometry
            )
