"""The compiled tests of Gaussians against tiles.

Most Gaussians lie in boxes of at most 2 x 2 tiles. These are tested together: batches of BATCH Gaussians are gathered into
planes (entry i of plane p is `state[p + i]`), and one loop without branches tests four tiles for 8 or 16 Gaussians at a
time. The tiles of a larger box are tested BATCH at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .cache import cached_njit, inner_njit

BATCH = 64
_X, _Y, _A, _B, _C, _EXTENT_X, _EXTENT_Y, _REACH = (k * BATCH for k in range(8))
_LEFT, _RIGHT, _TOP, _BOTTOM, _HIT = (k * BATCH for k in range(8, 13))  # the box, in tiles, and four answers
_TILE_X, _TILE_Y, _TOUCHED = (k * BATCH for k in range(16, 19))  # tiles of one Gaussian
_STATE = 19 * BATCH

# No kernel here has fused multiply-adds: torch rounds each product.


@cached_njit()
def find_pairs(
    band: int,
    bands: int,
    order: Any,  # [M] int32, rows by depth
    splats: tuple[Any, ...],  # means2d [2 M], conics [3 M], extents [2 M] and reach [M], 2 ln(opacity / ALPHA_MIN)
    eps: float,  # of the dtype
    picture: tuple[int, int, int],  # width, height and tile size, pixels
    counts: Any,  # [T] int32 of zeros, written: how many Gaussians of this share touch each tile
) -> tuple[Any, Any]:  # tiles and rows, int32, of the pairs, front to back
    """Find the tiles of one of `bands` equal shares of the Gaussians."""
    width, height, side = picture
    columns = (width + side - 1) // side
    tiles = columns * ((height + side - 1) // side)
    state, end = np.zeros(_STATE, splats[0].dtype), np.int64(0)  # a plain 0 is a type of its own to numba
    first, last = len(order) * band // bands, len(order) * (band + 1) // bands
    pairs = np.empty((2, 4 * (last - first) + 4 * BATCH), np.int32)
    for begin in range(first, last, BATCH):
        count = min(BATCH, last - begin)
        _gather(state, order, begin, count, splats)
        _test_batch(state, width, height, side, eps)
        if end + _count_boxes(state, count) > pairs.shape[1]:
            pairs = _grow(pairs, end, BATCH * tiles)
        end = _append_batch(state, order, begin, count, side, columns, eps, pairs[0], pairs[1], end)
    _count_tiles(pairs[0], end, counts)
    return pairs[0, :end], pairs[1, :end]


@cached_njit()
def sort_keys(keys: Any) -> Any:  # [M] uint32, overwritten -> [M] int32
    """Rows in the order of their keys; equal keys by row. Each pass orders them by 11 bits more."""
    rows, sorted_keys, sorted_rows = np.empty(len(keys), np.int32), np.empty_like(keys), np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        rows[i] = i
    for shift in range(0, 33, 11):
        places = np.zeros(2049, np.int32)
        for key in keys:
            places[(key >> shift & 2047) + 1] += 1
        for digit in range(2048):
            places[digit + 1] += places[digit]
        for i in range(len(keys)):
            digit = keys[i] >> shift & 2047
            place = places[digit]
            sorted_keys[place], sorted_rows[place] = keys[i], rows[i]
            places[digit] = place + 1
        keys, sorted_keys, rows, sorted_rows = sorted_keys, keys, sorted_rows, rows
    return rows


@cached_njit()
def list_rows(
    tiles: Any,  # of the pairs, from `find_pairs`
    which: Any,  # the pairs' rows
    starts: Any,  # [T] int64, where the share's part of each tile's list begins; changed
    rows: Any,  # [P] int32, written
) -> None:
    """Write the rows of one share's pairs into the tiles' lists."""
    for p in range(len(tiles)):
        tile = max(tiles[p], 0)
        at = max(starts[tile], 0)
        rows[at] = which[p]
        starts[tile] = at + 1


@inner_njit()
def _count_tiles(tiles: Any, end: int, counts: Any) -> None:
    """Count the pairs of each tile. A function of its own: numba counts references to arrays that a loop exchanges."""
    for p in range(end):
        counts[max(tiles[p], 0)] += 1


@inner_njit()
def _count_boxes(state: Any, count: int) -> int:
    """How many pairs `_append_batch` may look at."""
    total = 0
    for k in range(count):
        total += max(4, int((state[_RIGHT + k] - state[_LEFT + k]) * (state[_BOTTOM + k] - state[_TOP + k])))
    return total


@inner_njit()
def _grow(pairs: Any, count: int, room: int) -> Any:
    """A longer copy."""
    longer = np.empty((2, 2 * pairs.shape[1] + room), pairs.dtype)
    for k in range(count):
        longer[0, k], longer[1, k] = pairs[0, k], pairs[1, k]
    return longer


@inner_njit()
def _gather(state: Any, order: Any, begin: int, count: int, splats: tuple[Any, Any, Any, Any]) -> None:
    """Copy some Gaussians, front to back, into the planes."""
    means2d, conics, extents, reaches = splats
    for k in range(count):
        row = max(order[begin + k], 0)
        state[_X + k], state[_Y + k] = means2d[2 * row], means2d[2 * row + 1]
        state[_A + k], state[_B + k], state[_C + k] = conics[3 * row], conics[3 * row + 1], conics[3 * row + 2]
        state[_EXTENT_X + k], state[_EXTENT_Y + k] = extents[2 * row], extents[2 * row + 1]
        state[_REACH + k] = reaches[row]


@inner_njit()
def _test_batch(state: Any, width: int, height: int, side: int, eps: float) -> None:
    """Find each Gaussian's box of tiles, and test the first 2 x 2 of them."""
    kind = state.dtype.type
    one, size, length = kind(1), kind(side), kind(side - 1)
    across, down = kind(width), kind(height)
    half, per_side, rounding, slack = kind(0.5), kind(1 / side), kind(4 * eps), kind(8 * eps)
    for i in range(BATCH):
        x, y, reach = state[_X + i], state[_Y + i], state[_REACH + i]
        a, b, c = state[_A + i], state[_B + i], state[_C + i]
        form = a, b + b, c, -b / a, -b / c, reach, slack, one
        left, right = _span(x, state[_EXTENT_X + i], across, half, one, per_side, rounding)
        top, bottom = _span(y, state[_EXTENT_Y + i], down, half, one, per_side, rounding)
        right, bottom = (right if bottom > top else left), (bottom if right > left else top)  # both or none are empty
        state[_LEFT + i], state[_RIGHT + i], state[_TOP + i], state[_BOTTOM + i] = left, right, top, bottom
        x_0, x_1 = left * size + half - x, (left + one) * size + half - x
        y_0, y_1 = top * size + half - y, (top + one) * size + half - y
        filled, wide, high = right > left, left + one < right, top + one < bottom
        state[_HIT + i] = one if filled & _touches(form, x_0, y_0, length) else one - one
        state[_HIT + BATCH + i] = one if wide & _touches(form, x_1, y_0, length) else one - one
        state[_HIT + 2 * BATCH + i] = one if high & _touches(form, x_0, y_1, length) else one - one
        state[_HIT + 3 * BATCH + i] = one if wide & high & _touches(form, x_1, y_1, length) else one - one


@inner_njit(inline="always")
def _span(mean: Any, extent: Any, pixels: Any, half: Any, one: Any, per_side: Any, rounding: Any) -> tuple[Any, Any]:
    """First and one past the last tile, along one axis, with a pixel centre within `extent` of the mean (`pixel_box`)."""
    slack = rounding * (abs(mean) + extent)
    first, last = np.ceil(mean - extent - half - slack), np.floor(mean + extent - half + slack) + one
    known = (first == first) & (last == last)
    first, last = max(first, one - one), min(last, pixels)
    # A pixel's number and a half lies off the tiles' borders: no rounding matters.
    begin, end = np.floor((first + half) * per_side), np.floor((last - half) * per_side) + one
    filled = known & (last > first)
    return begin if filled else one - one, end if filled else one - one


@inner_njit(inline="always")
def _touches(form: tuple[Any, Any, Any, Any, Any, Any, Any, Any], left: Any, top: Any, length: Any) -> bool:
    """Whether the form's least value over a square of pixel centres is within its limit; NaN is not.

    See `_touches_tile` of `kfgs.splat.tiles`, whose arithmetic this is. The form is a, 2 b, c, -b / a, -b / c, reach, the
    limit's relative slack, and 1; the square's left and top are relative to the mean.
    """
    a, b2, c, along_x, along_y, reach, slack, one = form
    none = one - one
    right, bottom = left + length, top + length
    near_x, near_y = max(left, none) + min(right, none), max(top, none) + min(bottom, none)
    lean_y, lean_x = along_y * near_x, along_x * near_y
    at_y, at_x = min(max(lean_y, top), bottom), min(max(lean_x, left), right)
    on_x = a * near_x * near_x + b2 * near_x * at_y + c * at_y * at_y
    on_y = a * at_x * at_x + b2 * at_x * near_y + c * near_y * near_y
    known = (lean_x == lean_x) & (lean_y == lean_y) & (on_x == on_x) & (on_y == on_y)
    # what an engine's rounding may add where the form's terms are largest and cancel worst
    far_x, far_y = max(-left, right), max(-top, bottom)
    terms = a * far_x * far_x + abs(b2) * far_x * far_y + c * far_y * far_y
    return known & (min(on_x, on_y) <= reach + slack * (terms + abs(reach) + one))


@inner_njit()
def _append_batch(
    state: Any, order: Any, begin: int, count: int, side: int, columns: int, eps: float, tiles: Any, rows: Any, end: int
) -> int:
    """Append the pairs of a batch to `tiles` and `rows`; returns their new number."""
    for k in range(count):
        row, end = order[begin + k], max(end, 0)
        left, right = int(state[_LEFT + k]), int(state[_RIGHT + k])
        top, bottom = int(state[_TOP + k]), int(state[_BOTTOM + k])
        if right - left <= 2 and bottom - top <= 2:
            corner = top * columns + left
            for j in range(4):
                tiles[end], rows[end] = corner + (j & 1) + (j >> 1) * columns, row
                end += state[_HIT + j * BATCH + k] > 0
        else:
            start, end = end, _test_box(state, k, (left, right, top, bottom), side, columns, eps, tiles, end)
            rows[start:end] = row
    return end


@inner_njit()
def _test_box(
    state: Any, k: int, box: tuple[int, int, int, int], side: int, columns: int, eps: float, tiles: Any, end: int
) -> int:
    """Append the tiles of the batch's Gaussian k, whose box may be of any size; returns their new number."""
    kind = state.dtype.type
    length, one, slack = kind(side - 1), kind(1), kind(8 * eps)
    x, y, a, b, c = state[_X + k], state[_Y + k], state[_A + k], state[_B + k], state[_C + k]
    form = a, b + b, c, -b / a, -b / c, state[_REACH + k], slack, one
    left, right, top, bottom = box
    count: Any = np.int64(0)
    for tile_y in range(top, bottom):
        for tile_x in range(left, right):
            state[_TILE_X + max(count, 0)], state[_TILE_Y + max(count, 0)] = tile_x, tile_y
            count += 1
            if count == BATCH:
                end = _append_touched(state, count, form, x, y, columns, length, tiles, end)
                count = np.int64(0)
    return _append_touched(state, count, form, x, y, columns, length, tiles, end)


@inner_njit()
def _append_touched(
    state: Any, count: int, form: Any, x: Any, y: Any, columns: int, length: Any, tiles: Any, end: int
) -> int:
    """Append those of the first `count` tiles in the planes that one Gaussian touches; returns their new number."""
    one = form[7]
    size, half = length + one, one / (one + one)
    for i in range(count):
        left, top = state[_TILE_X + i] * size + half - x, state[_TILE_Y + i] * size + half - y
        state[_TOUCHED + i] = one if _touches(form, left, top, length) else one - one
    for i in range(count):
        tiles[max(end, 0)] = int(state[_TILE_Y + i]) * columns + int(state[_TILE_X + i])
        end += state[_TOUCHED + i] > 0
    return end
