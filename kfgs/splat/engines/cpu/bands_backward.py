"""The compiled kernels over a band of tiles, backward."""

from __future__ import annotations

from typing import Any

from . import narrow, wide
from .bands import SIXTEEN, Picture, Trace, read_block
from .cache import cached_njit, inner_njit
from .simd import LANES, add_dot, load, load_many, spread, spread_many, store, store_many, transpose
from .square import (
    BLOCK_SIDE,
    BLOCKS,
    CHUNK,
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
def _read_pixels(values: Any, width: int, box: Any, block: int, scratch: Any) -> Any:
    """A block's pixels of an image of one channel; 0 outside of the box."""
    left, top = box[0] + block % BLOCK_SIDE * BLOCK_SIDE, box[1] + block // BLOCK_SIDE * BLOCK_SIDE
    store(scratch, 0, 0)
    for y in range(min(box[3] - top, BLOCK_SIDE)):
        for x in range(min(box[2] - left, BLOCK_SIDE)):
            scratch[y * BLOCK_SIDE + x] = values[(top + y) * width + left + x]
    return load(scratch, 0)


@inner_njit(forceinline=True)
def _start_backward(
    planes: Any,
    box: Any,
    block: int,
    images: Any,  # maps and the loss's gradient in them, as pictures; transmittances; the loss's gradient in the alphas
    background: Any,
    scratch: Any,
    keep: bool,
) -> None:
    """Fill the planes BEHIND and SHARE of one block, and GRADS if they are to be kept; 0 outside of the box.

    maps = sum w f + T background and alphas = sum w = 1 - T, so a weight's slope is f . grad + SHARE with
    SHARE = grad_alpha - background . grad, and all weights times their slopes are
    maps . grad - T background . grad + alphas SHARE.
    """
    maps, grad_maps, finals, grad_alphas = images
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


@cached_njit()
def differentiate_band(
    band: int,
    view: View,
    rows: Rows,
    passes: Any,  # narrow.Passes; None with many channels
    source: Any,  # wide.Source; None with few channels, which are packed
    background: Any,  # D numbers, and zeros up to a whole vector
    images: tuple[Any, Any, Any],  # maps, the loss's gradient in them, and that in the alphas, all flat
    trace: Trace,
    slots: Any,  # [P] from `number_slots`
    firsts: Any,  # [B + 1], where the bands' rows begin
    out: Any,  # written: rows of as many numbers as packed ones; with many channels of LANES numbers and padded D
    geometry: bool,  # whether the moments are wanted; with few channels they come anyway
) -> None:
    """Sum the gradients of one band's tiles into its own rows of `out`."""
    maps, grad_maps, grad_alphas = images
    channels = len(maps) // len(trace.finals)
    stride, square = wide.padded_length(channels), make_square(rows.values)
    grads = Picture(grad_maps, view.width, channels)
    pictures = Picture(maps, view.width, channels), grads, trace.finals, grad_alphas
    scratch = aligned(LANES * LANES, rows.values)
    if passes is not None:
        row = rows.length
        planes, weights = (
            aligned((2 + max(passes.channels, stride)) * PIXELS, rows.values),
            aligned(PIXELS, rows.values),
        )
        planes[:] = 0
    if source is not None:
        row = LANES + stride
        planes, square_grads = aligned(2 * PIXELS, rows.values), aligned(PIXELS * stride, rows.values)
        slopes, kept = aligned((CHUNK + 3) * LANES, rows.values), wide.make_kept(rows.values)
    own = out[firsts[band] * row : firsts[band + 1] * row]
    own[:] = 0
    for number in squares_of(view, band):
        place = find_place(view, number)
        seen = trace.seen[number]
        if seen == 0:
            continue
        start_square(square, place.box)
        span = place.start, place.start + seen, place.trace
        if passes is not None:
            for block in range(BLOCKS):
                _start_backward(planes, place.box, block, pictures, background, scratch, True)
            narrow.differentiate_square(rows, span, square, passes, planes, weights, trace.drawn, slots, own)
        if source is not None:
            for block in range(BLOCKS):
                if geometry:
                    _start_backward(planes, place.box, block, pictures, background, scratch, False)
                for channel in range(0, channels, LANES):
                    at = block * LANES * stride + channel
                    read_block(grads, place.box, block, channel, square_grads, at, stride)
            wide.differentiate_square(
                rows, span, square, source, square_grads, planes, kept, slopes, trace.drawn, slots, own, geometry
            )
