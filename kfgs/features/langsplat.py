"""Maps of LangSplat: a mask number per pixel and a feature per mask, combined when they are read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._arrays import read_array
from .._check import check_choice, check_whole

INDEX, ROWS = "_s.npy", "_f.npy"  # endings after the stem: masks [L, H, W], and their features [M, D]
CELLS = 360 * 480  # most cells of a map without a given stride, as in the paper's maps: 354 MB at 512 channels
LEVELS = ("default", "s", "m", "l")  # SAM's own choice of masks; subparts, parts, wholes


class MaskFeatures:
    """A map [h, w, D] in which a pixel has the feature of its mask. Features are looked up when a part is read.

    A pixel in no mask (index -1) has an all-zero feature, which means "unknown".

    Args:
        file: `<stem>_s.npy`, whole numbers [L, H, W] (LangSplat stores floats), -1 for no mask. `<stem>_f.npy`, floats
            [M, D], must be in the same folder.
        level: which of the L sets of masks.
        stride: pixels per cell; the map is [round(H / stride), round(W / stride), D], and a cell has the feature of the
            pixel at its centre. None: the smallest stride with at most `CELLS` cells.

    Raises:
        FileNotFoundError: if `<stem>_f.npy` is missing.
        ValueError: if the arrays are of another shape or kind. When read: if an index is no whole number in [-1, M).
    """

    def __init__(self, file: Path, level: int = 0, stride: int | None = None) -> None:
        if stride is not None:
            check_whole("stride", stride, 1)
        self.file, partner = file, rows_file(file)
        index = read_array(file, mapped=True)
        if index.ndim != 3 or 0 in index.shape or index.dtype.kind not in "iuf":
            raise ValueError(f"expected mask numbers [4, H, W], got {index.dtype} {index.shape}")
        if not partner.is_file():
            raise FileNotFoundError(f"expected {partner.name} with the masks' features in the same folder, got none")
        rows = read_array(partner)
        if rows.ndim != 2 or rows.shape[1] == 0 or rows.dtype.kind != "f":
            raise ValueError(f"expected floats [M, D] in {partner.name}, got {rows.dtype} {rows.shape}")
        if not 0 <= level < index.shape[0]:
            raise ValueError(f"expected level {level} ({LEVELS[level]}), got masks of {index.shape[0]} levels")
        self._index = index[level]  # [H, W]
        self._rows = np.concatenate([rows, np.zeros_like(rows[:1] if len(rows) else rows, shape=(1, rows.shape[1]))])
        H, W = index.shape[1:]
        chosen = _finest_stride(H, W) if stride is None else stride
        self._i, self._j = _centres(H, chosen), _centres(W, chosen)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(h, w, D)."""
        return len(self._i), len(self._j), int(self._rows.shape[1])

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the features."""
        return self._rows.dtype

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[Any]:  # [rows, columns, D]
        rows, columns = key
        index = self._index[np.ix_(self._i[rows], self._j[columns])]
        masks = len(self._rows) - 1
        if index.size and not bool(((index >= -1) & (index < masks) & (index == np.floor(index))).all()):
            raise ValueError(
                f"{self.file}: expected mask numbers from -1 to {masks - 1} (features in {ROWS}), got "
                f"{float(index.min()):g} to {float(index.max()):g}; both files must be of one run of LangSplat"
            )
        return self._rows[index.astype(np.int64)]  # -1 is the last row, the zeros


def rows_file(file: Path) -> Path:
    """The file with the masks' features that belongs to a file of mask numbers."""
    return file.with_name(file.name.removesuffix(INDEX) + ROWS)


def parse_level(level: int | str) -> int:
    """The number of a level of masks, from its number or its name.

    Raises:
        ValueError: if there is no such level.

    Example:
        >>> parse_level("l"), parse_level(0)
        (3, 0)
    """
    check_choice("level", level, [*range(len(LEVELS)), *LEVELS])
    return LEVELS.index(level) if isinstance(level, str) else int(level)


def _finest_stride(height: int, width: int) -> int:
    """The smallest stride with at most `CELLS` cells of a picture."""
    stride = 1
    while _cells(height, stride) * _cells(width, stride) > CELLS:
        stride += 1
    return stride


def _cells(size: int, stride: int) -> int:
    return max(int(size / stride + 0.5), 1)


def _centres(size: int, stride: int) -> NDArray[np.int64]:
    """The pixels that hold the centres of the cells, when `size` pixels are cut into round(size / stride) cells."""
    cells = _cells(size, stride)
    return ((2 * np.arange(cells) + 1) * size) // (2 * cells)
