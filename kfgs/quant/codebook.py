"""The codebook S of Sec. 3.3.1: K codewords, and the nearest of them by cosine similarity (Eq. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._arrays import reading
from .._card import html_card, short_repr, short_value
from .._check import as_array, as_tensor, check_range, check_shapes, moved_to
from .._rows import EPS, row_norms, unit_rows
from ._store import read_tensors, write_tensors

CHUNK = 1024  # features at a time: 2 MB of 512 channels stay in a core's cache, a third faster than 65,536 (measured)


class Nearest(NamedTuple):
    """The nearest codeword of each feature (Eq. 5)."""

    codeword: Tensor  # [...] int64
    similarity: Tensor  # [...] cosine with that codeword, in [-1, 1] up to rounding

    def __repr__(self) -> str:
        return short_repr(self)


class Compared(NamedTuple):
    """The best codeword of each feature, before the division by the feature's length."""

    codeword: Tensor  # [...] int64, of the largest product
    product: Tensor  # [...] of the feature with that unit row, in the rows' precision
    length: Tensor  # [...] of the feature, in at least single precision

    def __repr__(self) -> str:
        return short_repr(self)


def compare(
    features: Tensor,  # [..., D]
    unit: Tensor,  # [K, D] unit rows
    *,
    chunk: int = CHUNK,
) -> Compared:
    """Eq. 5, at most `chunk` features at a time. The length of a feature changes no argmax, so no feature is divided by it.

    Note:
        Ties go to the lowest index. Products of bfloat16 are three times faster on AVX-512 BF16, but to prove the same
        argmax, every feature would be computed again whose two best are nearer than their error: too many to gain.
    """
    check_range("chunk", chunk, 1)
    index = torch.empty(features.shape[:-1], dtype=torch.int64, device=features.device)
    product = torch.empty(features.shape[:-1], dtype=unit.dtype, device=features.device)
    wide = torch.promote_types(torch.promote_types(features.dtype, torch.float32), unit.dtype)
    length = torch.empty(features.shape[:-1], dtype=wide, device=features.device)
    rows, flat = features.reshape(-1, unit.shape[1]), (index.view(-1), product.view(-1), length.view(-1))
    K = unit.shape[0]
    with torch.no_grad():
        padded = torch.nn.functional.pad(
            unit, (0, 0, 0, -K % 16)
        ).T  # a product with 256 columns is quicker than with 255
        for start in range(0, rows.shape[0], chunk):
            here = slice(start, start + chunk)
            part = rows[here].to(wide)
            best, where = (part.to(unit.dtype) @ padded)[:, :K].max(dim=-1)  # the first of equal ones
            flat[0][here], flat[1][here], flat[2][here] = where, best, row_norms(part)
    return Compared(index, product, length)


@dataclass(frozen=True, eq=False)
class Codebook:
    """K codewords of D channels, S = {f_e} in Sec. 3.3.1. Their lengths carry no meaning: only directions are compared,
    in the codewords' precision (features of another one are converted).

    Raises:
        ValueError: if there is no codeword, or one is all-zero or not finite.

    Example:
        >>> import torch
        >>> book = Codebook(torch.tensor([[2.0, 0.0], [0.0, 3.0]]))
        >>> book.quantize(torch.tensor([[1.0, 0.2], [0.1, 5.0], [1.0, 1.0]]))
        tensor([0, 1, 0])
    """

    codewords: Tensor  # [K, D]

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "codewords", as_tensor("codewords", self.codewords, floating=isinstance(self.codewords, list | tuple))
        )
        check_shapes(("codewords", self.codewords, "K D"))
        if self.size < 1 or not self.codewords.is_floating_point():
            raise ValueError(
                f"codewords: expected at least one row of floating-point numbers, got {tuple(self.codewords.shape)} "
                f"of {self.codewords.dtype}; fit one with fit_codebook"
            )
        norms = row_norms(self.codewords.detach())  # K is small: this look at the values is cheap
        bad = (~(torch.isfinite(norms) & (norms > EPS))).nonzero()[:, 0].tolist()
        if bad:
            raise ValueError(
                f"codewords: expected rows of a finite length above {EPS:g}, got others in rows {bad[:8]}; leave them out"
            )

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        facts = {"codewords": self.size, "channels": self.dim, "numbers": short_value(self.codewords)}
        return html_card("Codebook", facts)

    def __len__(self) -> int:
        return int(self.codewords.shape[0])

    @property
    def size(self) -> int:
        """Number of codewords, K; `len` is the same."""
        return len(self)

    @property
    def dim(self) -> int:
        """Channels of a codeword, D."""
        return int(self.codewords.shape[1])

    @cached_property
    def unit(self) -> Tensor:  # [K, D]
        """The codewords with unit length."""
        return unit_rows(self.codewords)

    def similarity(
        self,
        features: Tensor,  # [..., D]
    ) -> Tensor:  # [..., K]
        """Cosine similarity of each feature with each codeword; 0 for an all-zero feature. Differentiable."""
        return unit_rows(self._checked(features).to(self.unit.dtype)) @ self.unit.T

    def nearest(
        self,
        features: Tensor,  # [..., D]
        *,
        chunk: int = CHUNK,
    ) -> Nearest:
        """The most similar codeword of each feature and how similar it is (Eq. 5), at most `chunk` features at a time.

        Note:
            Ties go to the lowest index. An all-zero feature is equally (0) similar to all, and so gets index 0 with
            similarity 0; the similarity shows which features were zero.
        """
        index, best, length = compare(self._checked(features), self.unit, chunk=chunk)
        shortest = max(EPS, torch.finfo(best.dtype).tiny)  # as in unit_rows
        return Nearest(index, (best / length.clamp_min(shortest)).to(best.dtype))

    def quantize(
        self,
        features: Tensor,  # [..., D]
        *,
        chunk: int = CHUNK,
    ) -> Tensor:  # [...] int64
        """The index map M of Eq. 5: for each feature, t = argmax_e cos(f, f_e). Ties as in `nearest`."""
        return compare(self._checked(features), self.unit, chunk=chunk).codeword

    def to_numpy(self) -> np.ndarray[Any, Any]:  # [K, D]
        """The codewords as a NumPy array."""
        return as_array(self.codewords)

    def to(self, *args: Any, **kwargs: Any) -> Codebook:
        """Move or convert the codewords as `Tensor.to` does."""
        return Codebook(moved_to(self.codewords, *args, **kwargs))

    def to_tensors(self) -> dict[str, Tensor]:
        """The tensors that `from_tensors` reads."""
        return {"codewords": self.codewords}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> Codebook:
        """A codebook from the tensors of `to_tensors`; other names are ignored.

        Raises:
            ValueError: if "codewords" is missing.
        """
        if "codewords" not in tensors:
            raise ValueError(f"tensors: expected the name 'codewords', got {sorted(tensors)}; use Codebook.to_tensors")
        return Codebook(tensors["codewords"])

    def save(self, path: str | Path) -> None:
        """Write the codewords to a .safetensors file."""
        write_tensors(path, self.to_tensors(), kind="codebook")

    @staticmethod
    def load(path: str | Path) -> Codebook:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a codebook of kfgs.
        """
        tensors = read_tensors(path, kind="codebook")
        with reading(path, "a codebook of kfgs"):
            return Codebook.from_tensors(tensors)

    def _checked(self, features: Tensor) -> Tensor:
        features = as_tensor("features", features)
        if features.ndim < 1 or features.shape[-1] != self.dim:
            raise ValueError(
                f"features: expected [..., D] with D = {self.dim} (from codewords), got {tuple(features.shape)}; "
                "pass features of the teacher that the codebook was fitted to"
            )
        return features
