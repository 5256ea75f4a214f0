"""The compiled kernels over a band of tiles: forward, backward, accumulation, and the sum of what the bands found."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from . import numba_narrow as narrow
from . import numba_wide as wide
from .numba_cache import compiled
from .numba_simd import (
    LANES,
    add_dot,
    add_scaled,
    fetch,
    lanes_below,
    load,
    load_many,
    load_part,
    put,
    spread,
    spread_many,
    store,
    store_many,
    store_part,
    transpose,
)
from .numba_square import (
    BLOCK,
    BLOCKS,
    CHUNK,
    INLINE,
    LEFT,
    OPTIONS,
    PIXELS,
    STATE,
    Picture,
    View,
    aligned,
    count_squares,
    read_block,
    square_box,
    start_square,
    write_block,
)

SIXTEEN = (0,) * LANES
"""A block's pixels, or as many channels."""


@njit(**INLINE)
def _whole_planes(passes: Any, channels: int) -> int:
    """Planes that hold the channels of all passes, and of whole vectors of channels."""
    return max(passes[2], wide.padded(channels))


@njit(**INLINE)
def _write_alphas(state: Any, box: tuple[int, int, int, int], alphas: Any, width: int) -> None:
    """1 - transmittance of a square's pixels."""
    left, top, right, bottom = box
    for y in range(bottom - top):
        for x in range(right - left):
            p = (y // BLOCK * BLOCK + x // BLOCK) * LANES + y % BLOCK * BLOCK + x % BLOCK
            alphas[(top + y) * width + left + x] = 1 - state[LEFT + p]


@compiled(**OPTIONS)
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
        background: as many numbers as the passes have channels.
        images: maps [H * W * D] and alphas [H * W], written.
        trace: written: per tile and square how many Gaussians were looked at, then the blocks that each was drawn in.
    """
    maps, alphas = images
    channels = len(maps) // len(alphas)
    picture, planes = Picture(maps, view.width, channels), _whole_planes(passes, channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    sums, weights = aligned(planes * PIXELS, rows), aligned(CHUNK * LANES, rows)
    sums[:] = 0
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    block_sums = aligned(LANES * LANES, rows)
    squares = count_squares(view)
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
            done = narrow.composite_square((rows, length, view.order), span, state, dark, passes, scratch, drawn)
            trace[tile * squares + square] = done - start
            _write_alphas(state, box, alphas, view.width)
            for block in range(BLOCKS):
                p = block * LANES
                left = load(state, LEFT + p)
                for channel in range(0, channels, LANES):
                    total = load_many(SIXTEEN, sums, channel * PIXELS + p, PIXELS)
                    total = add_scaled(total, left, spread_many(SIXTEEN, background, channel, 1))
                    store_many(block_sums, 0, LANES, transpose(total))
                    write_block(picture, box, block, channel, block_sums, 0, LANES)


@compiled(**OPTIONS)
def composite_wide(
    band: int, view: View, rows: Any, length: int, features: Any, begins: Any, background: Any, images: Any, trace: Any
) -> None:
    """Composite the tiles of one band, with many channels.

    Args:
        band: which.
        view: the tiles.
        rows: packed Gaussians without features.
        length: of a packed row.
        features: flat.
        begins: [M], where each Gaussian's row of features begins.
        background: D numbers and zeros up to a whole vector.
        images: maps [H * W * D] and alphas [H * W], written.
        trace: see `composite_narrow`.
    """
    maps, alphas = images
    channels = len(maps) // len(alphas)
    stride = wide.padded(channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    sums = aligned(PIXELS * stride, rows)
    kept = wide.make_kept(rows)
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    squares = count_squares(view)
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
            _write_alphas(state, box, alphas, view.width)
            for y in range(box[3] - box[1]):
                for x in range(box[2] - box[0]):
                    block = y // BLOCK * BLOCK + x // BLOCK
                    p = block * LANES + y % BLOCK * BLOCK + x % BLOCK
                    at = ((box[1] + y) * view.width + box[0] + x) * channels
                    _write_pixel(
                        maps,
                        at,
                        channels,
                        sums,
                        p * stride,
                        (filled >> np.uint32(block)) & 1,
                        background,
                        state[LEFT + p],
                    )


@njit(**INLINE)
def _write_pixel(
    maps: Any, at: int, channels: int, sums: Any, place: int, filled: int, background: Any, left: Any
) -> None:
    """A pixel's sums, if it has any, and what shows through."""
    whole = channels // LANES * LANES
    lanes = lanes_below(maps, channels - whole)
    for channel in range(0, whole, LANES):
        value = load(background, channel) * left
        if filled:
            value = value + load(sums, place + channel)
        store(maps, at + channel, value)
    if whole < channels:
        value = load(background, whole) * left
        if filled:
            value = value + load(sums, place + whole)
        store_part(maps, at + whole, lanes, value)


@compiled(**OPTIONS)
def number_slots(band: int, view: View, slots: Any, owners: Any, counts: Any, total: int) -> None:
    """Number the distinct Gaussians of one band, in order of appearance.

    Args:
        band: which.
        view: the tiles.
        slots: [P], written: the number of each pair's Gaussian.
        owners: [P], written from the band's first pair on: the Gaussian of each number.
        counts: [B], written: how many there are.
        total: M.
    """
    known = np.full(total, -1, np.int32)
    first, count = view.offsets[view.bounds[band]], 0
    for pair in range(first, view.offsets[view.bounds[band + 1]]):
        row = view.order[pair]
        if known[row] < 0:
            known[row] = count
            owners[first + count] = row
            count += 1
        slots[pair] = known[row]
    counts[band] = count


@compiled(**OPTIONS)
def chain_slots(view: View, owners: Any, counts: Any, heads: Any, following: Any) -> None:
    """Link the rows of each Gaussian over all bands: heads [M] and following [R], in order of the bands, -1 at the end."""
    heads[:] = -1
    row = len(following)
    for band in range(len(counts) - 1, -1, -1):
        first = view.offsets[view.bounds[band]]
        for slot in range(counts[band] - 1, -1, -1):
            row -= 1
            owner = owners[first + slot]
            following[row] = heads[owner]
            heads[owner] = row


@njit(**INLINE)
def _read_pixels(values: Any, width: int, box: Any, block: int, scratch: Any) -> Any:
    """A block's pixels of an image of one channel; 0 outside of the box."""
    left, top = box[0] + block % BLOCK * BLOCK, box[1] + block // BLOCK * BLOCK
    store(scratch, 0, 0)
    for y in range(min(box[3] - top, BLOCK)):
        for x in range(min(box[2] - left, BLOCK)):
            scratch[y * BLOCK + x] = values[(top + y) * width + left + x]
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
    maps, grad_maps, alphas, grad_alphas = pictures
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
    alpha = _read_pixels(alphas, maps.width, box, block, scratch)
    share = _read_pixels(grad_alphas, maps.width, box, block, scratch) - through
    store(planes, narrow.SHARE + p, share)
    store(planes, narrow.BEHIND + p, total - (1 - alpha) * through + alpha * share)


@compiled(**OPTIONS)
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
        images: maps, the loss's gradient in them, alphas, the loss's gradient in them, all flat.
        trace: of the forward pass.
        slots: [P] from `number_slots`.
        firsts: [B], where the band's rows begin.
        out: [R * length], added to.
    """
    maps, grad_maps, alphas, grad_alphas = images
    channels, width = len(maps) // len(alphas), view.width
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, alphas, grad_alphas
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes = aligned((2 + _whole_planes(passes, channels)) * PIXELS, rows)
    planes[:] = 0
    weights, scratch = aligned(PIXELS, rows), aligned(LANES * LANES, rows)
    squares = count_squares(view)
    drawn = trace[squares * (len(view.offsets) - 1) :]
    own = out[firsts[band] * length :]
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


@compiled(**OPTIONS)
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
    """Sum the gradients of one band's tiles into its own rows of `out`, with many channels.

    Args:
        band: which.
        view: the tiles.
        rows: packed Gaussians without features.
        length: of a packed row.
        source: features (flat), where each Gaussian's row begins, and D.
        background: D numbers, and zeros up to a whole vector.
        images: as for `differentiate_narrow`.
        trace: of the forward pass.
        slots: [P] from `number_slots`.
        firsts: [B], where the band's rows begin.
        out: [R * (LANES + padded D)], added to.
        geometry: whether the moments are wanted.
    """
    maps, grad_maps, alphas, grad_alphas = images
    channels, width = source[2], view.width
    stride = wide.padded(channels)
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, alphas, grad_alphas
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes, square_grads = aligned(2 * PIXELS, rows), aligned(PIXELS * stride, rows)
    scratch, slopes = aligned(LANES * LANES, rows), aligned((CHUNK + 3) * LANES, rows)
    kept = wide.make_kept(rows)
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    squares = count_squares(view)
    drawn = trace[squares * (len(view.offsets) - 1) :]
    own = out[firsts[band] * (LANES + stride) :]
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


@compiled(**OPTIONS)
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
        firsts: [B], where the band's rows begin.
        out: [R * padded(D + 1)], added to.
    """
    width = wide.padded(channels + 1)
    picture = Picture(pixels, view.width, channels)
    state, corners = aligned(STATE, rows), aligned(2 * BLOCKS, rows)
    planes, weights = aligned(width * PIXELS, rows), aligned(PIXELS, rows)
    planes[:] = 0
    scratch = aligned(LANES * LANES, rows)
    own = out[firsts[band] * width :]
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(count_squares(view)):
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


@njit(**INLINE)
def _sum_chain(row: int, following: Any, out: Any, width: int, total: Any) -> None:
    """Total = sum of the rows of one Gaussian; zeros if it has none."""
    for i in range(0, width, LANES):
        store(total, i, 0)
    while row >= 0:
        for i in range(0, width, LANES):
            store(total, i, load(total, i) + load(out, row * width + i))
        row = following[row]


@compiled(**OPTIONS)
def gather_gradients(
    band: int, bands: int, splats: Any, chains: Any, out: Any, layout: tuple[int, int, int], index: Any, grads: Any
) -> None:
    """Sum the rows of one share of the Gaussians over all bands, and turn moments into gradients.

    The power of the density is -0.5 (a dx^2 + 2 b dx dy + c dy^2) with d = pixel - mean, and v its slope.

    Args:
        band: which share.
        bands: how many shares; one if two Gaussians may show the same row of features.
        splats: conics [M * 3] and opacities [M].
        chains: heads and following, from `chain_slots`.
        out: gradient rows.
        layout: length of a gradient row, the column where the features begin, and D.
        index: [M], the features' row of each Gaussian; empty if row m belongs to Gaussian m.
        grads: of means2d [M * 2], conics [M * 3] and opacities [M], written; of features [N * D], added to.
    """
    conics, opacities = splats
    heads, following = chains
    width, column, channels = layout
    of_means, of_conics, of_opacities, of_features = grads
    count = len(heads)
    total = aligned(width, out)
    half = out.dtype.type(0.5)
    for m in range(count * band // bands, count * (band + 1) // bands):
        _sum_chain(heads[m], following, out, width, total)
        a, b, c = fetch(conics, 3 * m), fetch(conics, 3 * m + 1), fetch(conics, 3 * m + 2)
        v, v_x, v_y = fetch(total, 0), fetch(total, 1), fetch(total, 2)
        put(of_means, 2 * m, a * v_x + b * v_y)
        put(of_means, 2 * m + 1, b * v_x + c * v_y)
        put(of_conics, 3 * m, -half * fetch(total, 3))
        put(of_conics, 3 * m + 1, -fetch(total, 4))
        put(of_conics, 3 * m + 2, -half * fetch(total, 5))
        put(of_opacities, m, v / fetch(opacities, m) if v != 0 else v)
        into = (fetch(index, m) if len(index) else m) * channels
        for i in range(0, channels, LANES):
            lanes = lanes_below(out, channels - i)
            value = load_part(total, column + i, lanes)
            store_part(of_features, into + i, lanes, load_part(of_features, into + i, lanes) + value)


@compiled(**OPTIONS)
def gather_sums(band: int, bands: int, chains: Any, out: Any, width: int, sums: Any, weights: Any) -> None:
    """Sum the rows of one share of the Gaussians over all bands: sums [M, D] and weights [M], written."""
    heads, following = chains
    count, channels = len(heads), sums.shape[1]
    total = aligned(width, out)
    for m in range(count * band // bands, count * (band + 1) // bands):
        _sum_chain(heads[m], following, out, width, total)
        for i in range(channels):
            sums[m, i] = total[i]
        weights[m] = total[channels]
