"""How values become few bits: smallest-three rotations, Morton order, codebooks of 256 numbers and palettes of rows."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..quant.codebook import nearest_rows
from .values import unit_quats

CODES = 256  # numbers in a codebook: an index is one byte
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the other components, by the index of the largest
_BITS = 21  # per axis: three fill 63 bits of a Morton code
_SPREAD = (  # (shift, mask): bit i of a 21-bit number goes to bit 3 i, in halves
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip
_PASSES = 10  # of Lloyd's algorithm on the line
_EVEN = 64  # numbers that start evenly spaced over the whole range, so that outliers get some
_BINS = 512  # of the density of values
_ROW_PASSES = 4  # for rows; 10 lower the error by 1 % and take 3 times as long (100,000 rows of 45, palette 65,536)


def pack_smallest_three(
    quats: Tensor,  # [N, 4] wxyz, of any length
    steps: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # [N, 1] in 0..3, [N, 3] in 0..steps
    """The index of the largest component in (w, x, y, z), and the others in whole steps from -1/sqrt(2) to 1/sqrt(2).

    A quaternion of length 0 is the identity. Of equally large components the first is the largest.
    """
    largest, small = split_largest(unit_quats(quats.detach().cpu().double()).numpy())
    whole = np.clip(np.round((small * math.sqrt(0.5) + 0.5) * steps), 0, steps).astype(np.int64)
    return largest[:, None], whole


def unpack_smallest_three(
    largest: NDArray[np.int64],  # [N] in 0..3
    small: NDArray[np.float32],  # [N, 3] in 0..steps
    steps: int,
) -> Tensor:  # [N, 4] wxyz float32, of length 1
    """The inverse of `pack_smallest_three`."""
    parts = (small / np.float32(steps) - np.float32(0.5)) * np.float32(math.sqrt(2))
    return torch.from_numpy(join_largest(largest, parts))


def split_largest(
    quats: NDArray[np.float64],  # [N, 4] of length 1, in any order of components
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # [N] in 0..3, [N, 3]
    """The index of the largest component, and the other three in order, with the sign that makes the largest positive."""
    largest = np.abs(quats).argmax(1).astype(np.int64)
    rows = np.arange(len(quats))
    return largest, quats[rows[:, None], _OTHERS[largest]] * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]


def join_largest(
    largest: NDArray[np.int64],  # [N] in 0..3
    small: NDArray[np.float32],  # [N, 3]
) -> NDArray[np.float32]:  # [N, 4]
    """The inverse of `split_largest`; if the three components are longer than 1 together, they are shortened."""
    squares = (small**2).sum(1, keepdims=True)
    quats = np.empty((len(small), 4), np.float32)
    rows = np.arange(len(small))
    quats[rows[:, None], _OTHERS[largest]] = small / np.sqrt(np.maximum(squares, 1))
    quats[rows, largest] = np.sqrt(np.maximum(0, 1 - squares[:, 0]))
    return quats


def morton_order(means: Tensor) -> Tensor:  # [N, 3] finite -> [N] int64
    """The indices that sort positions by their Morton codes: neighbours in space become neighbours in the file.

    A code interleaves 21 bits each of x, y and z, scaled to the cloud's bounds (Morton 1966), with x in the lowest bit.
    Equal codes keep their order, so a sorted cloud does not change.
    """
    if not len(means):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    points = means.detach().double().cpu().numpy()
    low = points.min(0)
    size = np.maximum(points.max(0) - low, np.finfo(np.float64).tiny)  # an axis without extent: all 0
    cells = ((points - low) / size * (2**_BITS - 1)).astype(np.uint64)
    return torch.from_numpy(np.argsort(morton_codes(cells), kind="stable").astype(np.int64)).to(means.device)


def morton_codes(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:  # [N, 3] below 2^21 -> [N]
    """Interleave the bits of x, y and z, with x in the lowest bit."""
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in _SPREAD:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def morton_cells(codes: NDArray[np.uint64]) -> NDArray[np.uint64]:  # [N] -> [N, 3]
    """The inverse of `morton_codes`; the highest bit is ignored."""
    masks = [(1 << _BITS) - 1, *(mask for _, mask in _SPREAD)]
    bits = np.stack([codes >> np.uint64(axis) for axis in range(3)], axis=1) & np.uint64(masks[-1])
    for (shift, _), mask in zip(_SPREAD[::-1], masks[-2::-1], strict=True):
        bits = (bits | bits >> np.uint64(shift)) & np.uint64(mask)
    return bits


def fit_codebook(values: NDArray[np.float64]) -> NDArray[np.float32]:  # [N] -> [256], ascending
    """Choose 256 numbers that represent all values: Lloyd's algorithm on the line, exact in each pass.

    Three in four start spaced by the cube root of the density, which is best for many numbers (Panter and Dite 1951), the
    others evenly. Up to 256 different values are kept exactly.
    """
    ordered = np.sort(values.ravel())
    different = np.unique(ordered.astype(np.float32))
    if len(different) <= CODES:
        different = different if len(different) else np.zeros(1, np.float32)
        return np.concatenate([different, np.full(CODES - len(different), different[-1])]).astype(np.float32)
    counts, edges = np.histogram(ordered, bins=_BINS)
    filled = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    n = CODES - _EVEN
    dense = np.interp((np.arange(n) + 0.5) / n * filled[-1], filled, edges)
    centers = np.sort(np.concatenate([dense, np.linspace(ordered[0], ordered[-1], _EVEN)]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_PASSES):
        ends = np.concatenate([[0], np.searchsorted(ordered, (centers[1:] + centers[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        centers = np.sort(np.where(counts > 0, means, centers))
    return centers.astype(np.float32)


def nearest_codes(
    codebook: NDArray[np.float32],  # [256], ascending
    values: NDArray[np.float64],  # [...]
) -> NDArray[np.uint8]:  # [...]
    """The index of the number nearest to each value; ties go to the smaller number."""
    middles = (codebook[1:].astype(np.float64) + codebook[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def fit_palette(rows: Tensor, size: int) -> tuple[Tensor, Tensor]:  # [N, D] -> [K, D], [N] int64 into these K
    """Choose at most `size` rows that represent all rows, by k-means in two levels without random numbers.

    The rows are divided into about sqrt(size) groups, and each group gets a share of the palette in proportion to its
    rows: 2 N sqrt(size) distances instead of N size. Starting rows are evenly spaced, so similar rows should be neighbours.
    """
    if len(rows) <= size:
        return rows, torch.arange(len(rows))
    _, groups = _fit_means(rows, max(1, round(math.sqrt(size))))
    counts = torch.bincount(groups)
    filled = int((counts > 0).sum())  # each group with rows gets at least one of the palette's
    shares = torch.minimum(counts * (size - filled) // len(rows) + (counts > 0), counts).tolist()
    labels = torch.empty(len(rows), dtype=torch.int64)
    parts: list[Tensor] = []
    for members, share in zip(torch.argsort(groups, stable=True).split(counts.tolist()), shares, strict=True):
        if len(members):
            part, nearest = _fit_means(rows[members], share)
            labels[members] = nearest + sum(map(len, parts))
            parts.append(part)
    return torch.cat(parts), labels


def _fit_means(rows: Tensor, size: int) -> tuple[Tensor, Tensor]:  # [K, D], [N] int64
    """Lloyd's algorithm from evenly spaced rows; a mean without rows stays."""
    if len(rows) <= size:
        return rows, torch.arange(len(rows))
    means = rows[torch.arange(size) * len(rows) // size].clone()
    for _ in range(_ROW_PASSES):
        labels = nearest_rows(rows, means, euclidean=True)[0]
        counts = torch.bincount(labels, minlength=size)
        sums = torch.zeros_like(means).index_add_(0, labels, rows)
        means = torch.where(counts[:, None] > 0, sums / counts.clamp(min=1)[:, None], means)
    return means, nearest_rows(rows, means, euclidean=True)[0]
