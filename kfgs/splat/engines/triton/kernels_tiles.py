"""The Triton kernels that list the Gaussians of every tile: how many tiles a Gaussian's box has, and which it touches."""

# mypy: disable-error-code="no-untyped-def"

import triton
import triton.language as tl

from .kernels_project import LEAST, ROUNDING, load

EPSILON = tl.constexpr(8 * 2.0**-23)  # room for rounding, as `bin_tiles` leaves it


@triton.jit
def find_span(mean, extent, size, SIDE: tl.constexpr):
    """The first tile along an axis of the pixels whose centres lie within `extent`, and how many tiles; 0 of no pixel."""
    slack = ROUNDING * (tl.abs(mean) + extent)
    first = tl.maximum(tl.ceil(mean - extent - 0.5 - slack), 0.0)
    last = tl.minimum(tl.floor(mean + extent - 0.5 + slack) + 1.0, size.to(tl.float32))
    filled = last > first
    begin = tl.where(filled, first, 0.0).to(tl.int32) // SIDE
    return begin, tl.where(filled, (tl.where(filled, last, 1.0).to(tl.int32) - 1) // SIDE + 1 - begin, 0)


@triton.jit
def find_box(m, there, means2d, extents, width, height, SIDE: tl.constexpr):
    """The Gaussian's mean, and the first tile and the number of tiles along x and y."""
    x, y = load(means2d, 2 * m, there), load(means2d, 2 * m + 1, there)
    left, across = find_span(x, load(extents, 2 * m, there), width, SIDE)
    top, down = find_span(y, load(extents, 2 * m + 1, there), height, SIDE)
    return x, y, left, across, top, down


@triton.jit(do_not_specialize=["count", "width", "height"])
def count_kernel(order, means2d, extents, hits, count, width, height, SIDE: tl.constexpr, BLOCK: tl.constexpr):
    """How many tiles the box of each of the `count` Gaussians has, front to back."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = i < count
    m = tl.load(order + i, mask=there, other=0)
    _, _, _, across, _, down = find_box(m, there, means2d, extents, width, height, SIDE)
    tl.store(hits + i, across.to(tl.int64) * down, mask=there)


@triton.jit(do_not_specialize=["total", "count", "width", "height", "columns", "none"])
def list_kernel(
    order, ends, means2d, conics, opacities, extents, rows, tiles,
    total, count, width, height, columns, none, SIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the row and the tile of each of the `total` candidates; the tile is `none` where alpha stays below 1/255.

    `ends` says where the candidates of a Gaussian end; which Gaussian a candidate belongs to is found by halving.
    """
    p = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = p < total
    low, high = p * 0, p * 0 + count - 1
    width_left = count
    while width_left > 1:
        middle = (low + high) // 2
        before = tl.load(ends + middle, mask=there, other=0) <= p
        low, high = tl.where(before, tl.minimum(middle + 1, high), low), tl.where(before, high, middle)
        width_left = (width_left + 1) // 2
    m = tl.load(order + low, mask=there, other=0)
    x, y, left, across, top, down = find_box(m, there, means2d, extents, width, height, SIDE)
    step = (p - (tl.load(ends + low, mask=there, other=0) - across.to(tl.int64) * down)).to(tl.int32)
    across = tl.maximum(across, 1)
    column, line = left + step % across, top + step // across

    # the smallest value of the quadratic form over the tile's pixel centres: see `_touches_tile`
    a = tl.load(conics + 3 * m, mask=there, other=1.0)
    b = tl.load(conics + 3 * m + 1, mask=there, other=0.0)
    c = tl.load(conics + 3 * m + 2, mask=there, other=1.0)
    x0, y0 = (column * SIDE).to(tl.float32) + 0.5 - x, (line * SIDE).to(tl.float32) + 0.5 - y
    x1, y1 = x0 + (SIDE - 1), y0 + (SIDE - 1)
    near_x, near_y = tl.maximum(x0, 0.0) + tl.minimum(x1, 0.0), tl.maximum(y0, 0.0) + tl.minimum(y1, 0.0)
    along_y = tl.minimum(tl.maximum(-b / c * near_x, y0), y1)
    along_x = tl.minimum(tl.maximum(-b / a * near_y, x0), x1)
    smallest = tl.minimum(
        a * near_x * near_x + 2.0 * b * near_x * along_y + c * along_y * along_y,
        a * along_x * along_x + 2.0 * b * along_x * near_y + c * near_y * near_y,
    )
    reach = 2.0 * tl.log(tl.load(opacities + m, mask=there, other=1.0) / LEAST)
    far_x, far_y = tl.maximum(-x0, x1), tl.maximum(-y0, y1)
    terms = a * far_x * far_x + 2.0 * tl.abs(b) * far_x * far_y + c * far_y * far_y
    touched = smallest <= reach + EPSILON * (terms + tl.abs(reach) + 1.0)
    tl.store(rows + p, m.to(tl.int32), mask=there)
    tl.store(tiles + p, tl.where(touched, line * columns + column, none).to(tiles.dtype.element_ty), mask=there)
