"""Which Gaussians touch which square of pixels, front to back."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_shapes
from .engines import check_sizes
from .engines.contract import Tiles
from .engines.table import choose, choose_projecting
from .project import Projected, pixel_box, squared_reach

__all__ = ["Tiles", "bin_tiles"]


@torch.no_grad()
def bin_tiles(
    projected: Projected, width: int, height: int, tile_size: int | None = None, *, engine: str = "auto"
) -> Tiles:
    """List the Gaussians of every tile.

    A Gaussian is listed if alpha reaches 1/255 somewhere in the rectangle spanned by the tile's pixel centres: the smallest
    value of its quadratic form there is compared with 2 ln(255 opacity), with room for rounding. So no pair is missing
    that an engine would composite, and few are superfluous.

    Args:
        projected: M projected Gaussians in increasing order of index, as `project` returns them.
        width: of the image, pixels.
        height: of the image, pixels.
        tile_size: side of a tile, pixels; None: what is fastest for the engine.
        engine: as in `composite`. "reference" uses torch; the others find the same lists with compiled code.

    Returns:
        The (tile, Gaussian) pairs, grouped by tile; equally deep Gaussians are in order of their index.

    Raises:
        ValueError: if shapes disagree or a size is not a positive whole number, or the engine is unknown or cannot work on these
            tensors.
        ImportError: if the named engine's package is missing.
    """
    check_shapes(
        ("projected.means2d", projected.means2d, "M 2"),
        ("projected.conics", projected.conics, "M 3"),
        ("projected.depths", projected.depths, "M"),
        ("projected.opacities", projected.opacities, "M"),
        ("projected.extents", projected.extents, "M 2"),
    )
    if tile_size is None:
        tile_size = choose(engine, projected.means2d.device.type, projected.means2d.dtype).tile_size
    check_sizes(width, height, tile_size)
    compiled = choose_projecting(engine, *projected[:5])
    if compiled:
        rows, offsets = compiled.bin(*(value.contiguous() for value in projected[:5]), size=(width, height, tile_size))
    else:
        rows, offsets = _bin(projected, width, height, tile_size)
    return Tiles(rows, offsets, width, height, tile_size)


def _bin(projected: Projected, width: int, height: int, tile_size: int) -> tuple[Tensor, Tensor]:
    """Rows [P] and offsets [T + 1] of `Tiles`, by sorting the pairs; on any device."""
    columns, count = -(-width // tile_size), -(-width // tile_size) * -(-height // tile_size)
    order = torch.sort(projected.depths, stable=True).indices
    means2d, extents = projected.means2d[order], projected.extents[order]
    first, end = pixel_box(means2d, extents, width, height)
    filled = (end > first).all(dim=1)
    first_tile = torch.where(filled[:, None], first, 0).to(torch.int32) // tile_size
    end_tile = torch.where(filled[:, None], end - 1, -1).to(torch.int32) // tile_size + 1  # empty box: 0 tiles

    spans = end_tile - first_tile  # [M, 2] tiles along x and y
    hits = spans[:, 0] * spans[:, 1]
    near_to_far = torch.arange(len(order), dtype=torch.int32, device=order.device)
    which = torch.repeat_interleave(near_to_far, hits)  # [P'] candidates, front to back
    begin = torch.cumsum(hits, 0) - hits  # int64: candidates of huge Gaussians may be more than an int32 counts
    step = (torch.arange(len(which), device=order.device) - begin[which]).to(torch.int32)
    down = step // spans[which, 0]
    tile_y = first_tile[which, 1] + down
    tile_x = first_tile[which, 0] + step - down * spans[which, 0]

    rows = order.to(torch.int32)[which]
    touched = _touches_tile(projected, rows, tile_x * tile_size, tile_y * tile_size, tile_size)
    tile, by_tile = torch.sort((tile_y * columns + tile_x)[touched], stable=True)
    offsets = torch.searchsorted(tile, torch.arange(count + 1, dtype=tile.dtype, device=tile.device))
    return rows[touched][by_tile], offsets


def _touches_tile(
    projected: Projected,
    rows: Tensor,  # [P] int32
    left: Tensor,  # [P] int32, first pixel column of the tile
    top: Tensor,  # [P] int32
    tile_size: int,
) -> Tensor:  # [P] bool
    """Whether min d^T C d over the tile's pixel centres (as a solid rectangle) is at most 2 ln(255 opacity).

    The form is convex with its minimum 0 at the mean. With the mean outside, the minimum over the rectangle lies on one
    of the (at most two) sides that face it, where it is that of a parabola clamped to the side.
    """
    x, y = projected.means2d.unbind(1)
    a, b, c = (column[rows] for column in projected.conics.unbind(1))
    left, top = left + 0.5 - x[rows], top + 0.5 - y[rows]  # relative to the mean from here on
    right, bottom = left + (tile_size - 1), top + (tile_size - 1)
    near_x = left.clamp(min=0) + right.clamp(max=0)  # closest to the mean
    near_y = top.clamp(min=0) + bottom.clamp(max=0)
    along_y = torch.minimum(torch.maximum(-b / c * near_x, top), bottom)  # on the side x = near_x
    along_x = torch.minimum(torch.maximum(-b / a * near_y, left), right)  # on the side y = near_y
    smallest = torch.minimum(
        a * near_x * near_x + 2 * b * near_x * along_y + c * along_y * along_y,
        a * along_x * along_x + 2 * b * along_x * near_y + c * near_y * near_y,
    )
    reach = squared_reach(projected.opacities)[rows]
    # An engine rounds the same three terms at each pixel; they are largest, and cancel worst, in the far corner.
    far_x, far_y = torch.maximum(-left, right), torch.maximum(-top, bottom)
    terms = a * far_x * far_x + 2 * b.abs() * far_x * far_y + c * far_y * far_y
    return smallest <= reach + 8 * torch.finfo(x.dtype).eps * (terms + reach.abs() + 1)
