"""A scene's feature maps, read a part at a time; and after quantisation: one index per pixel, and the latents of the indices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from .._check import as_bar, as_tensor, check_range, check_shapes, check_whole
from .._rows import ENCODE, EPS, check_directions
from .codebook import Codebook
from .store import Stored

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


class IndexMaps(Stored, list[NDArray[Any]]):
    """The index maps M of Eq. 5: a list of one [h, w] array of codeword numbers per image, one or two bytes per pixel.

    The number K itself marks a hole: a pixel whose feature was all-zero, about which nothing is known. uint8 up to 255
    codewords, uint16 up to 65,535. Sizes may differ between images.
    """

    kind = "index maps"

    def __init__(self, maps: Sequence[NDArray[Any]], size: int) -> None:
        """Whole numbers in [0, size], one array per image; `size` is the number of codewords, K."""
        check_whole("size", size, 1, 65_535)
        for i, indices in enumerate(maps):
            check_shapes((f"maps[{i}]", indices, "h w"))
            if indices.size and not 0 <= indices.min() <= indices.max() <= size:
                got = f"{indices.min()} to {indices.max()}; quantise it with the codebook of that size"
                raise ValueError(f"maps[{i}]: expected numbers from 0 to {size} (size, a hole), got {got}")
        dtype = np.uint8 if size <= 255 else np.uint16
        super().__init__(np.ascontiguousarray(indices, dtype=dtype) for indices in maps)
        self.size = size

    def __repr__(self) -> str:
        return f"IndexMaps({len(self)} maps, {self.size} codewords)"

    def state_dict(self) -> dict[str, Any]:
        """The maps as `map.0`, `map.1`, ..., and `size`."""
        tensors = {f"map.{i}": torch.from_numpy(indices) for i, indices in enumerate(self)}
        return tensors | {"size": torch.tensor(self.size)}

    @classmethod
    def from_state_dict(cls, tensors: Mapping[str, Tensor]) -> IndexMaps:
        """The inverse of `state_dict`."""
        return cls([tensors[f"map.{i}"].numpy() for i in range(len(tensors) - 1)], int(tensors["size"]))


class LatentMaps(Sequence[Tensor]):
    """The maps F_l = S'[M] that the field learns (Sec. 3.3.2), each made when it is read; holes are NaN."""

    def __init__(self, index_maps: IndexMaps, latents: Tensor) -> None:  # [K, d]
        """`latents`: those of the codewords, S', or the codewords themselves."""
        check_shapes(("latents", latents, (index_maps.size, "d")))
        self.index_maps = index_maps
        self._rows = torch.cat([latents, torch.full_like(latents[:1], torch.nan)])

    def __len__(self) -> int:
        return len(self.index_maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, d]
        return self._rows[torch.from_numpy(self.index_maps[i].astype(np.int64)).to(self._rows.device)]


def quantize_maps(
    maps: FeatureMaps,  # each [h, w, D]
    codebook: Codebook,
    *,
    progress: bool = False,
) -> IndexMaps:
    """Replace every pixel's feature by the number of its most similar codeword (Eq. 5), with one map in memory at a time.

    A map is computed on the codebook's device; the result is NumPy's.

    An all-zero feature (not longer than `EPS`, as in `fit_codebook`) says nothing about its pixel and becomes a hole, K.

    Raises:
        ValueError: if a map is not [h, w, D] with the codebook's D, or holds NaN or infinity.
    """
    indices = []
    for i in tqdm(range(len(maps)), desc="quantise", disable=not as_bar(progress)):
        feature_map = as_tensor(f"maps[{i}]", maps[i]).to(codebook.codewords.device)
        check_shapes((f"maps[{i}]", feature_map, ("h", "w", codebook.dim)))
        index, _, length = codebook.compare(feature_map)
        check_directions(f"maps[{i}]", feature_map, length, ENCODE)
        indices.append(index.masked_fill(length <= EPS, codebook.size).cpu().numpy().astype(np.uint16))
    return IndexMaps(indices, codebook.size)
