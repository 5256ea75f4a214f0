"""Morton order: a curve through space, along which formats that compress neighbours together sort their Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._check import check_shapes

_BITS = 21  # per axis: three fill 63 bits of a code
_SPREAD = (  # (shift, mask): bit i of a 21-bit number goes to bit 3 i, in halves
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(
    means: Tensor,  # [N, 3]
) -> Tensor:  # [N] int64
    """The indices that sort positions by their Morton codes: neighbours in space become neighbours in the file.

    A code interleaves 21 bits each of x, y and z, scaled to the cloud's bounds (Morton 1966), with x in the lowest bit.
    Equal codes keep their order, so a sorted cloud does not change.

    Raises:
        ValueError: if a position is not finite.

    Example:
        >>> morton_order(torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])).tolist()
        [3, 2, 1, 0]
    """
    check_shapes(("means", means, "N 3"))
    if not len(means):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    points = means.detach().double().cpu().numpy()
    if not np.isfinite(points).all():
        row = int((~np.isfinite(points)).any(1).argmax())
        raise ValueError(f"means: expected finite positions, got {points[row].tolist()} at {row}; remove it first")
    low = points.min(0)
    size = np.maximum(points.max(0) - low, np.finfo(np.float64).tiny)  # an axis without extent: all 0
    cells = ((points - low) / size * (2**_BITS - 1)).astype(np.uint64)
    return torch.from_numpy(np.argsort(morton_codes(cells), kind="stable").astype(np.int64)).to(means.device)


def morton_codes(
    cells: NDArray[np.uint64],  # [N, 3] below 2^21
) -> NDArray[np.uint64]:  # [N]
    """Interleave the bits of x, y and z, with x in the lowest bit."""
    x, y, z = (_spread(cells[:, axis]) << np.uint64(axis) for axis in range(3))
    return x | y | z


def morton_cells(
    codes: NDArray[np.uint64],  # [N]
) -> NDArray[np.uint64]:  # [N, 3]
    """The inverse of `morton_codes`; the highest bit is ignored."""
    return np.stack([_gather(codes >> np.uint64(axis)) for axis in range(3)], axis=1)


def _spread(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:  # [N] of 21 bits -> [N] of 63
    """Put two zeros before every bit."""
    for shift, mask in _SPREAD:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits


def _gather(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:  # [N] of 63 -> [N] of 21 bits
    """Keep every third bit."""
    masks = [(1 << _BITS) - 1, *(mask for _, mask in _SPREAD)]
    bits = bits & np.uint64(masks[-1])
    for (shift, _), mask in zip(_SPREAD[::-1], masks[-2::-1], strict=True):
        bits = (bits | bits >> np.uint64(shift)) & np.uint64(mask)
    return bits
