"""Slots: each band sums gradients into its own rows, one per Gaussian that it meets. Later each Gaussian's rows are summed.

A band is a strip of neighbouring tiles, so there are few more rows than visible Gaussians.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .cache import cached_njit, inner_njit
from .simd import LANES, fetch, lanes_below, load, load_part, prefetch, put, store, store_part
from .square import PREFETCH_AHEAD, View, aligned


@cached_njit()
def number_slots(
    band: int,
    view: View,
    slots: Any,  # [P], written: the number of each pair's Gaussian
    owners: Any,  # [P], written from the band's first pair on: the Gaussian of each number
    counts: Any,  # [B], written: how many there are
    total: int,  # M
) -> None:
    """Number the distinct Gaussians of one band, in order of appearance."""
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


@cached_njit()
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


@inner_njit(forceinline=True)
def _sum_chain(row: int, following: Any, out: Any, width: int, total: Any) -> None:
    """Total = sum of the rows of one Gaussian; zeros if it has none."""
    for i in range(0, width, LANES):
        store(total, i, 0)
    while row >= 0:
        for i in range(0, width, LANES):
            store(total, i, load(total, i) + load(out, row * width + i))
        row = following[row]


@cached_njit()
def gather_gradients(
    band: int,
    bands: int,  # one if two Gaussians may show the same row of features
    splats: Any,  # conics [M * 3] and opacities [M]
    chains: Any,  # heads and following, from `chain_slots`
    out: Any,  # gradient rows
    layout: tuple[int, int, int],  # length of a gradient row, the column where the features begin, and D
    index: Any,  # [M], the features' row of each Gaussian; empty if row m belongs to Gaussian m
    grads: Any,  # of means2d [M * 2], conics [M * 3] and opacities [M], written; of features [N * D], added to
) -> None:
    """Sum all rows of each Gaussian of one share, and turn moments into gradients.

    The power of the density is -0.5 (a dx^2 + 2 b dx dy + c dy^2) with d = pixel - mean, and v its slope.
    """
    conics, opacities = splats
    heads, following = chains
    width, column, channels = layout
    of_means, of_conics, of_opacities, of_features = grads
    count = len(heads)
    total = aligned(width, out)
    half = out.dtype.type(0.5)
    for m in range(count * band // bands, count * (band + 1) // bands):
        prefetch(out, np.int64(heads[min(m + PREFETCH_AHEAD, count - 1)]) * width)
        _sum_chain(heads[m], following, out, width, total)
        a, b, c = fetch(conics, 3 * m), fetch(conics, 3 * m + 1), fetch(conics, 3 * m + 2)
        v, v_x, v_y = fetch(total, 0), fetch(total, 1), fetch(total, 2)
        drawn = v_x != 0 or v_y != 0  # a conic that is not finite draws nothing; its gradient is 0
        put(of_means, 2 * m, a * v_x + b * v_y if drawn else v_x)
        put(of_means, 2 * m + 1, b * v_x + c * v_y if drawn else v_y)
        put(of_conics, 3 * m, -half * fetch(total, 3))
        put(of_conics, 3 * m + 1, -fetch(total, 4))
        put(of_conics, 3 * m + 2, -half * fetch(total, 5))
        put(of_opacities, m, v / fetch(opacities, m) if v != 0 else v)
        into = (fetch(index, m) if len(index) else m) * channels
        for i in range(0, channels, LANES):
            lanes = lanes_below(out, channels - i)
            value = load_part(total, column + i, lanes)
            store_part(of_features, into + i, lanes, load_part(of_features, into + i, lanes) + value)


@cached_njit()
def gather_sums(band: int, bands: int, chains: Any, out: Any, width: int, sums: Any, weights: Any) -> None:
    """Sum all rows of each Gaussian of one share: sums [M, D] and weights [M], written."""
    heads, following = chains
    count, channels = len(heads), sums.shape[1]
    total = aligned(width, out)
    for m in range(count * band // bands, count * (band + 1) // bands):
        prefetch(out, np.int64(heads[min(m + PREFETCH_AHEAD, count - 1)]) * width)
        _sum_chain(heads[m], following, out, width, total)
        for i in range(channels):
            sums[m, i] = total[i]
        weights[m] = total[channels]
