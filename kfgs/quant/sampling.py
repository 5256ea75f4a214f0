"""Choose features: a regular grid of a map's pixels, farthest-point sampling by cosine, and maps read a part at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import torch
from torch import Tensor

from .._check import as_tensor, check_range, check_shapes
from .._rows import EPS, row_norms, unit_rows

SAMPLES = 28_800  # rows 1::2 and columns 1::3 of a 360 x 480 map, as in the paper's experiments
BLOCK = 2048  # rows of a similarity matrix in memory at a time


class FeatureMaps(Protocol):
    """Feature maps of many images, one in memory at a time; a list of tensors is enough.

    Maps on disk may have two more members, so that less is read or in memory: `grid(i, step, samples)`, equal to
    `sample_grid(maps[i], step, samples=samples)`; and `blocks(i)`, the map a few rows at a time.
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
        features: Tensor = grid(i, None, samples)
        check_shapes((f"maps.grid({i})", features, "n D"))
        return features
    feature_map = as_tensor(f"maps[{i}]", maps[i])
    check_shapes((f"maps[{i}]", feature_map, "h w D"))
    return sample_grid(feature_map, samples=samples)


def grid_slices(
    height: int, width: int, step: tuple[int, int] | None = None, *, samples: int = SAMPLES
) -> tuple[slice, slice]:
    """The rows and columns of a map that `sample_grid` uses, so that only these are read from disk.

    Example:
        >>> grid_slices(360, 480), grid_slices(90, 120)
        ((slice(1, 360, 2), slice(1, 480, 3)), (slice(0, 90, 1), slice(0, 120, 1)))
    """
    rows, columns = step or (1, 1)
    for name, value in (("samples", samples), ("step[0]", rows), ("step[1]", columns)):
        check_range(name, value, 1)
    while step is None and len(_grid(height, rows)) * len(_grid(width, columns)) > samples:
        rows, columns = (rows, columns + 1) if rows == columns else (rows + 1, columns)
    return slice(_grid(height, rows).start, height, rows), slice(_grid(width, columns).start, width, columns)


def sample_grid(
    feature_map: Tensor,  # [h, w, D]
    step: tuple[int, int] | None = None,
    *,
    samples: int = SAMPLES,
) -> Tensor:  # [n, D]
    """The features on a regular grid of pixels, row by row: every N-th row and column, from step // 2.

    So (2, 3) is rows 1::2, columns 1::3. A step of None is the finest one that leaves at most `samples` features. Steps grow
    in turn, columns first: (1, 1), (1, 2), (2, 2), (2, 3), ...
    """
    sizes = check_shapes(("feature_map", feature_map, "h w D"))
    rows, columns = grid_slices(sizes["h"], sizes["w"], step, samples=samples)
    return feature_map[rows, columns].reshape(-1, sizes["D"])


def _grid(size: int, step: int) -> range:
    """Positions step // 2, step // 2 + step, ... below `size`; at least one."""
    return range(min(step // 2, max(size - 1, 0)), size, step)


def farthest_points(features: Tensor, count: int) -> Tensor:  # [n, D] -> [min(count, nonzero rows)] int64
    """Pick the `count` most diverse features: farthest-point sampling with cosine similarity as the measure.

    The first two are the least similar pair of all (the earlier one first); each further one is the feature whose largest
    similarity to those already picked is smallest. Ties go to the lowest row; all-zero rows are never picked. When nothing
    else is left, a feature may be picked although an equal one was; pruning (Eq. 9) takes it out again.
    """
    rows = (row_norms(features) > EPS).nonzero()[:, 0]
    unit = unit_rows(features[rows])
    if len(rows) < 2:
        return rows
    picked = list(_least_similar_pair(unit))[:count]
    largest = (unit @ unit[picked].T).amax(dim=1)  # similarity to the nearest picked one
    while len(picked) < min(count, len(rows)):
        largest[picked] = torch.inf  # never twice
        picked.append(int(largest.argmin()))
        largest = torch.maximum(largest, unit @ unit[picked[-1]])
    return rows[torch.tensor(picked, device=rows.device)]


def _least_similar_pair(unit: Tensor) -> tuple[int, int]:  # [n, D], n >= 2
    """Rows i < j of the smallest inner product: the upper triangle, one block of rows at a time."""
    least, pair = float("inf"), (0, 1)
    for start in range(0, len(unit) - 1, BLOCK):
        similarity = unit[start : start + BLOCK] @ unit[start:].T  # [b, n - start], starts on the diagonal
        square = similarity[:, : len(similarity)]
        square.masked_fill_(torch.ones_like(square, dtype=torch.bool).tril(), torch.inf)
        row, column = divmod(int(similarity.argmin()), similarity.shape[1])
        if float(similarity[row, column]) < least:
            least, pair = float(similarity[row, column]), (start + row, start + column)
    return pair
