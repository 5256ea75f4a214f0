"""Choose features of a map: a regular grid of pixels, and farthest-point sampling by cosine."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_range, check_shapes, check_size
from .._rows import EPS, row_norms, unit_rows
from .._typed import typed

SAMPLES = 28_800  # rows 1::2 and columns 1::3 of a 360 x 480 map, as in the paper's experiments


@typed
def choose_grid_step(height: int, width: int, samples: int = SAMPLES) -> tuple[int, int]:
    """The finest grid (row step, column step) that leaves at most `samples` pixels of a map.

    Steps grow in turn, columns first: (1, 1), (1, 2), (2, 2), (2, 3), ...; a map that is small enough keeps all pixels.

    Example:
        >>> choose_grid_step(360, 480), choose_grid_step(90, 120)
        ((2, 3), (1, 1))
    """
    check_size((height, width), low=0)
    check_range("samples", samples, 1)
    rows, columns = 1, 1
    while len(_grid(height, rows)) * len(_grid(width, columns)) > samples:
        rows, columns = (rows, columns + 1) if rows == columns else (rows + 1, columns)
    return rows, columns


@typed
def grid_slices(
    height: int, width: int, step: tuple[int, int] | None = None, *, samples: int = SAMPLES
) -> tuple[slice, slice]:
    """The rows and columns of a map that `sample_grid` uses, so that only these are read from disk.

    Raises:
        ValueError: if a step is not positive.

    Example:
        >>> grid_slices(360, 480)
        (slice(1, 360, 2), slice(1, 480, 3))
    """
    rows, columns = choose_grid_step(height, width, samples) if step is None else step
    check_range("step[0]", rows, 1)
    check_range("step[1]", columns, 1)
    i, j = _grid(height, rows), _grid(width, columns)
    return slice(i.start, height, rows), slice(j.start, width, columns)


@typed
def sample_grid(
    feature_map: Tensor,  # [h, w, D]
    step: tuple[int, int] | None = None,
    *,
    samples: int = SAMPLES,
) -> Tensor:  # [n, D]
    """The features on a regular grid of pixels, row by row.

    Args:
        feature_map: features of one view.
        step: every how many rows and columns; the first one taken is step // 2, so (2, 3) is rows 1::2, columns 1::3.
            None chooses the finest step that leaves at most `samples` features.
        samples: most features to take when `step` is None.

    Raises:
        ValueError: if the map is not [h, w, D], or a step is not positive.
    """
    check_shapes(("feature_map", feature_map, "h w D"))
    height, width, dim = feature_map.shape
    rows, columns = grid_slices(height, width, step, samples=samples)
    return feature_map[rows, columns].reshape(-1, dim)


def farthest_points(
    features: Tensor,  # [n, D]
    count: int,
    *,
    block: int = 2048,
) -> Tensor:  # [min(count, nonzero rows)] int64
    """Pick the `count` most diverse features: farthest-point sampling with cosine similarity as the measure.

    The first two are the least similar pair of all (the earlier one first); each further one is the feature whose
    largest similarity to those already picked is smallest.

    Args:
        features: candidates; all-zero rows are never picked.
        count: how many (the paper's rho).
        block: rows of the n x n similarity matrix that are in memory at a time: block * n numbers.

    Returns:
        Row numbers in the order of picking; fewer than `count` if there are not so many nonzero rows.

    Raises:
        ValueError: if `features` is not [n, D], `count` is below 1, or every row is zero.

    Note:
        Ties go to the lowest row number. A feature may be picked although an equal one already was, when nothing else
        is left; pruning (Eq. 9) takes it out again.
    """
    check_shapes(("features", features, "n D"))
    check_range("count", count, 1)
    rows = (row_norms(features) > EPS).nonzero()[:, 0]
    if rows.numel() == 0:
        raise ValueError(
            f"features: expected a nonzero row (longer than {EPS:g}), got {features.shape[0]} others; check the teacher"
        )
    unit = unit_rows(features[rows])
    if rows.numel() == 1:
        return rows
    picked = list(_least_similar_pair(unit, block))[:count]
    largest = (unit @ unit[picked].T).amax(dim=1)  # similarity to the nearest picked one
    while len(picked) < min(count, rows.numel()):
        largest[picked] = torch.inf  # never twice
        picked.append(int(largest.argmin()))
        largest = torch.maximum(largest, unit @ unit[picked[-1]])
    return rows[torch.tensor(picked, device=rows.device)]


def _grid(size: int, step: int) -> range:
    """Positions step // 2, step // 2 + step, ... below `size`; at least one."""
    return range(min(step // 2, max(size - 1, 0)), size, step)


def _least_similar_pair(unit: Tensor, block: int) -> tuple[int, int]:  # unit: [n, D]
    """Row numbers i < j of the smallest inner product, looking at the upper triangle one block of rows at a time."""
    n = unit.shape[0]
    least, pair = float("inf"), (0, min(1, n - 1))
    for start in range(0, n - 1, block):
        similarity = unit[start : start + block] @ unit[start:].T  # [b, n - start], starts on the diagonal
        lower = torch.ones_like(similarity[:, : similarity.shape[0]], dtype=torch.bool).tril()
        similarity[:, : similarity.shape[0]].masked_fill_(lower, torch.inf)
        where = int(similarity.argmin())
        row, column = divmod(where, similarity.shape[1])
        value = float(similarity[row, column])
        if value < least:
            least, pair = value, (start + row, start + column)
    return pair
