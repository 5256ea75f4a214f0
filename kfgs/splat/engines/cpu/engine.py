"""The CPU engine: compositing compiled by numba, with its own backward pass. README.md explains its parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contract import Composited, Ranked, Splats, Tiles
from . import square, wide
from .absolute import absolute
from .bands import accumulate_band, composite_narrow, composite_wide
from .bands_backward import differentiate_narrow, differentiate_wide
from .memory import take_memory
from .narrow import FIRST, MOMENTS, plan_passes
from .perceptron import decide
from .project import project, project_backward
from .ranks import find_candidates, rank_narrow, rank_wide
from .shade import shade, shade_backward
from .simd import LANES
from .slots import chain_slots, gather_gradients, gather_sums, number_slots
from .square import SQUARE_SIDE, View, pack_rows
from .ssim import similarity
from .threads import run_bands
from .tiles import bin

row_length, padded_length = square.row_length.py_func, wide.padded_length.py_func  # one call is not worth compiling

__all__ = [
    "absolute",
    "accumulate",
    "backward",
    "bin",
    "decide",
    "devices",
    "forward",
    "project",
    "project_backward",
    "rank",
    "shade",
    "shade_backward",
    "similarity",
]

MOST_BANDS, PAIRS_PER_BAND = 32, 2048
"""The most bands, and the fewest pairs of a band. More bands keep more threads busy, but give more Gaussians a gradient row
in several bands."""

NARROW_CHANNELS = len(FIRST) + LANES
"""The most channels that are summed in registers, one vector each; more are multiplied as small matrices."""


DTYPES = torch.float32, torch.float64


def devices() -> tuple[str, ...]:
    """Where the engine runs."""
    return ("cpu",)


def forward(splats: Splats, tiles: Tiles) -> Composited:
    """Composite as the contract says."""
    means2d, conics, opacities, features, background, index = splats
    channels, view = features.shape[1], _view(tiles)
    bands = len(view.bounds) - 1
    maps = take_memory(features, view.height, view.width, channels)
    alphas = features.new_empty(view.height, view.width)
    trace, packed, finals, ends = _make_trace(view, means2d, channels)
    ends[: view.across**2 * (len(view.offsets) - 1)] = 0
    footprints = _flat(means2d), _flat(conics), _flat(opacities)
    run_bands(pack_rows, bands, bands, footprints, _flat(features), _packed(channels), _index(index), packed)
    images, length = (_flat(maps), _flat(alphas), finals), row_length(_packed(channels))
    behind = _padded(background, padded_length(channels))
    if channels <= NARROW_CHANNELS:
        passes = plan_passes(channels)
        run_bands(composite_narrow, bands, view, packed, length, passes, behind, images, ends)
    else:
        shared = (view, packed, length, _flat(features), _begins(index, len(means2d), channels), behind, images, ends)
        run_bands(composite_wide, bands, *shared)
    return Composited(maps, alphas, trace)


def backward(
    grads: Sequence[Tensor], wanted: Sequence[bool], splats: Splats, tiles: Tiles, result: Composited
) -> list[Tensor]:
    """Gradients as the contract says, given those in the maps and in the alphas."""
    means2d, conics, opacities, features, background, index = splats
    channels, view = features.shape[1], _view(tiles)
    bands = len(view.bounds) - 1
    slots, firsts, total, chains = _number(view, len(means2d))
    packed, finals, ends = _read_trace(result.trace, view, means2d, channels)
    images = _flat(result.maps), _flat(grads[0]), finals, _flat(grads[1])
    length, behind = row_length(_packed(channels)), _padded(background, padded_length(channels))
    row, column = (length, MOMENTS) if channels <= NARROW_CHANNELS else (LANES + padded_length(channels), LANES)
    out = take_memory(means2d, total * row).numpy()
    if channels <= NARROW_CHANNELS:
        passes = plan_passes(channels)
        run_bands(differentiate_narrow, bands, view, packed, length, passes, behind, images, ends, slots, firsts, out)
    else:
        source = _flat(features), _begins(index, len(means2d), channels), channels
        shared = (view, packed, length, source, behind, images, ends, slots, firsts, out, any(wanted[:3]))
        run_bands(differentiate_wide, bands, *shared)
    found = [*(torch.empty_like(value) for value in splats[:3]), torch.zeros_like(features)]
    which, layout = _index(index), (row, column, channels)
    shares = bands if _increasing(which) else 1  # two Gaussians that show the same row must not meet
    values, targets = (_flat(conics), _flat(opacities)), tuple(_flat(value) for value in found)
    run_bands(gather_gradients, shares, shares, values, chains, out, layout, which, targets)
    light = torch.from_numpy(finals).view_as(result.alphas)[..., None]
    found.append((grads[0] * light).sum((0, 1)) if wanted[4] else background)
    return [value if want else value.new_empty(0) for value, want in zip(found, wanted, strict=True)]


def accumulate(
    means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor, tiles: Tiles
) -> tuple[Tensor, Tensor]:  # sums [M, D], weights [M]
    """Sum pixels into the Gaussians by compositing weight, in one walk."""
    channels, view = pixels.shape[2], _view(tiles)
    bands = len(view.bounds) - 1
    slots, firsts, total, chains = _number(view, len(means2d))
    packed = torch.empty(len(means2d) * row_length(0), dtype=pixels.dtype).numpy()
    splats = _flat(means2d), _flat(conics), _flat(opacities)
    run_bands(pack_rows, bands, bands, splats, packed[:0], 0, _index(None), packed)
    length = padded_length(channels + 1)
    out = take_memory(pixels, total * length).numpy()
    shared = (view, packed, row_length(0), _flat(pixels), channels, slots, firsts, out)
    run_bands(accumulate_band, bands, *shared)
    sums, weights = pixels.new_empty(len(means2d), channels), pixels.new_empty(len(means2d))
    run_bands(gather_sums, bands, bands, chains, out, length, sums.numpy(), weights.numpy())
    return sums, weights


def rank(splats: Splats, tiles: Tiles, top: int, early: bool) -> Ranked:
    """The best channels of each pixel, as the contract says."""
    means2d, conics, opacities, features, _, index = splats
    channels, view = features.shape[1], _view(tiles)
    bands = len(view.bounds) - 1
    size = view.height, view.width
    labels = take_memory(torch.empty(0, dtype=torch.int64), *size, top)
    scores, alphas = take_memory(features, *size, top), take_memory(features, *size)
    length = row_length(_packed(channels))
    packed = take_memory(means2d, len(means2d) * length).numpy()
    footprints = _flat(means2d), _flat(conics), _flat(opacities)
    run_bands(pack_rows, bands, bands, footprints, _flat(features), _packed(channels), _index(index), packed)
    images = _flat(labels), _flat(scores), _flat(alphas)
    if channels <= NARROW_CHANNELS:
        some = len(means2d) if top == 1 else 0
        contest = np.empty(some, np.uint64), _flat(features.new_empty(2 * some))
        run_bands(find_candidates, bands, bands, _flat(features), channels, _index(index), *contest)
        shared = (view, packed, length, plan_passes(channels), channels, contest, early, images)
        run_bands(rank_narrow, bands, *shared)
    else:
        begins = _begins(index, len(means2d), channels)
        run_bands(rank_wide, bands, view, packed, length, _flat(features), begins, channels, images)
    return Ranked(labels, scores, alphas)


def _flat(tensor: Tensor) -> np.ndarray:
    """The tensor's memory as numpy sees it, in one dimension."""
    return tensor.detach().contiguous().view(-1).numpy()


def _packed(channels: int) -> int:
    """How many channels are packed with their Gaussian."""
    return channels if channels <= NARROW_CHANNELS else 0


def _make_trace(view: View, like: Tensor, channels: int) -> tuple[Tensor, np.ndarray, np.ndarray, np.ndarray]:
    """One int32 tensor with what the backward pass needs from the forward pass, and its parts.

    First the packed Gaussians, on whole cache lines. Then the transmittance of each pixel (1 - alpha would keep few digits of
    it). Then, for each tile and square, how many Gaussians were looked at, and in which blocks each was drawn.
    """
    squares = view.across**2
    numbers = sum(_floats(view, like, channels)) * like.element_size() // 4
    length = numbers + squares * (len(view.offsets) - 1 + len(view.order))
    trace = take_memory(torch.empty(0, dtype=torch.int32), length)
    return trace, *_read_trace(trace, view, like, channels)


def _read_trace(trace: Tensor, view: View, like: Tensor, channels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The packed Gaussians, the transmittances and the rest of a trace."""
    packed, pixels = _floats(view, like, channels)
    numbers = (packed + pixels) * like.element_size() // 4
    floats = trace.numpy()[:numbers].view(like.detach().numpy().dtype)
    return floats[:packed], floats[packed:], trace.numpy()[numbers:]


def _floats(view: View, like: Tensor, channels: int) -> tuple[int, int]:
    """How many numbers of the data's type are in a trace: packed Gaussians, and pixels."""
    return len(like) * row_length(_packed(channels)), view.width * view.height


def _index(index: Tensor | None) -> np.ndarray:
    return np.empty(0, np.int64) if index is None else index.numpy()


def _increasing(index: np.ndarray) -> bool:
    return bool((index[1:] > index[:-1]).all())


def _begins(index: Tensor | None, count: int, channels: int) -> np.ndarray:
    """Where each Gaussian's row of features begins, [M] int64."""
    return channels * (np.arange(count) if index is None else index.numpy())


def _padded(background: Tensor, channels: int) -> np.ndarray:
    behind = np.zeros(channels, background.detach().numpy().dtype)
    behind[: len(background)] = background.detach().numpy()
    return behind


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
