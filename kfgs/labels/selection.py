"""Selections of Gaussians with scores, and the operators that combine them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .._card import cut, html_card
from .._check import as_tensor, check_shapes
from .._origin import to_world
from .._rows import check_finite
from ..gaussians import Gaussians
from .boxes import OrientedBox
from .nearest import Array, positions


@dataclass(frozen=True, eq=False)
class Selection:
    """Some of N Gaussians, with a score for every one of them.

    `a & b`, `a | b`, `a - b` and `~a` combine selections of the same Gaussians. Scores follow Zadeh's rules: `&` takes the
    smaller, `|` the larger, `~a` has 1 - score; `a - b` is `a & ~b`. `len` is the number selected, so an empty selection is
    false in an `if`. `OfClass("chair").select(gaussians)`, `SemanticField.query` and `Selection.of(mask)` make selections.

    Example:
        >>> near = Selection.of(torch.tensor([True, True, False]), "near")
        >>> near.points(torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])).max(axis=0).tolist()
        [1.0, 0.0, 0.0]
    """

    mask: Tensor  # [N] bool
    scores: Tensor  # [N] how well each fits: a cosine or a relevancy; 1 and 0 if a place or a label decides
    threshold: float | None = None
    """Gamma of Sec. 3.4, the score that a selected Gaussian exceeds; None if there was no threshold, or several."""
    how: str = ""
    """How the threshold was found, or which selections were combined."""

    @classmethod
    def of(cls, mask: Tensor | Array, how: str = "given") -> Selection:  # mask: [N] bool
        """A selection from a mask alone: scores are 1 inside, 0 outside."""
        mask = as_tensor("mask", mask)
        return cls(mask, mask.to(torch.get_default_dtype()), None, how)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mask", as_tensor("mask", self.mask))
        object.__setattr__(self, "scores", as_tensor("scores", self.scores))
        check_shapes(("mask", self.mask, "N"), ("scores", self.scores, "N"))
        if self.mask.dtype != torch.bool:
            raise TypeError(f"mask: expected a boolean mask, got {self.mask.dtype}; compare first, as in labels == 3")
        check_finite("scores", self.scores)

    def __len__(self) -> int:
        return int(self.mask.sum())

    def __repr__(self) -> str:
        return f"Selection({len(self)} of {len(self.mask)} Gaussians: {cut(self.summary, 140)})"

    def _repr_html_(self) -> str:
        chosen = self.scores[self.mask]
        scores = f"{float(chosen.min()):.3g} to {float(chosen.max()):.3g}" if len(chosen) else None
        count = f"{len(self):,} of {len(self.mask):,} Gaussians"
        return html_card("Selection", {"selected": count, "scores": scores, "how": self.summary})

    @property
    def indices(self) -> Tensor:  # [n] int64
        """The selected Gaussians, ascending."""
        return self.mask.nonzero()[:, 0]

    @property
    def summary(self) -> str:
        """How it was made and its threshold, in words."""
        return self.how if self.threshold is None else f"score > {self.threshold:.4g} ({self.how})"

    def points(self, cloud: Gaussians | Tensor) -> Array:  # [n, 3] float64
        """The centres of the selected Gaussians in world units; `cloud` is their cloud, or positions [N, 3]."""
        means = to_world(cloud.means, cloud.origin) if isinstance(cloud, Gaussians) else as_tensor("cloud", cloud)
        check_shapes(("selection.mask", self.mask, "N"), ("cloud", means, "N 3"))
        return positions("cloud", means[self.mask])

    def box(self, cloud: Gaussians | Tensor) -> OrientedBox:
        """A small box around `points`; a ValueError if nothing is selected."""
        return OrientedBox.around(torch.from_numpy(self.points(cloud)))

    def within(self, mask: Tensor, how: str) -> Selection:  # mask: [N] bool
        """The part of this selection under a mask, with the same scores and threshold; `how` is added to the summary."""
        check_shapes(("selection.mask", self.mask, "N"), ("mask", mask, "N"))
        return Selection(self.mask & mask, self.scores, self.threshold, f"{self.how}; {how}" if self.how else how)

    def __and__(self, other: Selection) -> Selection:
        scores = torch.minimum(*self._both_scores(other))
        return Selection(self.mask & other.mask, scores, None, f"({self.summary}) and ({other.summary})")

    def __or__(self, other: Selection) -> Selection:
        scores = torch.maximum(*self._both_scores(other))
        return Selection(self.mask | other.mask, scores, None, f"({self.summary}) or ({other.summary})")

    def __invert__(self) -> Selection:
        return Selection(~self.mask, 1 - self.scores, None, f"not ({self.summary})")

    def __sub__(self, other: Selection) -> Selection:
        self._both_scores(other)
        return self & ~other

    def _both_scores(self, other: Selection) -> tuple[Tensor, Tensor]:
        """Both scores in one dtype, after a check that both select among the same Gaussians."""
        if not isinstance(other, Selection):
            raise TypeError(
                f"other: expected a Selection, got {type(other).__name__}; make one with Selection.of(mask)"
            )
        if len(self.mask) != len(other.mask):
            raise ValueError(
                f"other: expected a selection among the same {len(self.mask)} Gaussians, got one among "
                f"{len(other.mask)}; select in the same cloud, or carry the labels over with transfer_labels"
            )
        dtype = torch.promote_types(self.scores.dtype, other.scores.dtype)
        return self.scores.to(dtype), other.scores.to(self.scores.device, dtype)
