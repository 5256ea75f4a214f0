"""The CPU engine: compositing compiled by numba, with its own backward pass.

Work is cut into bands of tiles by the data alone; each band writes its own pixels and its own gradient rows, and the
rows are summed in the order of the bands. Reruns are therefore equal to the bit, whatever the number of threads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .contract import ALPHA_MIN
from .numba_bands import MOMENTS, Grid, Splats, composite_band, differentiate_band, gather_band, number_slots
from .numba_cells import CELL_HEIGHT, CELL_WIDTH
from .numba_threads import run_bands

if TYPE_CHECKING:
    from ..tiles import Tiles

__all__ = ["composite"]

BANDS = 16
"""Shares of the work. More of them balance better, and let more gradient rows meet at their borders."""


def composite(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    features: Tensor,  # [M, D]
    tiles: Tiles,
    background: Tensor | None,  # [D]
) -> tuple[Tensor, Tensor]:  # maps [H, W, D], alphas [H, W]
    """Composite as `contract` promises; conics must be positive definite."""
    if background is None:
        background = features.new_zeros(features.shape[1])
    maps, alphas = _Composite.apply(means2d, conics, opacities, features, background, tiles)
    return maps, alphas


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        features: Tensor,
        background: Tensor,
        tiles: Tiles,
    ) -> tuple[Tensor, Tensor]:
        maps = features.new_empty(tiles.height, tiles.width, features.shape[1])
        alphas = features.new_empty(tiles.height, tiles.width)
        splats, grid = _splats(means2d, conics, opacities, features), _grid(tiles)
        cells = -(-tiles.tile_size // CELL_HEIGHT) * -(-tiles.tile_size // CELL_WIDTH)
        ends = np.empty((len(grid.offsets) - 1, cells), np.int64)
        run_bands(composite_band, BANDS, splats, grid, _array(background), _array(maps), _array(alphas), ends)
        ctx.save_for_backward(means2d, conics, opacities, features, background, maps, alphas)
        ctx.tiles, ctx.ends = tiles, ends
        return maps, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_maps: Tensor, grad_alphas: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, features, background, maps, alphas = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        splats, grid = _splats(means2d, conics, opacities, features), _grid(ctx.tiles)
        grad = _array(grad_maps.contiguous()), _array(grad_alphas.contiguous())

        slots, counts = np.empty((BANDS, len(opacities)), np.int32), np.empty(BANDS, np.int64)
        run_bands(number_slots, BANDS, grid, slots, counts)
        firsts = np.cumsum(counts) - counts
        columns = MOMENTS + (features.shape[1] if wanted[3] else 0)
        rows = np.zeros((int(counts.sum()), columns), grad[0].dtype)
        forward = _array(background), _array(maps), _array(alphas), ctx.ends
        run_bands(differentiate_band, BANDS, splats, grid, forward, grad, slots, firsts, rows, any(wanted[:3]))

        grads = [torch.empty_like(value) for value in (means2d, conics, opacities, features)]
        run_bands(gather_band, BANDS, BANDS, splats, slots, firsts, rows, tuple(map(_array, grads)))
        behind = (grad_maps * (1 - alphas)[..., None]).sum((0, 1)) if wanted[4] else None
        return *(value if want else None for value, want in zip(grads, wanted, strict=False)), behind, None


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor's memory as numpy sees it."""
    return tensor.detach().numpy()


def _splats(means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor) -> Splats:
    """The Gaussians as arrays, with what `find_run` wants to know about their ellipses."""
    x, y = _array(means2d).astype(np.float64).T
    a, b, c = _array(conics).astype(np.float64).T
    with np.errstate(all="ignore"):  # what is no ellipse, or too faint, comes out as NaN, -inf or not positive
        reach = 2 * np.log(_array(opacities).astype(np.float64) / ALPHA_MIN)
        determinant = np.where((a > 0) & (c > 0), a * c - b * b, 0)
        lean = -b / np.sqrt(a * determinant)
    ellipses = np.stack([x, y, a, b, c, reach, determinant, lean], axis=1)
    slack = 8 * torch.finfo(means2d.dtype).eps
    return Splats(_array(means2d), _array(conics), _array(opacities), _array(features), ellipses, slack)


def _grid(tiles: Tiles) -> Grid:
    """The tiles, and bands of consecutive tiles with about as many pairs each (an empty tile costs something, too)."""
    rows, offsets = _array(tiles.rows), _array(tiles.offsets)
    cost = offsets + 4 * np.arange(len(offsets))
    bounds = np.searchsorted(cost, np.linspace(0, cost[-1], BANDS + 1)).astype(np.int64)
    bounds[0], bounds[-1] = 0, len(offsets) - 1
    return Grid(rows, offsets, bounds, tiles.width, tiles.height, tiles.tile_size)
