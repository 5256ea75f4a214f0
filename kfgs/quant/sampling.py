"""Feature maps on disk or in memory, read a part at a time: a regular grid of pixels, or a few rows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from torch import Tensor

from .._check import as_tensor, check_range, check_shapes
from .._rows import EPS

SAMPLES = 28_800  # rows 1::2 and columns 1::3 of a 360 x 480 map, as in the paper's experiments


class FeatureMaps(Protocol):
    """Feature maps of many images, one in memory at a time; a list of tensors is enough.

    Maps on disk may have two more members, so that less is read or in memory: `grid(i, samples)`, equal to
    `sample_grid(maps[i], samples=samples)`; and `blocks(i)`, the map a few rows at a time.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        ...


def read_blocks(maps: FeatureMaps, i: int) -> Iterator[Tensor]:  # each [at most 32, w, D]
    """A map, a few rows at a time: from `maps.blocks(i)` if there is such a member."""
    blocks = getattr(maps, "blocks", None)
    yield from as_tensor(f"maps[{i}]", maps[i]).split(32) if blocks is None else blocks(i)


def read_grid(maps: FeatureMaps, i: int, samples: int) -> Tensor:  # [n, D]
    """At most `samples` features of a map on the finest grid: from `maps.grid` if there is such a member."""
    grid = getattr(maps, "grid", None)
    if grid is not None:
        return grid(i, samples)  # type: ignore[no-any-return]
    feature_map = as_tensor(f"maps[{i}]", maps[i])
    check_shapes((f"maps[{i}]", feature_map, "h w D"))
    return sample_grid(feature_map, samples=samples)


def grid_slices(height: int, width: int, samples: int = SAMPLES) -> tuple[slice, slice]:
    """The rows and columns of a map that `sample_grid` uses, so that only these are read from disk.

    Example:
        >>> grid_slices(360, 480), grid_slices(90, 120)
        ((slice(1, 360, 2), slice(1, 480, 3)), (slice(0, 90, 1), slice(0, 120, 1)))
    """
    check_range("samples", samples, 1)
    down, right = 1, 1
    while True:
        rows, columns = (slice(min(n // 2, max(size - 1, 0)), size, n) for size, n in ((height, down), (width, right)))
        if len(range(height)[rows]) * len(range(width)[columns]) <= samples:
            return rows, columns
        down, right = (down, right + 1) if down == right else (down + 1, right)


def sample_grid(feature_map: Tensor, *, samples: int = SAMPLES) -> Tensor:  # [h, w, D] -> [n, D]
    """At most `samples` features on the finest regular grid of pixels, row by row: every N-th row and column, from N // 2.

    The steps of rows and columns grow in turn, columns first: (1, 1), (1, 2), (2, 2), (2, 3), ... A step of (2, 3) takes rows
    1::2 and columns 1::3.
    """
    sizes = check_shapes(("feature_map", feature_map, "h w D"))
    rows, columns = grid_slices(sizes["h"], sizes["w"], samples)
    return feature_map[rows, columns].reshape(-1, sizes["D"])


def all_zero(n: int) -> ValueError:
    """The error for n maps without a single feature."""
    return ValueError(f"maps: expected nonzero features (longer than {EPS:g}), got {n} maps without; check the teacher")
