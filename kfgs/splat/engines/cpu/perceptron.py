"""The largest output of a perceptron (linear layers with ReLU between) for many rows, without writing the outputs.

Rows are handled 32 at a time, one lane each: neighbouring pixels have similar latents, so a unit that is 0 for one is
mostly 0 for all of them, and is left out of the next layer. In decoders of trained fields that is more than half of the
units. A layer's sums stay in registers, eight units at a time, and what a group of rows needs stays in cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .cache import cached_njit
from .memory import flat
from .simd import (
    LANES,
    add_outer,
    any_of,
    fetch,
    load,
    load_many,
    maximum,
    put,
    select,
    spread,
    spread_many,
    store,
    store_many,
    zero_many,
)
from .square import OPTIONS, aligned
from .threads import run_bands

TWO, EIGHT, SIXTEEN = (0,) * 2, (0,) * 8, (0,) * 16
UNITS, ROWS = len(EIGHT), len(TWO) * LANES
"""Units and rows whose sums are in registers together: 8 x 2 vectors."""

SHARE = 4096
"""Rows that a thread takes at once."""


@torch.no_grad()
def decide(
    layers: Sequence[tuple[Tensor, Tensor]],  # at least one: weight [out, in], bias [out]; the last has K outputs
    rows: Tensor,  # [N, in] float32 or float64 on the CPU
) -> tuple[Tensor, Tensor]:  # [N] int64, [N]
    """Which of K outputs is the largest, of equal ones the lowest, and how clearly: (largest - second) / largest.

    This lead is 0 where the largest output is not positive, and infinite if K is 1.
    """
    kind = rows.detach().numpy().dtype
    shapes, numbers, begin = [], [], 0
    for weight, bias in layers:
        out, into = weight.shape
        padded = -(-out // UNITS) * UNITS
        blocks, behind = np.zeros((padded, into), kind), np.zeros(padded, kind)
        blocks[:out], behind[:out] = weight.detach().numpy(), bias.detach().numpy()
        shapes.append((into, padded, begin, begin + padded * into))
        numbers += [blocks.reshape(-1, UNITS, into).transpose(0, 2, 1).ravel(), behind]
        begin += padded * (into + 1)
    table = np.array(shapes, np.int64)
    winners, leads = torch.empty(len(rows), dtype=torch.int64), rows.new_empty(len(rows))
    outs, results = len(layers[-1][1]), (winners.numpy(), leads.numpy())
    run_bands(_decide_band, -(-len(rows) // SHARE), table, np.concatenate(numbers), outs, flat(rows), results)
    return winners, leads


@cached_njit(**OPTIONS)
def _decide_band(
    band: int,
    table: Any,  # [L, 4], of each layer the inputs, the padded outputs, and where weights and biases begin
    numbers: Any,  # weights, UNITS outputs together as [in, UNITS], and biases
    outs: int,  # K
    rows: Any,  # [N * in]
    results: Any,  # outputs and leads [N], written
) -> None:
    """Decide the rows of one share."""
    winners, leads = results
    total, width = len(winners), table[0, 0]
    widest = max(table[:, 0].max(), table[:, 1].max())
    inputs, outputs = aligned(widest * ROWS, numbers), aligned(widest * ROWS, numbers)
    active = np.empty(widest, np.int64)
    for first in range(band * SHARE, min((band + 1) * SHARE, total), ROWS):
        for p in range(ROWS):
            row = min(first + p, total - 1)
            for i in range(width):
                put(inputs, i * ROWS + p, fetch(rows, row * width + i))
        for layer in range(len(table)):
            into, out, weights, biases = table[layer, 0], table[layer, 1], table[layer, 2], table[layer, 3]
            count, floor = 0, 0.0 if layer > 0 else -np.inf
            for i in range(into):
                x, y = maximum(load(inputs, i * ROWS), floor), maximum(load(inputs, i * ROWS + LANES), floor)
                store(inputs, i * ROWS, x)
                store(inputs, i * ROWS + LANES, y)
                put(active, count, i)
                if any_of((x > floor) | (y > floor)):
                    count += 1
            one = spread(numbers, 1)
            for unit in range(0, out, UNITS):
                begin = weights + unit * into
                sums = add_outer(zero_many(SIXTEEN, numbers), spread_many(EIGHT, numbers, biases + unit, 1), (one, one))
                for k in range(count):
                    i = fetch(active, k)
                    left = spread_many(EIGHT, numbers, begin + i * UNITS, 1)
                    sums = add_outer(sums, left, load_many(TWO, inputs, i * ROWS, LANES))
                store_many(outputs, unit * ROWS, LANES, sums)
            inputs, outputs = outputs, inputs
        for half in range(0, ROWS, LANES):
            best, second = spread(numbers, -np.inf), spread(numbers, -np.inf)
            which = spread(numbers, 0)
            for k in range(outs):
                value = load(inputs, k * ROWS + half)
                better = value > best
                second = maximum(second, select(better, best, value))
                best, which = select(better, value, best), select(better, k, which)
            lead = select(best > 0, (best - second) / best, 0)
            store(outputs, 0, which)
            store(outputs, LANES, lead)
            for p in range(min(LANES, total - first - half)):
                winners[first + half + p] = np.int64(outputs[p])
                leads[first + half + p] = outputs[LANES + p]
