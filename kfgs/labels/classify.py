"""Which class does a feature belong to: max-similarity among several classes, a threshold for one (Sec. 3.4)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._check import check_range, check_shapes
from ..quant.codebook import EPS, row_norms, unit_rows
from ._rows import check_finite, unit_embeddings
from .selection import Selection
from .threshold import similarity_threshold

CHUNK = 65_536  # rows per step: with 200 classes, 50 MB of similarities at a time


class CodewordLabels(NamedTuple):
    """The class of each codeword, and why."""

    labels: Tensor  # [K] int64, -1 = none
    similarity: Tensor  # [K, C] cosine with each class


class Classification(NamedTuple):
    """The class of each feature and its cosine with that class."""

    labels: Tensor  # [N] int64, -1 = none
    scores: Tensor  # [N] cosine with the winning class; 0 where there is none


def label_codewords(
    codewords: Tensor,  # [K, D]
    embeddings: Tensor,  # [C, D]
) -> CodewordLabels:
    """Label each codeword with the class whose text (or prototype) embedding is most similar to it (Sec. 3.4).

    Args:
        codewords: the semantic codebook S.
        embeddings: one row per class, in class order; any scale.

    Returns:
        Labels and the full table of similarities. A tie goes to the lowest class; an all-zero codeword, whose cosine is
        0 with everything, has label -1.

    Raises:
        ValueError: if shapes disagree, there is no class, an embedding is all-zero, or a number is not finite.
    """
    check_shapes(("codewords", codewords, "K D"), ("embeddings", embeddings, "C D"))
    classes = unit_embeddings(embeddings)
    check_finite("codewords", codewords)
    with torch.no_grad():
        similarity = unit_rows(codewords) @ classes.T.to(codewords)
        return CodewordLabels(_best(codewords, similarity).labels, similarity)


def classify(
    features: Tensor,  # [N, D]
    embeddings: Tensor,  # [C, D]
) -> Classification:
    """Give each feature the class of the most similar embedding, by cosine (Sec. 3.4, max-similarity).

    Runs in chunks, so the [N, C] table is never held. A tie goes to the lowest class; an all-zero feature has label -1.

    Args:
        features: decoded features, of Gaussians or of pixels; any scale.
        embeddings: one row per class, in class order; any scale.

    Returns:
        Labels [N] and the winning similarities [N]; both empty when N = 0.

    Raises:
        ValueError: if shapes disagree, there is no class, an embedding is all-zero, or a number is not finite.

    Example:
        >>> import torch
        >>> classify(torch.tensor([[2.0, 0.0], [0.1, 0.3], [0.0, 0.0]]), torch.eye(2)).labels.tolist()
        [0, 1, -1]
    """
    check_shapes(("features", features, "N D"), ("embeddings", embeddings, "C D"))
    classes = unit_embeddings(embeddings).T.to(features)
    check_finite("features", features)
    with torch.no_grad():
        parts = [_best(rows, unit_rows(rows) @ classes) for rows in features.split(CHUNK)]
    return Classification(torch.cat([part.labels for part in parts]), torch.cat([part.scores for part in parts]))


def select_by_query(
    features: Tensor,  # [N, D]
    query: Tensor,  # [D]
    threshold: float | None = None,
) -> Selection:
    """Select the features whose cosine with one query is **above** a threshold (Sec. 3.4, single target).

    The paper publishes no value for its threshold gamma. Without one, it is taken from the scores: the gap below their
    highest mode (see `similarity_threshold`), and `how` says what was found. A scene that does not contain the target
    has a highest mode as well, so look at `how` and at the scores before trusting an automatic gamma.

    Args:
        features: decoded features; any scale. All-zero features score 0 and are never selected.
        query: the target's embedding.
        threshold: gamma, a cosine in [-1, 1]; None takes it from the scores.

    Raises:
        ValueError: if shapes disagree, the query is all-zero, the threshold is no cosine, or a number is not finite.
    """
    check_shapes(("features", features, "N D"), ("query", query, "D"))
    target = unit_embeddings(query[None], "query")[0].to(features)
    check_finite("features", features)
    with torch.no_grad():
        scores = torch.cat([unit_rows(rows) @ target for rows in features.split(CHUNK)])
        something = row_norms(features) > EPS
    if threshold is None:
        gamma, how = similarity_threshold(scores[something])
    else:
        check_range("threshold", threshold, -1, 1)
        gamma, how = float(threshold), "given"
    return Selection((scores > gamma) & something, scores, gamma, how)


def _best(features: Tensor, similarity: Tensor) -> Classification:
    """Row-wise winner (the first of equals); all-zero features have none."""
    scores, labels = similarity.max(dim=-1)
    nothing = row_norms(features) <= EPS
    return Classification(labels.masked_fill(nothing, -1), scores.masked_fill(nothing, 0))
