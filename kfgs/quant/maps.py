"""A scene's feature maps after quantisation: one index per pixel, and the latents of the indices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from .._arrays import read_array, reading
from .._check import as_tensor, check_shapes
from .._files import atomic_path
from .._progress import as_bar
from .._rows import ENCODE, EPS, check_directions
from .._typed import typed
from ._store import read_tensors, write_tensors
from .codebook import Codebook, compare


class FeatureMaps(Protocol):
    """Feature maps of many images, read one at a time: the part of a sequence that fitting and quantising use."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Tensor:  # [h, w, D]
        ...


def read_blocks(maps: FeatureMaps, i: int) -> Iterator[Tensor]:  # each [at most 32, w, D]
    """A map, a few rows at a time: from `maps.blocks(i)` if there is such a member, so that it need not be whole in memory."""
    blocks = getattr(maps, "blocks", None)
    yield from as_tensor(f"maps[{i}]", maps[i]).split(32) if blocks is None else blocks(i)


@typed
class IndexMaps(Sequence[NDArray[Any]]):
    """The index maps M of Eq. 5: one [h, w] array of codeword numbers per image, one or two bytes per pixel.

    The number K itself marks a hole: a pixel whose feature was all-zero, about which nothing is known. uint8 up to 255
    codewords, uint16 up to 65,535. Sizes may differ between images.

    Args:
        maps: whole numbers in [0, size], one [h, w] array per image.
        size: number of codewords, K.

    Raises:
        ValueError: if a map is not [h, w], or holds anything but numbers of codewords and holes.
    """

    def __init__(self, maps: Sequence[NDArray[Any]], size: int) -> None:
        if not 1 <= size <= 65_535:
            raise ValueError(f"size: expected 1 to 65535 codewords (two bytes a pixel), got {size}; lower K_max")
        kind = np.uint8 if size <= 255 else np.uint16
        self.size = size
        self._maps: list[NDArray[Any]] = []
        for i, indices in enumerate(maps):
            check_shapes((f"maps[{i}]", indices, "h w"))
            if not np.issubdtype(indices.dtype, np.integer):
                raise ValueError(f"maps[{i}]: expected whole numbers, got {indices.dtype}; use Codebook.quantize")
            if indices.size and not (indices.min() >= 0 and indices.max() <= size):
                raise ValueError(
                    f"maps[{i}]: expected numbers from 0 to {size} (size, a hole), got {indices.min()} to "
                    f"{indices.max()}; quantise it with the codebook of that size"
                )
            self._maps.append(np.ascontiguousarray(indices, dtype=kind))

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, i: int) -> NDArray[Any]:  # type: ignore[override]  # [h, w], one map at a time
        return self._maps[i]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return iter(self._maps)

    def __repr__(self) -> str:
        return f"IndexMaps({len(self)} maps, {self.size} codewords, {self.nbytes} bytes)"

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return sum(indices.nbytes for indices in self._maps)

    @property
    def usage(self) -> NDArray[np.int64]:  # [K]
        """Pixels of each codeword over all maps, holes left out."""
        counts = (np.bincount(m.ravel(), minlength=self.size + 1) for m in self._maps)
        return sum(counts, np.zeros(self.size + 1, np.int64))[: self.size]

    def save(self, path: str | Path) -> None:
        """Write the maps to a .safetensors file."""
        tensors = {f"map.{i}": torch.from_numpy(indices) for i, indices in enumerate(self._maps)}
        write_tensors(path, tensors | {"size": torch.tensor(self.size)}, kind="index maps")

    @staticmethod
    def load(path: str | Path) -> IndexMaps:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file holds no index maps of kfgs.
        """
        tensors = read_tensors(path, kind="index maps")
        with reading(path, "index maps of kfgs"):
            return IndexMaps([tensors[f"map.{i}"].numpy() for i in range(len(tensors) - 1)], int(tensors["size"]))


@typed
class LatentMaps(Sequence[Tensor]):
    """The maps F_l = S'[M] that the field learns (Sec. 3.3.2), each made when it is read; holes are NaN.

    Args:
        index_maps: M, per image.
        latents: of the codewords: latents S', or the codewords themselves.

    Raises:
        ValueError: if `latents` does not have a row per codeword.
    """

    def __init__(
        self,
        index_maps: IndexMaps,
        latents: Tensor,  # [K, d]
    ) -> None:
        check_shapes(("latents", latents, "K d"))
        if latents.shape[0] != index_maps.size:
            raise ValueError(
                f"latents: expected [K, d] with K = {index_maps.size} (from index_maps), got {tuple(latents.shape)}; "
                "encode the codebook that the maps were quantised with"
            )
        self.index_maps, self.latents = index_maps, latents
        self._rows = torch.cat([latents, torch.full_like(latents[:1], torch.nan)])

    def __repr__(self) -> str:
        return f"LatentMaps({len(self)} maps, {self.latents.shape[1]} channels)"

    def __len__(self) -> int:
        return len(self.index_maps)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, d], one map at a time
        index = torch.from_numpy(self.index_maps[i].astype(np.int64)).to(self.latents.device)
        return self._rows[index]

    def __iter__(self) -> Iterator[Tensor]:
        return (self[i] for i in range(len(self)))


@typed
def quantize_maps(
    maps: FeatureMaps,  # each [h, w, D]
    codebook: Codebook,
    *,
    progress: bool = False,
    scratch: Path | None = None,
) -> IndexMaps:
    """Replace every pixel's feature by the number of its most similar codeword (Eq. 5), with one map in memory at a time.

    An all-zero feature (not longer than `EPS`, as in `fit_codebook`) says nothing about its pixel and becomes a hole,
    index K.

    Args:
        maps: see `fit_codebook`.
        codebook: S.
        progress: show a progress bar.
        scratch: a folder for these maps and this codebook only. Each finished index map is written there, so a killed run
            can continue. The caller deletes the folder.

    Raises:
        ValueError: if a map is not [h, w, D] with the codebook's D, or holds NaN or infinity.
    """

    def look(i: int) -> dict[str, Tensor]:
        kept = None if scratch is None else scratch / f"{i}.npy"
        if kept is not None and kept.is_file():
            return {"index": torch.from_numpy(read_array(kept))}
        index = _quantize_map(maps, i, codebook)
        if kept is not None:
            with atomic_path(kept) as temporary:
                np.save(temporary, index)
        return {"index": torch.from_numpy(index)}

    shared = tqdm(map(look, range(len(maps))), desc="quantise", total=len(maps), disable=not as_bar(progress))
    return IndexMaps([part["index"].numpy() for part in shared], codebook.size)


def _quantize_map(maps: FeatureMaps, i: int, codebook: Codebook) -> NDArray[np.uint16]:  # [h, w]
    feature_map = as_tensor(f"maps[{i}]", maps[i])  # once: this may read a file
    check_shapes((f"maps[{i}]", feature_map, f"h w {codebook.dim}"))
    index, _, length = compare(feature_map, codebook.unit)
    check_directions(f"maps[{i}]", feature_map, length, ENCODE)
    return index.masked_fill(length <= EPS, codebook.size).cpu().numpy().astype(np.uint16)
