"""From similarities to a selection: a cosine above gamma (Sec. 3.4), or a relevancy against negatives."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_range, check_shapes
from ._rows import check_finite
from .selection import Selection
from .threshold import similarity_threshold

TEMPERATURE = 10.0  # of the softmax, as LERF (Kerr 2023) uses it
EVEN = 0.5  # relevancy of what is as much like the query as like its nearest negative


def relevancy(
    similarity: Tensor,  # [N]
    negatives: Tensor,  # [N, M]
) -> Tensor:  # [N] in (0, 1)
    """How much more like the query than like the most similar negative, as LERF has it (Kerr 2023, Sec. 3.4).

    min over j of the first entry of softmax(10 [s, n_j]), which is sigmoid(10 (s - max_j n_j)). Above 0.5 the query is
    more similar than every negative. LERF's negatives are the texts "object", "things", "stuff" and "texture"; where the
    scene's other classes are known, they are the better ones.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each of M >= 1 negatives.

    Raises:
        ValueError: if shapes disagree, there is no negative, or a number is not finite.

    Example:
        >>> import torch
        >>> relevancy(torch.tensor([0.9, 0.3]), torch.tensor([[0.2, 0.9], [0.1, 0.2]])).tolist()
        [0.5, 0.7310585975646973]
    """
    check_shapes(("similarity", similarity, "N"), ("negatives", negatives, "N M"))
    if negatives.shape[1] == 0:
        raise ValueError("negatives: expected at least one column, got none; pass what the query should not find")
    check_finite("similarity", similarity)
    check_finite("negatives", negatives)
    return torch.sigmoid(TEMPERATURE * (similarity - negatives.amax(dim=1)))


def select_by_similarity(
    similarity: Tensor,  # [N]
    negatives: Tensor | None = None,  # [N, M]
    threshold: float | None = None,
    valid: Tensor | None = None,  # [N] bool
) -> Selection:
    """Select what is more similar than a threshold; with negatives, what is more relevant than one.

    Without negatives gamma is a cosine, read off the scores when not given (`similarity_threshold`). With negatives the
    score is the `relevancy`, and gamma is 0.5 when not given: more like the query than like any of them.

    Args:
        similarity: cosine with the query.
        negatives: cosine with each negative, or None.
        threshold: gamma; a cosine in [-1, 1], or a relevancy in [0, 1].
        valid: Gaussians that know anything at all; the others are not selected, score 0, and do not shape gamma.

    Raises:
        ValueError: if shapes disagree, the threshold is out of range, or a number is not finite.
    """
    check_shapes(("similarity", similarity, "N"), ("negatives", negatives, "N M"), ("valid", valid, "N"))
    check_finite("similarity", similarity)
    scores = similarity if negatives is None else relevancy(similarity, negatives)
    known = torch.ones_like(similarity, dtype=torch.bool) if valid is None else valid
    scores = scores.masked_fill(~known, 0)
    if threshold is not None:
        check_range("threshold", threshold, -1 if negatives is None else 0, 1)
        gamma, how = float(threshold), "given"
    elif negatives is None:
        gamma, how = similarity_threshold(scores[known])
    else:
        gamma, how = EVEN, f"more like the query than like any of {negatives.shape[1]} negatives"
    return Selection((scores > gamma) & known, scores, gamma, how)
