"""The codebook S of Sec. 3.3.1: K codewords, and the nearest of them by cosine similarity (Eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes
from .._rows import EPS, largest, row_norms, unit_rows
from .store import Stored

CHUNK = 4096  # rows at a time: 8 MB of 512 channels stay in a core's cache


class Nearest(NamedTuple):
    """The nearest codeword of each feature (Eq. 5)."""

    codeword: Tensor  # [...] int64
    similarity: Tensor  # [...] cosine with that codeword, in [-1, 1] up to rounding

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class CodebookReport:
    """How a codebook was fitted, and how well it represents the sampled features."""

    history: list[dict[str, Any]] = field(repr=False)
    """Per round of growth (`PaperCodebook`: per epoch): round or epoch (from 0), size, added, pruned, and coverage and
    mean_similarity before its growth; with `PaperCodebook` also loss (Eq. 6, mean over images)."""
    usage: Tensor  # [K] int64
    """Sampled features of each codeword; unused codewords are kept, as in the paper."""
    coverage: float
    """Share of the sampled features that are similar to their codeword by at least alpha: `PaperCodebook.expand_below`, or
    what nine in ten features of a `GrownCodebook` reach."""
    mean_similarity: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Codebook(Stored):
    """K features of a teacher that stand for all others, compared by cosine similarity: only their directions count.

    Example:
        >>> book = Codebook(torch.tensor([[2.0, 0.0], [0.0, 3.0]]))
        >>> book.quantize(torch.tensor([[1.0, 0.2], [0.1, 5.0], [1.0, 1.0]]))
        tensor([0, 1, 0])
    """

    codewords: Tensor  # [K, D]
    report: CodebookReport | None = field(default=None, repr=False)  # set by `fit_codebook`; not saved
    kind = "codebook"

    def __post_init__(self) -> None:
        object.__setattr__(self, "codewords", as_tensor("codewords", self.codewords, floating=True))
        check_shapes(("codewords", self.codewords, "K D"))
        norms = row_norms(self.codewords.detach())
        bad = (~(torch.isfinite(norms) & (norms > EPS))).nonzero()[:, 0].tolist()
        if bad or not len(norms):
            got = f"others in rows {bad[:8]}" if bad else "none"
            raise ValueError(f"codewords: expected rows of a finite length above {EPS:g}, got {got}; fit them again")

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """The number of codewords, K."""
        return int(self.codewords.shape[0])

    @property
    def dim(self) -> int:
        """Channels of a codeword, D."""
        return int(self.codewords.shape[1])

    @cached_property
    def unit(self) -> Tensor:  # [K, D]
        """The codewords with unit length."""
        return unit_rows(self.codewords)

    def similarity(self, features: Tensor) -> Tensor:  # [..., D] -> [..., K]
        """Cosine similarity of each feature with each codeword; 0 for an all-zero feature. Differentiable."""
        return unit_rows(as_channels("features", features, self.dim).to(self.unit.dtype)) @ self.unit.T

    def nearest(self, features: Tensor) -> Nearest:  # [..., D] -> [...], [...]
        """The most similar codeword of each feature and how similar it is (Eq. 5).

        Note:
            Ties go to the lowest index. An all-zero feature gets index 0 with similarity 0.
        """
        index, product, length = self.compare(features)
        shortest = max(EPS, torch.finfo(product.dtype).tiny)  # as in unit_rows
        return Nearest(index, (product / length.clamp_min(shortest)).to(product.dtype))

    def quantize(self, features: Tensor) -> Tensor:  # [..., D] -> [...] int64
        """The index map M of Eq. 5: for each feature, t = argmax_e cos(f, f_e). Ties as in `nearest`."""
        return self.compare(features)[0]

    def compare(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # [..., D] -> [...] int64, [...], [...]
        """The best codeword of each feature, the product of feature and unit codeword, and the feature's length.

        The length changes no argmax, so no feature is divided by it. The product has the dtype of the codewords, the length
        at least single precision. (Products of bfloat16 are three times faster on AVX-512 BF16, but too many features would
        have to be computed again whose two best are closer than their error.)
        """
        features = as_channels("features", features, self.dim)
        wide = torch.promote_types(torch.promote_types(features.dtype, torch.float32), self.unit.dtype)
        parts = []
        with torch.no_grad():
            for part in features.reshape(-1, self.dim).split(CHUNK):
                part = part.to(wide)
                parts.append((*nearest_rows(part.to(self.unit.dtype), self.unit), row_norms(part)))
        index, product, length = (torch.cat(values).view(features.shape[:-1]) for values in zip(*parts, strict=True))
        return index, product, length


def as_channels(name: str, values: Tensor, channels: int, *, floating: bool = False) -> Tensor:  # [..., channels]
    """Features or latents as a tensor; a ValueError if they have another number of channels than those of the fit."""
    values = as_tensor(name, values, floating=floating)
    if values.shape[-1:] != (channels,):
        got = f"{tuple(values.shape)}; pass those of the teacher and the scene that it was fitted to"
        raise ValueError(f"{name}: expected [..., {channels}], got {got}")
    return values


def nearest_rows(
    rows: Tensor,  # [N, D]
    targets: Tensor,  # [K, D]
    *,
    euclidean: bool = False,
) -> Nearest:
    """The target with the largest product x.t with each row, and this product. Ties go to the lowest index.

    With unit targets it is the one in the most similar direction. `euclidean`: the nearest point, of largest x.t - |t|^2 / 2.
    """
    K, best = len(targets), []
    columns = torch.nn.functional.pad(targets, (0, 0, 0, -K % 16 if K > 64 else 0)).T  # 256 are quicker than 255
    offsets = -columns.square().sum(dim=0) / 2 if euclidean else None
    for part in rows.split(CHUNK):
        products = part @ columns if offsets is None else torch.addmm(offsets, part, columns)
        best.append(largest(products[:, :K]))
    number, index = (torch.cat(parts) for parts in zip(*best, strict=True))
    return Nearest(index, number)


def coverage(similarity: Tensor, alpha: float) -> dict[str, float]:
    """How well features are represented, from their similarities [n]: those of at least `alpha` are covered."""
    share, mean = (similarity >= alpha).double().mean(), similarity.mean(dtype=torch.float64)
    return {"coverage": float(share), "mean_similarity": float(mean)}


def with_report(codewords: Tensor, history: list[dict[str, Any]], nearest: Nearest, alpha: float) -> Codebook:
    """A codebook with its report, from the `nearest` codewords of the sampled features [n]."""
    usage = torch.bincount(nearest.codeword, minlength=len(codewords)).cpu()
    return Codebook(codewords, CodebookReport(history, usage, **coverage(nearest.similarity, alpha)))
