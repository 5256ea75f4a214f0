"""The CPU engine: kernels compiled by numba, with their own backward passes. README.md explains its parts."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..contract import CompiledEngine, Ranked, Splats, Tiles
from . import square, wide
from .bands import Trace, accumulate_band, composite_band
from .bands_backward import differentiate_band
from .memory import flat, take_memory
from .narrow import MOMENTS, MOST_CHANNELS, Passes, plan_passes
from .project import project
from .ranks import find_candidates, rank_band
from .shade import shade
from .simd import LANES
from .slots import chain_slots, gather_gradients, gather_sums, number_slots
from .square import SQUARE_SIDE, Rows, View, pack_rows
from .threads import run_bands
from .tiles import bin

row_length, padded_length = square.row_length.py_func, wide.padded_length.py_func  # a call is not worth compiling

MOST_BANDS, PAIRS_PER_BAND = 32, 2048
"""The most bands, and the fewest pairs of a band. More bands keep more threads busy, but give more Gaussians a gradient row
in several bands."""


class Traced(NamedTuple):
    """What `forward` returns, and keeps for `backward`."""

    maps: Tensor  # [H, W, D]
    alphas: Tensor  # [H, W]
    packed: Tensor  # the packed Gaussians
    finals: Tensor  # [H, W], and the rest of `bands.Trace`
    seen: Tensor
    drawn: Tensor


class NumbaEngine(CompiledEngine):
    """The engine that `kfgs.splat` takes on a CPU."""

    devices = ("cpu",)
    projects = True
    project, shade, bin = staticmethod(project), staticmethod(shade), staticmethod(bin)  # type: ignore[assignment]

    def forward(self, splats: Splats, tiles: Tiles) -> Traced:
        view, channels = _view(tiles), splats.features.shape[1]
        size, squares, whole = (view.height, view.width), view.across**2, torch.empty(0, dtype=torch.int32)
        maps, finals = take_memory(splats.features, *size, channels), take_memory(splats.features, *size)
        seen = whole.new_zeros(squares * (len(view.offsets) - 1))
        drawn, alphas = take_memory(whole, squares * len(view.order)), torch.empty_like(finals)
        rows = _pack(splats, view)
        shared = view, rows, *_channels_plan(splats), _padded(splats.background)
        traces = Trace(flat(finals), flat(seen), flat(drawn))
        run_bands(composite_band, len(view.bounds) - 1, *shared, flat(maps), flat(alphas), traces)
        return Traced(maps, alphas, torch.from_numpy(rows.values), finals, seen, drawn)

    def backward(
        self, grads: tuple[Tensor, Tensor], wanted: list[bool], splats: Splats, tiles: Tiles, result: Traced
    ) -> list[Tensor | None]:
        view, channels = _view(tiles), splats.features.shape[1]
        bands, M = len(view.bounds) - 1, len(splats.means2d)
        slots, firsts, total, chains = _number(view, M)
        rows = Rows(flat(result.packed), row_length(_packed(channels)), view.order)
        passes, source = _channels_plan(splats)
        length, column = (rows.length, MOMENTS) if passes else (LANES + padded_length(channels), LANES)
        out = take_memory(splats.means2d, total * length).numpy()
        images, traces = (flat(result.maps), flat(grads[0]), flat(grads[1])), Trace(*map(flat, result[3:]))
        shared = view, rows, passes, source, _padded(splats.background), images, traces, slots, firsts, out
        run_bands(differentiate_band, bands, *shared, any(wanted[:3]))
        results: list[Tensor | None] = [torch.empty_like(value) for value in splats[:3]]
        results.append(torch.zeros_like(splats.features))
        index, targets = _index(splats), tuple(flat(value) for value in results if value is not None)
        shares = bands if bool((index[1:] > index[:-1]).all()) else 1  # two Gaussians that show one row must not meet
        layout, values = (length, column, channels), (flat(splats.conics), flat(splats.opacities))
        run_bands(gather_gradients, shares, shares, values, chains, out, layout, index, targets)
        results.append((grads[0] * result.finals[..., None]).sum((0, 1)) if wanted[4] else None)
        return [value if want else None for value, want in zip(results, wanted, strict=True)]

    def accumulate(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, tiles: Tiles
    ) -> tuple[Tensor, Tensor]:
        channels, view = pixels.shape[2], _view(tiles)
        bands, M = len(view.bounds) - 1, len(means2d)
        slots, firsts, total, chains = _number(view, M)
        none = means2d.new_empty(M, 0)
        rows = _pack(Splats(means2d, conics, opacities, none, means2d.new_empty(0), None), view)
        length = padded_length(channels + 1)
        out = take_memory(pixels, total * length).numpy()
        run_bands(accumulate_band, bands, view, rows, flat(pixels), channels, slots, firsts, out)
        sums, weights = pixels.new_empty(M, channels), pixels.new_empty(M)
        run_bands(gather_sums, bands, bands, chains, out, length, sums.numpy(), weights.numpy())
        return sums, weights

    def rank(self, splats: Splats, tiles: Tiles, top: int, early: bool) -> Ranked:
        features, channels, view = splats.features, splats.features.shape[1], _view(tiles)
        bands, size = len(view.bounds) - 1, (view.height, view.width)
        labels = take_memory(torch.empty(0, dtype=torch.int64), *size, top)
        scores, alphas = take_memory(features, *size, top), take_memory(features, *size)
        rows = _pack(splats, view)
        passes, source = _channels_plan(splats)
        few = len(splats.means2d) if top == 1 and passes else 0
        candidates = np.empty(few, np.uint64), flat(features.new_empty(2 * few))
        run_bands(find_candidates, bands, bands, flat(features), channels, _index(splats), *candidates)
        shared = view, rows, passes, source, channels, candidates, early
        run_bands(rank_band, bands, *shared, (flat(labels), flat(scores), flat(alphas)))
        return Ranked(labels, scores, alphas)


ENGINE = NumbaEngine()


def _packed(channels: int) -> int:
    """How many channels are packed with their Gaussian."""
    return channels if channels <= MOST_CHANNELS else 0


def _pack(splats: Splats, view: View) -> Rows:
    channels, bands = _packed(splats.features.shape[1]), len(view.bounds) - 1
    length = row_length(channels)
    packed = take_memory(splats.means2d, len(splats.means2d) * length).numpy()
    footprints = flat(splats.means2d), flat(splats.conics), flat(splats.opacities)
    run_bands(pack_rows, bands, bands, footprints, flat(splats.features), channels, _index(splats), packed)
    return Rows(packed, length, view.order)


def _channels_plan(splats: Splats) -> tuple[Passes | None, wide.Source | None]:
    """How few channels are cut, or where many channels lie."""
    channels = splats.features.shape[1]
    if channels <= MOST_CHANNELS:
        return plan_passes(channels), None
    shown = _index(splats) if splats.index is not None else np.arange(len(splats.means2d))
    return None, wide.Source(flat(splats.features), shown * channels, channels)


def _index(splats: Splats) -> np.ndarray:
    return np.empty(0, np.int64) if splats.index is None else splats.index.numpy()


def _padded(background: Tensor) -> np.ndarray:
    """The background and zeros up to a whole vector."""
    out = np.zeros(padded_length(len(background)), flat(background).dtype)
    out[: len(background)] = flat(background)
    return out


def _view(tiles: Tiles) -> View:
    """The tiles, and bands of consecutive tiles with about equally many pairs (an empty tile has a cost too)."""
    rows, offsets, width, height, tile_size = tiles
    ends = offsets.numpy().astype(np.int64, copy=False)
    cost = ends + 4 * np.arange(len(ends))
    bands = min(MOST_BANDS, 1 + int(cost[-1]) // PAIRS_PER_BAND)
    bounds = np.searchsorted(cost, np.linspace(0, cost[-1], bands + 1)).astype(np.int64)
    bounds[0], bounds[-1] = 0, len(ends) - 1
    across = -(-min(tile_size, max(width, height)) // SQUARE_SIDE)
    return View(rows.numpy().astype(np.int32, copy=False), ends, bounds, width, height, tile_size, across)


def _number(view: View, count: int) -> tuple[np.ndarray, np.ndarray, int, Any]:
    """Number the slots: of each pair in its band, the first of each band, how many, and each Gaussian's chain of slots."""
    slots, owners = np.empty(len(view.order), np.int32), np.empty(len(view.order), np.int32)
    counts = np.empty(len(view.bounds) - 1, np.int64)
    run_bands(number_slots, len(counts), view, slots, owners, counts, count)
    total = int(counts.sum())
    chains = np.empty(count, np.int32), np.empty(total, np.int32)
    chain_slots(view, owners, counts, *chains)
    return slots, np.concatenate([[0], np.cumsum(counts)]), total, chains
