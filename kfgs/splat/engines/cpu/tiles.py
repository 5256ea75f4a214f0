"""Find which Gaussians touch which tile, compiled by numba. It sorts the Gaussians by depth, and never the pairs.

Gaussians are taken front to back in bands. A band lists the (tile, Gaussian) pairs that touch, and counts them by tile.
Then every band knows where its part of each tile's list begins, and copies its pairs there. The lists equal those of the
torch code in `kfgs.splat.tiles`: the arithmetic is the same, in the same order, without fused multiply-adds.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .threads import find_reach, run_bands
from .tiles_kernels import find_pairs, list_rows, sort_keys

_SHARE = 8192
"""Gaussians of a band: few, so that all threads end together, but many compared with the tiles' counters."""


@torch.no_grad()
def bin(
    means2d: Tensor,  # [M, 2]
    conics: Tensor,  # [M, 3]
    depths: Tensor,  # [M]
    opacities: Tensor,  # [M]
    extents: Tensor,  # [M, 2]
    *,
    size: tuple[int, int, int],  # width, height, tile size
) -> tuple[Tensor, Tensor]:  # rows [P] int32, offsets [T + 1] int64
    """List the Gaussians of every tile, as `kfgs.splat.bin_tiles` says."""
    width, height, tile_size = size
    M, tiles = len(depths), -(-width // tile_size) * -(-height // tile_size)
    bands = max(1, -(-M // _SHARE))
    values = (value.detach().view(-1).numpy() for value in (means2d, conics, extents))
    splats = *values, find_reach(opacities)
    eps = float(torch.finfo(means2d.dtype).eps)
    order, counts = depth_order(depths), np.zeros((bands, tiles), np.int32)
    pairs: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def find(band: int) -> None:
        pairs[band] = find_pairs(band, bands, order, splats, eps, size, counts[band])

    run_bands(find, bands)
    offsets = np.zeros(tiles + 1, np.int64)
    np.cumsum(counts.sum(axis=0, dtype=np.int64), out=offsets[1:])
    starts = np.cumsum(counts, axis=0, dtype=np.int64) - counts + offsets[:-1]
    rows = np.empty(int(offsets[-1]), np.int32)
    run_bands(lambda band: list_rows(*pairs[band], starts[band], rows), bands)
    return torch.from_numpy(rows), torch.from_numpy(offsets)


def depth_order(depths: Tensor) -> np.ndarray:  # [M] -> [M] int32
    """The rows by depth; equal depths by row. NaN comes last, as torch sorts.

    The bits of float32 numbers that are not negative are in the numbers' order: they are sorted digit by digit.
    """
    values = depths.detach()
    if values.dtype == torch.float32 and not bool((values < 0).any()):
        return sort_keys(values.abs().numpy().view(np.uint32))  # -0 is 0
    return torch.sort(values, stable=True).indices.numpy().astype(np.int32)
