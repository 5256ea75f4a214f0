"""From cosines with words to scores, and from scores to a selection (Sec. 3.4)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from .._check import check_choice, check_range, check_shapes
from .._rows import check_finite
from .relevancy import relevancy
from .selection import Selection
from .threshold import similarity_threshold

EVEN = 0.5  # relevancy of what is as much like the query as like its nearest negative
LOGIT_SCALES = {
    "raw": 1.0,  # Feature 3DGS's editing: nearly uniform
    "lseg": 1 / 0.07,  # 14.2857, which LSeg was trained with
    "clip": 100.0,  # where CLIP's training ended
}
Score = Literal["cosine", "softmax", "relevancy"]


def text_scores(
    similarity: Tensor,  # [N]
    negatives: Tensor | None = None,  # [N, M]
    valid: Tensor | None = None,  # [N] bool
    *,
    score: Score | None = None,
    logit_scale: float | str = "clip",
) -> Tensor:  # [N]
    """How well N features fit a query, from their cosines with it and with what it is to be told from.

    - "cosine": the cosine itself, in [-1, 1]; negatives play no part.
    - "softmax": the query's entry of softmax(l [s, n_1, ..., n_M]), in (0, 1): its share among all words. **Convention**:
      l multiplies the cosines (CLIP's logit scale), so a larger one is sharper; it is 1 / temperature.
    - "relevancy": LERF's `relevancy`, in (0, 1): against the most similar negative alone.

    Measured on room_0 (LSeg-like teacher, scores averaged over 30 views, all other classes as negatives, gamma as
    `select_by_similarity` finds it; mean IoU over 18 classes with the data set's labels): cosine 0.88, relevancy 0.90,
    softmax 0.84 "raw", 0.86 "lseg", 0.92 "clip".

    Args:
        similarity: cosine with the query.
        negatives: cosine with each negative.
        valid: features that know anything at all (not all-zero); the others score 0.
        score: which; when not given the relevancy with negatives, the cosine without.
        logit_scale: of the softmax: a positive number, or one of "raw" (1: Feature 3DGS), "lseg" (14.29), "clip" (100).

    Raises:
        ValueError: if shapes disagree, negatives are missing, a number is not finite, or an option is unknown.

    Example:
        >>> import torch
        >>> text_scores(torch.tensor([0.9]), torch.tensor([[0.9, 0.9]]), score="softmax").tolist()
        [0.3333333432674408]
    """
    check_shapes(("similarity", similarity, "N"), ("negatives", negatives, "N M"), ("valid", valid, "N"))
    check_finite("similarity", similarity)
    if score is None:
        score = "cosine" if negatives is None else "relevancy"
    check_choice("score", score, ("cosine", "softmax", "relevancy"))
    if score == "cosine":
        scores = similarity
    elif negatives is None:
        raise ValueError(
            f"negatives: expected some for score {score!r}, got none; pass what the query is to be told from"
        )
    elif score == "relevancy":
        scores = relevancy(similarity, negatives)
    else:
        check_finite("negatives", negatives)
        logits = _scale(logit_scale) * torch.cat([similarity[:, None], negatives], dim=1)
        scores = logits.softmax(dim=1)[:, 0]
    return scores if valid is None else scores.masked_fill(~valid, 0)


def select_by_similarity(
    similarity: Tensor,  # [N]
    negatives: Tensor | None = None,  # [N, M]
    threshold: float | None = None,
    valid: Tensor | None = None,  # [N] bool
    *,
    score: Score | None = None,
    logit_scale: float | str = "clip",
) -> Selection:
    """Select what is more similar than a threshold; with negatives, what is more relevant than one.

    Of a cosine or a softmax gamma is read off the scores when not given (`similarity_threshold`). Of a relevancy it is 0.5
    when not given: more like the query than like any of the negatives.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each negative, or None.
        threshold: gamma; a cosine in [-1, 1], or another score in [0, 1].
        valid: Gaussians that know anything at all; the others are not selected, score 0, and do not shape gamma.
        score: as in `text_scores`.
        logit_scale: as in `text_scores`.

    Raises:
        ValueError: as `text_scores`, or if the threshold is out of range.
    """
    scores = text_scores(similarity, negatives, valid, score=score, logit_scale=logit_scale)
    known = torch.ones_like(similarity, dtype=torch.bool) if valid is None else valid
    relevant = score == "relevancy" or (score is None and negatives is not None)
    cosine = not relevant and score != "softmax"
    if threshold is not None:
        check_range("threshold", threshold, -1 if cosine else 0, 1)
        gamma, how = float(threshold), "given"
    elif relevant:
        assert negatives is not None
        gamma, how = EVEN, f"more like the query than like any of {negatives.shape[1]} negatives"
    else:
        gamma, how = similarity_threshold(scores[known])
    if score == "softmax":
        assert negatives is not None
        how += f"; softmax over {1 + negatives.shape[1]} words, logit scale {_scale(logit_scale):.4g}"
    return Selection((scores > gamma) & known, scores, gamma, how)


def _scale(logit_scale: float | str) -> float:
    if isinstance(logit_scale, str):
        check_choice("logit_scale", logit_scale, LOGIT_SCALES)
        return LOGIT_SCALES[logit_scale]
    check_range("logit_scale", logit_scale, 0, closed=(False, True))
    return float(logit_scale)
