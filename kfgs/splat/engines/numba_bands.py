"""The compiled kernels over a band of tiles: forward, backward, and the sum of the bands' gradients."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numba import njit

from .numba_cells import (
    BEHIND,
    CELL_HEIGHT,
    CELL_WIDTH,
    CHUNK,
    LIGHT,
    OPTIONS,
    PIXELS,
    SHARE,
    STATE,
    SUMS,
    add_colors,
    any_light,
    find_run,
    find_slopes,
    start_cell,
    sum_features,
    sum_moments,
    weigh,
)

MOMENTS = 6
"""Leading columns of a gradient row: the sums of `sum_moments`; the features' gradients follow."""

_SOURCES = crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))
"""Numba's cache on disk notices a change in a kernel's own file alone. Kernels that call into other files take this
number as a default argument, whose value numba counts as part of the signature."""


class Splats(NamedTuple):
    """The arrays of M projected Gaussians."""

    means2d: Any  # [M, 2]
    conics: Any  # [M, 3]
    opacities: Any  # [M]
    features: Any  # [M, D]
    ellipses: Any  # [M, 8] float64, see `find_run`; reach = 2 ln(opacity / ALPHA_MIN)
    slack: float  # relative rounding error of the power of the density


class Grid(NamedTuple):
    """`Tiles` as arrays, and the bands: band b owns tiles bounds[b] to bounds[b + 1]."""

    rows: Any  # [P] int32
    offsets: Any  # [T + 1] int64
    bounds: Any  # [B + 1] int64
    width: int
    height: int
    tile_size: int


@njit(**OPTIONS)
def _chunk_scratch(dtype_of: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Weights and ratios of a chunk, and its Gaussians: their rows and where their runs start and stop."""
    planes = np.empty((2, CHUNK * PIXELS), dtype_of.dtype)
    lists = np.empty((3, CHUNK), np.int64)
    return planes[0], planes[1], lists[0], lists[1], lists[2]


@njit(**OPTIONS)
def _weigh_chunk(
    splats: Splats, grid: Grid, position: int, end: int, corner: tuple[int, int], state: Any, chunk: Any
) -> tuple[int, int]:
    """Weigh the next Gaussians that touch the cell, at most CHUNK; returns how many, and where in the list they end."""
    means2d, conics, opacities, _, ellipses, slack = splats
    weights, ratios, which, starts, stops = chunk
    left, top = corner
    rows = min(CELL_HEIGHT, grid.height - top)
    count = 0
    while position < end and count < CHUNK:
        row = grid.rows[position]
        position += 1
        run = find_run(ellipses, row, left, top, rows, slack)
        if run[1] > run[0]:
            splat = (means2d[row, 0], means2d[row, 1], conics[row, 0], conics[row, 1], conics[row, 2], opacities[row])
            weigh(state, weights, ratios, count * PIXELS, run, splat)
            which[count], starts[count], stops[count] = row, run[0], run[1]
            count += 1
    return count, position


@njit(**OPTIONS)
def _cells(grid: Grid) -> tuple[int, int]:
    """Rows and columns of cells in a tile."""
    return (grid.tile_size + CELL_HEIGHT - 1) // CELL_HEIGHT, (grid.tile_size + CELL_WIDTH - 1) // CELL_WIDTH


@njit(**OPTIONS)
def _box(grid: Grid, tile: int, cell: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom pixel of a cell of a tile, cut off at the tile's and the image's border."""
    columns = (grid.width + grid.tile_size - 1) // grid.tile_size
    _, across = _cells(grid)
    tile_x, tile_y = tile % columns * grid.tile_size, tile // columns * grid.tile_size
    left, top = tile_x + cell % across * CELL_WIDTH, tile_y + cell // across * CELL_HEIGHT
    right = min(left + CELL_WIDTH, tile_x + grid.tile_size, grid.width)
    bottom = min(top + CELL_HEIGHT, tile_y + grid.tile_size, grid.height)
    return left, top, right, bottom


@njit(cache=True, **OPTIONS)
def composite_band(
    band: int, splats: Splats, grid: Grid, background: Any, maps: Any, alphas: Any, ends: Any, sources: int = _SOURCES
) -> None:
    """Composite the tiles of one band.

    Args:
        band: which.
        splats: the Gaussians.
        grid: the tiles.
        background: [D].
        maps: [H, W, D], written.
        alphas: [H, W], written.
        ends: [T, cells of a tile] int64, written: where in `grid.rows` each cell was done.
    """
    channels = maps.shape[2]
    state, colors = np.empty(STATE, maps.dtype), np.empty(channels * PIXELS, maps.dtype)
    chunk = _chunk_scratch(maps)
    down, across = _cells(grid)
    for tile in range(grid.bounds[band], grid.bounds[band + 1]):
        for cell in range(down * across):
            left, top, right, bottom = _box(grid, tile, cell)
            if left >= right or top >= bottom:
                continue
            start_cell(state, left, top, right, bottom)
            colors[:] = 0
            position, end = grid.offsets[tile], grid.offsets[tile + 1]
            while position < end and any_light(state):
                count, position = _weigh_chunk(splats, grid, position, end, (left, top), state, chunk)
                add_colors(colors, chunk[0], splats.features, chunk[2], chunk[3], chunk[4], count)
            ends[tile, cell] = position
            for i in range(bottom - top):
                for j in range(right - left):
                    p = i * CELL_WIDTH + j
                    light = abs(state[LIGHT + p])
                    alphas[top + i, left + j] = 1 - light
                    for c in range(channels):
                        maps[top + i, left + j, c] = colors[c * PIXELS + p] + light * background[c]


@njit(cache=True, **OPTIONS)
def number_slots(band: int, grid: Grid, slots: Any, counts: Any) -> None:
    """Number the distinct Gaussians of one band: slots [B, M] int32, -1 where absent, and counts [B]."""
    slots[band] = -1
    count = 0
    for position in range(grid.offsets[grid.bounds[band]], grid.offsets[grid.bounds[band + 1]]):
        row = grid.rows[position]
        if slots[band, row] < 0:
            slots[band, row] = count
            count += 1
    counts[band] = count


@njit(fastmath=SUMS, **OPTIONS)
def _load_cell(
    box: tuple[int, int, int, int],
    background: Any,
    maps: Any,
    alphas: Any,
    grad: tuple[Any, Any],
    state: Any,
    grads: Any,
) -> None:
    """Fill `grads` [D planes], SHARE and BEHIND of one cell from the maps and the loss's gradients; 0 beyond the image.

    maps = sum w f + T background and alphas = sum w = 1 - T, so a weight's slope is f . grad + SHARE with
    SHARE = grad_alpha - background . grad, and all weights times their slopes are
    maps . grad - T background . grad + alphas SHARE.
    """
    left, top, right, bottom = box
    grad_maps, grad_alphas = grad
    none = maps.dtype.type(0)
    for i in range(CELL_HEIGHT):
        for j in range(CELL_WIDTH):
            p, y, x = i * CELL_WIDTH + j, top + i, left + j
            if x >= right or y >= bottom:
                for c in range(maps.shape[2]):
                    grads[c * PIXELS + p] = none
                state[SHARE + p] = state[BEHIND + p] = none
                continue
            through, total = none, none
            for c in range(maps.shape[2]):
                through += grad_maps[y, x, c] * background[c]
                total += grad_maps[y, x, c] * maps[y, x, c]
            for c in range(maps.shape[2]):
                grads[c * PIXELS + p] = grad_maps[y, x, c]
            state[SHARE + p] = grad_alphas[y, x] - through
            state[BEHIND + p] = total - (1 - alphas[y, x]) * through + alphas[y, x] * state[SHARE + p]


@njit(cache=True, **OPTIONS)
def differentiate_band(
    band: int,
    splats: Splats,
    grid: Grid,
    forward: tuple[Any, Any, Any, Any],
    grad: tuple[Any, Any],
    slots: Any,
    firsts: Any,
    out: Any,
    geometry: bool,
    sources: int = _SOURCES,
) -> None:
    """Sum the gradients of one band's tiles into its own rows of `out`.

    Front to back, as forward: what is still behind is the whole less what was in front, so no alpha is stored.

    Args:
        band: which.
        splats: the Gaussians.
        grid: the tiles.
        forward: background, maps, alphas, ends.
        grad: the loss's gradients in maps [H, W, D] and alphas [H, W].
        slots: [B, M] from `number_slots`.
        firsts: [B], where the band's rows begin.
        out: [R, MOMENTS + D], added to; [R, MOMENTS] if the features need no gradient.
        geometry: whether the moments are wanted.
    """
    background, maps, alphas, ends = forward
    channels = maps.shape[2]
    state, grads = np.empty(STATE, maps.dtype), np.empty(channels * PIXELS, maps.dtype)
    slopes = np.empty(CHUNK * PIXELS, maps.dtype)
    chunk = _chunk_scratch(maps)
    weights, ratios, which, starts, stops = chunk
    down, across = _cells(grid)
    own = out[firsts[band] :]
    for tile in range(grid.bounds[band], grid.bounds[band + 1]):
        for cell in range(down * across):
            box = _box(grid, tile, cell)
            left, top, right, bottom = box
            if left >= right or top >= bottom:
                continue
            position, end = grid.offsets[tile], ends[tile, cell]
            if position >= end:
                continue
            start_cell(state, left, top, right, bottom)
            _load_cell(box, background, maps, alphas, grad, state, grads)
            while position < end:
                count, position = _weigh_chunk(splats, grid, position, end, (left, top), state, chunk)
                if geometry:
                    find_slopes(slopes, state, grads, splats.features, which, starts, stops, count)
                    for k in range(count):
                        row = which[k]
                        x, y = splats.means2d[row, 0], splats.means2d[row, 1]
                        moments = sum_moments(state, weights, ratios, slopes, k * PIXELS, (starts[k], stops[k]), x, y)
                        slot = slots[band, row]
                        for m in range(MOMENTS):
                            own[slot, m] += moments[m]
                sum_features(own, MOMENTS, slots[band], weights, grads, which, starts, stops, count)


@njit(cache=True, **OPTIONS)
def gather_band(
    band: int, bands: int, splats: Splats, slots: Any, firsts: Any, rows: Any, out: tuple[Any, Any, Any, Any]
) -> None:
    """Sum the rows of one share of the Gaussians over all bands, in order, and turn moments into gradients.

    The power of the density is -0.5 (a dx^2 + 2 b dx dy + c dy^2) with d = pixel - mean, and v its slope.
    """
    means, conics, opacities, features = out
    count = len(splats.opacities)
    total = np.empty(rows.shape[1], rows.dtype)
    half = rows.dtype.type(0.5)
    for row in range(count * band // bands, count * (band + 1) // bands):
        total[:] = 0
        for other in range(slots.shape[0]):
            slot = slots[other, row]
            if slot >= 0:
                for m in range(len(total)):
                    total[m] += rows[firsts[other] + slot, m]
        a, b, c = splats.conics[row, 0], splats.conics[row, 1], splats.conics[row, 2]
        means[row, 0] = a * total[1] + b * total[2]
        means[row, 1] = b * total[1] + c * total[2]
        conics[row, 0] = -half * total[3]
        conics[row, 1] = -total[4]
        conics[row, 2] = -half * total[5]
        opacities[row] = total[0] / splats.opacities[row] if total[0] != 0 else total[0]
        for m in range(MOMENTS, len(total)):
            features[row, m - MOMENTS] = total[m]
