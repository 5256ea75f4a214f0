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

CHUNK = 1024  # features at a time: 2 MB of 512 channels stay in a core's cache, a third faster than 65,536 (measured)


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
        return unit_rows(self._checked(features).to(self.unit.dtype)) @ self.unit.T

    def nearest(self, features: Tensor) -> Nearest:  # [..., D] -> [...], [...]
        """The most similar codeword of each feature and how similar it is (Eq. 5).

        Note:
            Ties go to the lowest index. An all-zero feature gets index 0 with similarity 0.
        """
        index, product, length = nearest_rows(self._checked(features), self.unit)
        shortest = max(EPS, torch.finfo(product.dtype).tiny)  # as in unit_rows
        return Nearest(index, (product / length.clamp_min(shortest)).to(product.dtype))

    def quantize(self, features: Tensor) -> Tensor:  # [..., D] -> [...] int64
        """The index map M of Eq. 5: for each feature, t = argmax_e cos(f, f_e). Ties as in `nearest`."""
        return nearest_rows(self._checked(features), self.unit)[0]

    def _checked(self, features: Tensor) -> Tensor:
        features = as_tensor("features", features)
        if features.shape[-1:] != (self.dim,):
            raise ValueError(
                f"features: expected [..., D] with D = {self.dim} (from codewords), got {tuple(features.shape)}; "
                "pass features of the teacher that the codebook was fitted to"
            )
        return features


def nearest_rows(
    features: Tensor,  # [..., D]
    unit: Tensor,  # [K, D] unit rows
) -> tuple[Tensor, Tensor, Tensor]:  # [...] int64, [...], [...]
    """Eq. 5: the best row of each feature, its product with the feature, and the feature's length.

    The length changes no argmax, so no feature is divided by it. Ties go to the lowest index. The product has the dtype of
    `unit`, the length at least single precision. (Products of bfloat16 are three times faster on AVX-512 BF16, but too many
    features would have to be computed again whose two best are closer than their error.)
    """
    K, D = unit.shape
    rows = features.reshape(-1, D)
    wide = torch.promote_types(torch.promote_types(features.dtype, torch.float32), unit.dtype)
    parts = []
    with torch.no_grad():
        padded = torch.nn.functional.pad(unit, (0, 0, 0, -K % 16)).T  # 256 columns are quicker than 255
        for part in rows.split(CHUNK):
            part = part.to(wide)
            parts.append((*largest((part.to(unit.dtype) @ padded)[:, :K]), row_norms(part)))
    product, index, length = (torch.cat(values).view(features.shape[:-1]) for values in zip(*parts, strict=True))
    return index, product, length


def share_above(similarity: Tensor, alpha: float) -> float:
    """The share of features that are at least `alpha` similar."""
    return float((similarity >= alpha).double().mean())


def with_report(codewords: Tensor, history: list[dict[str, Any]], nearest: Nearest, alpha: float) -> Codebook:
    """A codebook with its report, from the `nearest` codewords of the sampled features [n]."""
    usage, similarity = torch.bincount(nearest.codeword, minlength=len(codewords)).cpu(), nearest.similarity
    mean = float(similarity.mean(dtype=torch.float64))
    return Codebook(codewords, CodebookReport(history, usage, share_above(similarity, alpha), mean))
