"""Selections of Gaussians with scores, the operators that combine them, and the selection of what is like a query."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from .._card import cut, html_card
from .._check import as_tensor, check_choice, check_range, check_shapes
from .._origin import to_world
from .._rows import check_finite
from ..gaussians import Gaussians
from .boxes import OrientedBox
from .nearest import Array, positions
from .scores import EVEN, LOGIT_SCALE, TEMPERATURE, Score, similarity_threshold


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
        if not (isinstance(self.mask, Tensor) and isinstance(self.scores, Tensor)):
            object.__setattr__(self, "mask", as_tensor("mask", self.mask))
            object.__setattr__(self, "scores", as_tensor("scores", self.scores))
        if self.mask.ndim != 1 or self.mask.shape != self.scores.shape:
            check_shapes(("mask", self.mask, "N"), ("scores", self.scores, "N"))
        if self.mask.dtype != torch.bool:
            raise TypeError(f"mask: expected a boolean mask, got {self.mask.dtype}; compare first, as in labels == 3")
        if not bool(torch.isfinite(self.scores).all()):
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


def relevancy(
    similarity: Tensor,  # [N]
    negatives: Tensor,  # [N, M]
) -> Tensor:  # [N] in (0, 1)
    """LERF's relevancy (Kerr 2023, Sec. 3.4): how much more similar to the query than to the most similar negative.

    min over j of the first entry of softmax(10 [s, n_j]), which is sigmoid(10 (s - max_j n_j)). Above 0.5 the query is
    more similar than every negative. LERF's negatives are the texts in `CANONICAL`; other classes of the scene are better
    if they are known.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each of M >= 1 negatives.

    Raises:
        ValueError: if shapes disagree, there is no negative, or a number is not finite.

    Example:
        >>> relevancy(torch.tensor([0.9, 0.3]), torch.tensor([[0.2, 0.9], [0.1, 0.2]])).tolist()
        [0.5, 0.7310585975646973]
    """
    _check_cosines(similarity, negatives)
    return torch.sigmoid(TEMPERATURE * (similarity - negatives.amax(dim=1)))


def select_by_similarity(
    similarity: Tensor,  # [N]
    negatives: Tensor | None = None,  # [N, M]
    threshold: float | None = None,
    valid: Tensor | None = None,  # [N] bool
    *,
    score: Score | None = None,
    logit_scale: float = LOGIT_SCALE,
) -> Selection:
    """Select the Gaussians with a score above gamma; the score is the cosine, or with negatives the relevancy.

    If gamma is not given, `similarity_threshold` finds it in the scores. For a relevancy it is 0.5: more similar to the
    query than to any negative. On room_0 (scores averaged over 30 views, all other classes as negatives; mean IoU over 18
    classes with the data set's labels): cosine 0.88, relevancy 0.90, softmax 0.92.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each negative (words to exclude), or None.
        threshold: gamma; a cosine in [-1, 1], or another score in [0, 1].
        valid: Gaussians whose feature is not all-zero; the others are not selected, score 0, and do not influence gamma.
        score: "cosine", in [-1, 1]; "relevancy", in (0, 1); or "softmax": the query's entry of
            softmax(l [s, n_1, ..., n_M]), its share among all words. None: the relevancy with negatives, else the cosine.
        logit_scale: l of the softmax; a larger one is sharper.

    Raises:
        ValueError: if shapes disagree, negatives are missing, a number is not finite, or an option is out of range.
    """
    _check_cosines(similarity, negatives, valid)
    score = score or ("cosine" if negatives is None else "relevancy")
    if score not in get_args(Score):
        check_choice("score", score, get_args(Score))
    if threshold is not None:
        check_range("threshold", threshold, -1 if score == "cosine" else 0, 1)
    if score == "cosine":
        scores = similarity
    elif negatives is None:
        raise ValueError(f"negatives: expected some for score {score!r}, got none; pass words that are not meant")
    elif score == "relevancy":
        scores = torch.sigmoid(TEMPERATURE * (similarity - negatives.amax(dim=1)))
    else:
        check_range("logit_scale", logit_scale, 0, closed=(False, True))
        scores = (logit_scale * torch.cat([similarity[:, None], negatives], dim=1)).softmax(dim=1)[:, 0]
    known = torch.ones_like(similarity, dtype=torch.bool) if valid is None else valid
    scores = scores.masked_fill(~known, 0)
    if threshold is not None:
        gamma, how = float(threshold), "given"
    elif score == "relevancy":
        assert negatives is not None
        gamma, how = EVEN, f"more like the query than like any of {negatives.shape[1]} negatives"
    else:
        gamma, how = similarity_threshold(scores[known])
    if score == "softmax":
        assert negatives is not None
        how += f"; softmax over {1 + negatives.shape[1]} words, logit scale {logit_scale:.4g}"
    return Selection((scores > gamma) & known, scores, gamma, how)


def _check_cosines(similarity: Tensor, negatives: Tensor | None, valid: Tensor | None = None) -> None:
    """Raise a ValueError if shapes disagree, there is no negative, or a number is not finite."""
    shapes = (
        similarity.shape,
        None if negatives is None else negatives.shape[:1],
        None if valid is None else valid.shape,
    )
    if similarity.ndim != 1 or any(shape not in (None, similarity.shape) for shape in shapes):
        check_shapes(("similarity", similarity, "N"), ("negatives", negatives, "N M"), ("valid", valid, "N"))
    if negatives is not None and (negatives.ndim != 2 or negatives.shape[1] == 0):
        check_shapes(("negatives", negatives, "N M"))
        raise ValueError("negatives: expected at least one column, got none; pass what the query should not find")
    for name, values in (("similarity", similarity), ("negatives", negatives)):
        if values is not None and not bool(torch.isfinite(values).all()):
            check_finite(name, values)
