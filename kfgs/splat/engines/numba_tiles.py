"""Which Gaussians touch which tile, compiled by numba: one sort of the Gaussians by depth, none of the pairs.

Gaussians are taken front to back in bands. A band tests its Gaussians against the tiles and keeps, for each, the tiles
that are touched; then every band knows where in each tile's list its Gaussians begin, and writes them there. The work is
proportional to the pairs found, and the lists are those of the torch code in `kfgs.splat.tiles`, to the bit: the test is
the same arithmetic in the same order, only left out where its outcome is certain.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from .contract import ALPHA_MIN
from .numba_threads import run_bands

__all__ = ["bin", "depth_order"]

_SHARE = 8192
"""Gaussians of a band."""
_DIGIT = 11
"""Bits sorted at once: 2048 counters stay in the first-level cache, and 32 bits take three passes."""
_NARROW = 2
"""In a box of more tiles than this across, each row of tiles is first cut to where the ellipse is."""
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}  # no fused multiply-add: torch rounds each product
_MARGIN, _ROUNDING = 1 + 1e-6, 1e-6
"""Of the cut's float64 arithmetic: of the form's level, and of pixels."""
_FLAT, _HUGE = 1e-9, 1e30
"""No row is cut where the determinant has lost its digits, a c - b^2 <= 1e-9 a c, or for a level beyond 1e30."""


class Form(NamedTuple):
    """The quadratic form a x^2 + 2 b x y + c y^2 of one Gaussian, and when a tile is touched."""

    a: Any
    b2: Any  # 2 b
    c: Any
    reach: Any  # 2 ln(255 opacity)
    slack: Any  # relative, for an engine's rounding
    along_x: Any  # -b / a: where the form is least on a line of constant y = 1
    along_y: Any  # -b / c
    sure: Any  # a tile whose least value is at most this is touched
    possible: Any  # one whose least value is larger is not
    det: float  # a c - b^2, or 0: no row is cut
    level: float  # the ellipse form = level holds all tiles that are touched
    lean: float  # y of that ellipse's rightmost point


@torch.no_grad()
def bin(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    depths: Tensor,  # [M]
    opacities: Tensor,  # [M]
    extents: Tensor,  # [M, 2]
    width: int,
    height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor]:  # rows [P] int32, offsets [T + 1] int64
    """List the Gaussians of every tile, as `kfgs.splat.bin_tiles` says.

    Args:
        means2d: contiguous, like all that follow, float32 or float64, on the CPU.
        conics: as `project` returns them.
        depths: as `project` returns them.
        opacities: as `project` returns them.
        extents: as `project` returns them.
        width: of the picture, pixels.
        height: of the picture, pixels.
        tile_size: side of a tile, pixels.

    Returns:
        Tile t owns rows[offsets[t]:offsets[t + 1]], by depth, then by row.
    """
    M, tiles = len(depths), -(-width // tile_size) * -(-height // tile_size)
    bands = max(1, -(-M // _SHARE))
    order = depth_order(depths)
    reach = torch.log(opacities / ALPHA_MIN).mul_(2)
    splats = tuple(value.view(-1).numpy() for value in (means2d, conics, extents, reach))
    counts, hits = np.zeros((bands, tiles), np.int32), np.zeros(M, np.int32)
    found: list[Any] = [None] * bands
    slack = float(torch.finfo(means2d.dtype).eps)

    def find(band: int) -> None:
        found[band] = find_tiles(band, bands, order, splats, slack, (width, height, tile_size), counts, hits)

    run_bands(find, bands)
    offsets = np.zeros(tiles + 1, np.int64)
    np.cumsum(counts.sum(axis=0, dtype=np.int64), out=offsets[1:])
    starts = np.cumsum(counts, axis=0, dtype=np.int64) - counts + offsets[:-1]
    rows = np.empty(int(offsets[-1]), np.int32)
    run_bands(lambda band: list_rows(band, bands, order, found[band], hits, starts, rows), bands)
    return torch.from_numpy(rows), torch.from_numpy(offsets)


def depth_order(depths: Tensor) -> np.ndarray:  # [M] -> [M] int32
    """The rows by depth; equal depths by row. NaN comes last, as torch sorts."""
    values = depths.detach().numpy()
    return sort_rows(values.view(np.uint32 if values.itemsize == 4 else np.uint64))


@njit(cache=True, **_OPTIONS)
def sort_rows(bits: Any) -> Any:
    """Stable radix sort of floating point numbers, given as their bits [M]; returns the rows [M] int32."""
    count, passes = len(bits), (8 * bits.itemsize + _DIGIT - 1) // _DIGIT
    keys, keys_out = np.empty(count, bits.dtype), np.empty(count, bits.dtype)
    rows, rows_out = np.empty(count, np.int32), np.empty(count, np.int32)
    places = np.zeros((passes, 1 << _DIGIT), np.int32)
    for i in range(count):
        key = _sortable(bits[i], bits)
        keys[i], rows[i] = key, i
        for p in range(passes):
            places[p, _digit(key, p, bits)] += 1
    for p in range(passes):
        begin = 0
        for d in range(1 << _DIGIT):
            begin, places[p, d] = begin + places[p, d], begin
        for i in range(count):
            d = _digit(keys[i], p, bits)
            at = places[p, d]
            places[p, d] = at + 1
            keys_out[at], rows_out[at] = keys[i], rows[i]
        keys, keys_out, rows, rows_out = keys_out, keys, rows_out, rows
    return rows


@njit(**_OPTIONS)
def _sortable(value: Any, bits: Any) -> Any:
    """Bits that are in the numbers' order: negative numbers turned round, zero without a sign, NaN above all."""
    kind = bits.dtype.type
    sign = kind(kind(1) << kind(8 * bits.itemsize - 1))
    infinity = kind(kind(0xFF) << kind(23)) if bits.itemsize == 4 else kind(kind(0x7FF) << kind(52))
    size = kind(value & kind(~sign))
    if size > infinity:
        return kind(~kind(0))
    return kind(~value) if value > sign else kind(size | sign)


@njit(**_OPTIONS)
def _digit(key: Any, number: int, bits: Any) -> int:
    """One digit of a key, the lowest first."""
    kind = bits.dtype.type
    return np.int64(kind(key >> kind(_DIGIT * number)) & kind((1 << _DIGIT) - 1))


@njit(cache=True, **_OPTIONS)
def find_tiles(
    band: int,
    bands: int,
    order: Any,
    splats: tuple[Any, Any, Any, Any],
    eps: float,
    picture: tuple[int, int, int],
    counts: Any,
    hits: Any,
) -> Any:
    """Find the tiles of one share of the Gaussians, front to back.

    Args:
        band: which.
        bands: into how many equal shares the M Gaussians are cut.
        order: [M] int32, rows by depth.
        splats: means2d [2 M], conics [3 M], extents [2 M] and reach [M], 2 ln(opacity / ALPHA_MIN).
        eps: of the dtype.
        picture: width, height and tile size, pixels.
        counts: [B, T] int32 of zeros; row `band` is written: how many Gaussians each tile gets.
        hits: [M] int32 of zeros, written: how many tiles the Gaussian at each place of the order touches.

    Returns:
        The tiles, one Gaussian's after another's; what follows the last is undefined.
    """
    means2d, conics, extents, reaches = splats
    width, height, side = picture
    columns = (width + side - 1) // side
    kind = means2d.dtype.type
    half, length = kind(0.5), kind(side - 1)
    first, last = len(order) * band // bands, len(order) * (band + 1) // bands
    found, end = np.empty(4 * (last - first) + columns, np.int32), 0
    for i in range(first, last):
        row = max(order[i], 0)
        x, y = means2d[2 * row], means2d[2 * row + 1]
        left, right = _span(x, extents[2 * row], width, side, means2d, eps)
        top, bottom = _span(y, extents[2 * row + 1], height, side, means2d, eps)
        if left >= right or top >= bottom:
            continue
        if end + (right - left) * (bottom - top) > len(found):
            found = _grow(found, end, end + (right - left) * (bottom - top))
        box = left * side, right * side - 1, top * side, bottom * side - 1
        form, begin = _prepare(conics, row, reaches[row], x, y, box, eps), end
        for tile_y in range(top, bottom):
            start, stop = left, right
            if right - left > _NARROW:
                start, stop = _narrow(form, np.float64(x), np.float64(y), tile_y, left, right, side)
            for tile_x in range(start, stop):
                tile = max(tile_y * columns + tile_x, 0)
                if _touches(form, kind(tile_x * side) + half - x, kind(tile_y * side) + half - y, length):
                    found[end] = tile
                    counts[band, tile] += 1
                    end += 1
        hits[i] = end - begin
    return found


@njit(cache=True, **_OPTIONS)
def list_rows(band: int, bands: int, order: Any, found: Any, hits: Any, starts: Any, rows: Any) -> None:
    """Write the rows of one share of the Gaussians into the tiles' lists.

    Args:
        band: which.
        bands: as for `find_tiles`.
        order: [M] int32, rows by depth.
        found: what `find_tiles` returned for this band.
        hits: [M] int32 from `find_tiles`.
        starts: [B, T] int64, where the band's part of each tile's list begins; changed.
        rows: [P] int32, written.
    """
    next_hit = 0
    for i in range(len(order) * band // bands, len(order) * (band + 1) // bands):
        for _ in range(hits[i]):
            tile = max(found[next_hit], 0)
            at = max(starts[band, tile], 0)
            rows[at] = order[i]
            starts[band, tile] = at + 1
            next_hit += 1


@njit(**_OPTIONS)
def _grow(found: Any, count: int, least: int) -> Any:
    """A longer copy."""
    longer = np.empty(max(2 * len(found), least), found.dtype)
    longer[:count] = found[:count]
    return longer


@njit(**_OPTIONS)
def _span(mean: Any, extent: Any, pixels: int, side: int, dtype_of: Any, eps: float) -> tuple[int, int]:
    """First and one past the last tile, along one axis, with a pixel centre within `extent` of the mean (`pixel_box`)."""
    kind = dtype_of.dtype.type
    half, one, none, size = kind(0.5), kind(1), kind(0), kind(pixels)
    rounding = kind(4 * eps) * (abs(mean) + extent)
    first, last = np.ceil(mean - extent - half - rounding), np.floor(mean + extent - half + rounding) + one
    first = none if first < none else first
    last = size if last > size else last
    if not last > first:  # nor with NaN
        return 0, 0
    per_side = 1.0 / side  # pixel + 0.5 lies half a pixel from the tile's border: no rounding matters
    return int((first + 0.5) * per_side), int((last - 0.5) * per_side) + 1


@njit(**_OPTIONS)
def _prepare(conics: Any, row: int, reach: Any, x: Any, y: Any, box: tuple[int, int, int, int], eps: float) -> Form:
    """What the tests of one Gaussian have in common; `box` is the first and last pixel that any of them looks at."""
    kind = conics.dtype.type
    a, b, c = conics[3 * row], conics[3 * row + 1], conics[3 * row + 2]
    b2, slack = kind(2) * b, kind(8 * eps)
    left, right, top, bottom = box
    far_x = max(-(kind(left) + kind(0.5) - x), kind(right) + kind(0.5) - x)
    far_y = max(-(kind(top) + kind(0.5) - y), kind(bottom) + kind(0.5) - y)
    sure, possible = reach, _limit(a, b2, c, reach, slack, far_x, far_y)
    if not (a > 0 and c > 0):  # not an ellipse: nothing is certain
        sure, possible = kind(-np.inf), kind(np.inf)
    wide_a, wide_b, wide_c = np.float64(a), np.float64(b), np.float64(c)
    det = wide_a * wide_c - wide_b * wide_b
    level = (2 * np.float64(possible) - np.float64(reach)) * _MARGIN  # beyond it, rounding cannot bring a tile below `possible`
    if not (det > _FLAT * wide_a * wide_c and 0 < level < _HUGE):
        return Form(a, b2, c, reach, slack, -b / a, -b / c, sure, possible, 0.0, 0.0, 0.0)
    lean = -wide_b / wide_c * math.sqrt(wide_c * level / det)
    return Form(a, b2, c, reach, slack, -b / a, -b / c, sure, possible, det, level, lean)


@njit(**_OPTIONS)
def _limit(a: Any, b2: Any, c: Any, reach: Any, slack: Any, far_x: Any, far_y: Any) -> Any:
    """2 ln(255 opacity), and what an engine's rounding may add where the form's terms are largest and cancel worst."""
    terms = a * far_x * far_x + abs(b2) * far_x * far_y + c * far_y * far_y
    return reach + slack * (terms + abs(reach) + type(slack)(1))


@njit(**_OPTIONS)
def _touches(form: Form, left: Any, top: Any, length: Any) -> bool:
    """Whether the form's least value over a square of pixel centres is within its limit, as `bin_tiles` has it.

    Args:
        form: of the Gaussian.
        left: of the square, relative to the mean.
        top: likewise.
        length: of the square's sides.
    """
    right, bottom = left + length, top + length
    none = length - length
    near_x = left if left > none else right if right < none else none
    near_y = top if top > none else bottom if bottom < none else none
    at_y = _clamp(form.along_y * near_x, top, bottom)
    at_x = _clamp(form.along_x * near_y, left, right)
    on_x = form.a * near_x * near_x + form.b2 * near_x * at_y + form.c * at_y * at_y
    on_y = form.a * at_x * at_x + form.b2 * at_x * near_y + form.c * near_y * near_y
    least = on_x if on_x < on_y or on_x != on_x else on_y
    if least <= form.sure:
        return True
    if least > form.possible:
        return False
    far_x, far_y = max(-left, right), max(-top, bottom)
    return least <= _limit(form.a, form.b2, form.c, form.reach, form.slack, far_x, far_y)


@njit(**_OPTIONS)
def _clamp(value: Any, low: Any, high: Any) -> Any:
    """NaN stays NaN."""
    return low if value < low else high if value > high else value


@njit(**_OPTIONS)
def _narrow(form: Form, x: float, y: float, tile_y: int, left: int, right: int, side: int) -> tuple[int, int]:
    """Cut a row of tiles, [left, right), to those that the ellipse form = level may touch.

    At height d_y over the mean the ellipse reaches from (-b d_y - root) / a to (-b d_y + root) / a with
    root^2 = a level - d_y^2 det. Its rightmost point is at d_y = lean, its leftmost at -lean; where these lie beside the
    row, the row's points furthest right and left are on the side that is nearer.
    """
    if form.det == 0.0:
        return left, right
    a, b = np.float64(form.a), 0.5 * np.float64(form.b2)
    top = tile_y * side + 0.5 - y
    bottom = top + (side - 1)
    high, low = _clamp(form.lean, top, bottom), _clamp(-form.lean, top, bottom)
    root_high, root_low = a * form.level - high * high * form.det, a * form.level - low * low * form.det
    if not (root_high >= 0 and root_low >= 0):
        return left, left
    reach_right = (-b * high + math.sqrt(root_high)) / a
    reach_left = (-b * low - math.sqrt(root_low)) / a
    begin = (x + reach_left - _ROUNDING * (1 + abs(reach_left)) + 0.5 - side) / side  # its last pixel centre
    end = (x + reach_right + _ROUNDING * (1 + abs(reach_right)) - 0.5) / side  # its first
    if begin > left:
        left = int(math.ceil(min(begin, float(right))))
    if end < right - 1:
        right = int(max(end, float(left) - 1)) + 1 if end >= 0 else left
    return left, right
