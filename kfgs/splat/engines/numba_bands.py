"""The compiled kernels over a band of tiles: forward, backward, accumulation, and the sum of what the bands found."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from . import numba_narrow as narrow
from . import numba_wide as wide
from .numba_simd import LANES, fma, load, load_many, spread, store, store_many, sum_many, transpose
from .numba_square import (
    BLOCK,
    BLOCKS,
    CHUNK,
    LEFT,
    OPTIONS,
    PIXELS,
    SOURCES,
    STATE,
    Picture,
    View,
    count_squares,
    read_block,
    square_box,
    start_square,
    write_block,
)

SIXTEEN = (0,) * LANES
"""A block's pixels, or as many channels."""


@njit(**OPTIONS)
def _write_alphas(state: Any, box: tuple[int, int, int, int], alphas: Any, width: int) -> None:
    """1 - transmittance of a square's pixels."""
    left, top, right, bottom = box
    for y in range(bottom - top):
        for x in range(right - left):
            p = (y // BLOCK * BLOCK + x // BLOCK) * LANES + y % BLOCK * BLOCK + x % BLOCK
            alphas[(top + y) * width + left + x] = 1 - state[LEFT + p]


@njit(cache=True, **OPTIONS)
def composite_narrow(
    band: int,
    view: View,
    rows: Any,
    length: int,
    passes: Any,
    background: Any,
    images: Any,
    trace: Any,
    sources: int = SOURCES,
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
        sources: see `SOURCES`.
    """
    maps, alphas = images
    channels = len(maps) // len(alphas)
    picture = Picture(maps, view.width, channels)
    state, corners = np.empty(STATE, rows.dtype), np.empty(2 * BLOCKS, rows.dtype)
    sums, weights = np.empty(passes[2] * PIXELS, rows.dtype), np.empty(CHUNK * LANES, rows.dtype)
    hits, counts = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int32)
    block_sums = np.zeros(LANES * LANES, rows.dtype)
    squares = count_squares(view)
    drawn = trace[squares * (len(view.offsets) - 1) :]
    for tile in range(view.bounds[band], view.bounds[band + 1]):
        start, end = view.offsets[tile], view.offsets[tile + 1]
        for square in range(squares):
            box = square_box(view, tile, square)
            if box[0] >= box[2] or box[1] >= box[3]:
                continue
            dark = start_square(state, corners, box)
            sums[:] = 0
            span = start, end, start * squares + square * (end - start)
            scratch = corners, sums, weights, hits, counts
            done = narrow.composite_square((rows, length, view.order), span, state, dark, passes, scratch, drawn)
            trace[tile * squares + square] = done - start
            _write_alphas(state, box, alphas, view.width)
            for block in range(BLOCKS):
                p = block * LANES
                left = load(state, LEFT + p)
                for channel in range(0, channels, LANES):
                    for c in range(min(LANES, passes[2] - channel)):
                        value = fma(left, background[channel + c], load(sums, (channel + c) * PIXELS + p))
                        store(block_sums, c * LANES, value)
                    store_many(block_sums, 0, LANES, transpose(load_many(SIXTEEN, block_sums, 0, LANES)))
                    write_block(picture, box, block, channel, block_sums, 0, LANES)


@njit(cache=True, **OPTIONS)
def composite_wide(
    band: int,
    view: View,
    rows: Any,
    length: int,
    features: Any,
    begins: Any,
    background: Any,
    images: Any,
    trace: Any,
    sources: int = SOURCES,
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
        sources: see `SOURCES`.
    """
    maps, alphas = images
    channels = len(maps) // len(alphas)
    picture, stride = Picture(maps, view.width, channels), wide.padded(channels)
    state, corners = np.empty(STATE, rows.dtype), np.empty(2 * BLOCKS, rows.dtype)
    sums = np.empty(PIXELS * stride, rows.dtype)
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
            sums[:] = 0
            span = start, end, start * squares + square * (end - start)
            scratch = corners, sums, kept, hits, counts
            packed, source = (rows, length, view.order), (features, begins, channels)
            done = wide.composite_square(packed, span, state, dark, source, scratch, drawn)
            trace[tile * squares + square] = done - start
            _write_alphas(state, box, alphas, view.width)
            for block in range(BLOCKS):
                for channel in range(0, channels, LANES):
                    behind = load(background, channel)
                    for p in range(block * LANES, (block + 1) * LANES):
                        store(
                            sums, p * stride + channel, fma(behind, state[LEFT + p], load(sums, p * stride + channel))
                        )
                    write_block(picture, box, block, channel, sums, block * LANES * stride + channel, stride)


@njit(cache=True, **OPTIONS)
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


@njit(cache=True, **OPTIONS)
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


@njit(**OPTIONS)
def _start_backward(
    state: Any, planes: Any, box: Any, block: int, pictures: Any, background: Any, scratch: Any
) -> None:
    """Fill the planes BEHIND and SHARE of one block, and leave nothing in them outside of the box.

    maps = sum w f + T background and alphas = sum w = 1 - T, so a weight's slope is f . grad + SHARE with
    SHARE = grad_alpha - background . grad, and all weights times their slopes are
    maps . grad - T background . grad + alphas SHARE.
    """
    maps, grads, alphas, grad_alphas = pictures
    p = block * LANES
    total, through = spread(planes, 0), spread(planes, 0)
    for channel in range(0, maps.channels, LANES):
        read_block(grads, box, block, channel, scratch, 0, LANES)
        read_block(maps, box, block, channel, scratch, LANES * LANES, LANES)
        behind = load(background, channel)
        for pixel in range(LANES):
            grad = load(scratch, pixel * LANES)
            place = (LANES + pixel) * LANES
            store(scratch, place, grad * load(scratch, place))
            store(scratch, place + LANES * LANES, grad * behind)
        total = total + sum_many(load_many(SIXTEEN, scratch, LANES * LANES, LANES))
        through = through + sum_many(load_many(SIXTEEN, scratch, 2 * LANES * LANES, LANES))
    read_block(alphas, box, block, 0, scratch, 0, LANES)
    read_block(grad_alphas, box, block, 0, scratch, LANES * LANES, LANES)
    alpha = sum_many(load_many(SIXTEEN, scratch, 0, LANES))  # one channel: the sum is its value
    share = sum_many(load_many(SIXTEEN, scratch, LANES * LANES, LANES)) - through
    store(planes, narrow.SHARE + p, share)
    store(planes, narrow.BEHIND + p, total - (1 - alpha) * through + alpha * share)


@njit(cache=True, **OPTIONS)
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
    sources: int = SOURCES,
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
        sources: see `SOURCES`.
    """
    maps, grad_maps, alphas, grad_alphas = images
    channels, width = len(maps) // len(alphas), view.width
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, Picture(alphas, width, 1), Picture(grad_alphas, width, 1)
    state, corners = np.empty(STATE, rows.dtype), np.empty(2 * BLOCKS, rows.dtype)
    planes = np.zeros((2 + passes[2]) * PIXELS, rows.dtype)
    weights, scratch = np.empty(PIXELS, rows.dtype), np.empty(3 * LANES * LANES, rows.dtype)
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
                _start_backward(state, planes, box, block, pictures, background, scratch)
                for channel in range(0, channels, LANES):
                    read_block(grads, box, block, channel, scratch, 0, LANES)
                    store_many(scratch, 0, LANES, transpose(load_many(SIXTEEN, scratch, 0, LANES)))
                    for c in range(min(LANES, passes[2] - channel)):
                        place = narrow.GRADS + (channel + c) * PIXELS + block * LANES
                        store(planes, place, load(scratch, c * LANES))
            span = start, start + looked_at, start * squares + square * (end - start)
            packed = rows, length, view.order
            narrow.differentiate_square(packed, span, state, passes, planes, weights, drawn, slots, own)


@njit(cache=True, **OPTIONS)
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
    sources: int = SOURCES,
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
        sources: see `SOURCES`.
    """
    maps, grad_maps, alphas, grad_alphas = images
    channels, width = source[2], view.width
    stride = wide.padded(channels)
    grads = Picture(grad_maps, width, channels)
    pictures = Picture(maps, width, channels), grads, Picture(alphas, width, 1), Picture(grad_alphas, width, 1)
    state, corners = np.empty(STATE, rows.dtype), np.empty(2 * BLOCKS, rows.dtype)
    planes, square_grads = np.empty(2 * PIXELS, rows.dtype), np.empty(PIXELS * stride, rows.dtype)
    scratch, slopes = np.empty(3 * LANES * LANES, rows.dtype), np.empty((CHUNK + 3) * LANES, rows.dtype)
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
                    _start_backward(state, planes, box, block, pictures, background, scratch)
                for channel in range(0, channels, LANES):
                    read_block(grads, box, block, channel, square_grads, block * LANES * stride + channel, stride)
            span = start, start + looked_at, start * squares + square * (end - start)
            packed, room = (rows, length, view.order), (kept, slopes, hits, counts)
            wide.differentiate_square(
                packed, span, state, source, square_grads, planes, room, drawn, slots, own, geometry
            )


@njit(cache=True, **OPTIONS)
def accumulate_band(
    band: int,
    view: View,
    rows: Any,
    length: int,
    pixels: Any,
    channels: int,
    slots: Any,
    firsts: Any,
    out: Any,
    sources: int = SOURCES,
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
        sources: see `SOURCES`.
    """
    width = wide.padded(channels + 1)
    picture = Picture(pixels, view.width, channels)
    state, corners = np.empty(STATE, rows.dtype), np.empty(2 * BLOCKS, rows.dtype)
    planes, weights = np.zeros(width * PIXELS, rows.dtype), np.empty(PIXELS, rows.dtype)
    scratch = np.empty(LANES * LANES, rows.dtype)
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
                    store_many(scratch, 0, LANES, transpose(load_many(SIXTEEN, scratch, 0, LANES)))
                    for c in range(LANES):
                        store(planes, (channel + c) * PIXELS + block * LANES, load(scratch, c * LANES))
            planes[channels * PIXELS : (channels + 1) * PIXELS] = 1
            packed = rows, length, view.order
            narrow.accumulate_square(packed, (start, end), state, dark, corners, planes, weights, slots, width, own)


@njit(cache=True, **OPTIONS)
def gather_gradients(
    band: int, bands: int, splats: Any, chains: Any, out: Any, layout: tuple[int, int], index: Any, grads: Any
) -> None:
    """Sum the rows of one share of the Gaussians over all bands, and turn moments into gradients.

    The power of the density is -0.5 (a dx^2 + 2 b dx dy + c dy^2) with d = pixel - mean, and v its slope.

    Args:
        band: which share.
        bands: how many shares.
        splats: conics [M, 3] and opacities [M].
        chains: heads and following, from `chain_slots`.
        out: gradient rows.
        layout: length of a gradient row, and the column where the features begin.
        index: [M], the features' row of each Gaussian; empty if row m belongs to Gaussian m.
        grads: of means2d [M, 2], conics [M, 3], opacities [M], written; of features [N, D], added to.
    """
    all_conics, all_opacities = splats
    heads, following = chains
    width, column = layout
    means, conics, opacities, features = grads
    count, channels = len(heads), features.shape[1]
    total = np.zeros(column + channels, out.dtype)
    half = out.dtype.type(0.5)
    for m in range(count * band // bands, count * (band + 1) // bands):
        total[:] = 0
        row = heads[m]
        while row >= 0:
            for i in range(column + channels):
                total[i] += out[row * width + i]
            row = following[row]
        a, b, c = all_conics[m, 0], all_conics[m, 1], all_conics[m, 2]
        means[m, 0], means[m, 1] = a * total[1] + b * total[2], b * total[1] + c * total[2]
        conics[m, 0], conics[m, 1], conics[m, 2] = -half * total[3], -total[4], -half * total[5]
        opacities[m] = total[0] / all_opacities[m] if total[0] != 0 else total[0]
        into = index[m] if len(index) else m
        for i in range(channels):
            features[into, i] += total[column + i]


@njit(cache=True, **OPTIONS)
def gather_sums(band: int, bands: int, chains: Any, out: Any, width: int, sums: Any, weights: Any) -> None:
    """Sum the rows of one share of the Gaussians over all bands: sums [M, D] and weights [M], written."""
    heads, following = chains
    count, channels = len(heads), sums.shape[1]
    for m in range(count * band // bands, count * (band + 1) // bands):
        sums[m] = 0
        weights[m] = 0
        row = heads[m]
        while row >= 0:
            for i in range(channels):
                sums[m, i] += out[row * width + i]
            weights[m] += out[row * width + channels]
            row = following[row]
