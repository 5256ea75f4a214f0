"""Classify features: the most similar of several classes, or a threshold for one class (Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes, check_whole
from .._rows import EPS, check_directions, check_finite, row_norms, unit_embeddings, unit_rows
from .components import component_numbers
from .scores import Score, select_by_similarity
from .selection import Selection

CHUNK = 65_536  # rows per step: with 200 classes, 50 MB of similarities at a time


class CodewordLabels(NamedTuple):
    """The class of each codeword, and the similarities behind it."""

    labels: Tensor  # [K] int64, -1 = none
    similarity: Tensor  # [K, C] cosine with each class

    def __repr__(self) -> str:
        return short_repr(self)


class Classification(NamedTuple):
    """The class of each feature and its cosine with that class."""

    labels: Tensor  # [N] int64, -1 = none
    scores: Tensor  # [N] cosine with the winning class; 0 if there is none

    def __repr__(self) -> str:
        return short_repr(self)


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
    codewords = as_tensor("codewords", codewords, floating=True)
    embeddings = as_tensor("embeddings", embeddings, floating=True)
    check_shapes(("codewords", codewords, "K D"), ("embeddings", embeddings, "C D"))
    classes = unit_embeddings(embeddings)
    check_directions("codewords", codewords)
    with torch.no_grad():
        similarity = unit_rows(codewords) @ classes.T.to(codewords)
        return CodewordLabels(_best(codewords, similarity).labels, similarity)


def classify(
    features: Tensor,  # [N, D]
    embeddings: Tensor,  # [C, D]
) -> Classification:
    """Give each feature the class of the most similar embedding, by cosine (Sec. 3.4, max-similarity).

    Runs in chunks, without a table [N, C]. A tie goes to the lowest class; an all-zero feature has label -1.

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
    features = as_tensor("features", features, floating=True)
    embeddings = as_tensor("embeddings", embeddings, floating=True)
    check_shapes(("features", features, "N D"), ("embeddings", embeddings, "C D"))
    classes = unit_embeddings(embeddings).T.to(features)
    check_directions("features", features)
    with torch.no_grad():
        parts = [_best(rows, unit_rows(rows) @ classes) for rows in features.split(CHUNK)]
    return Classification(torch.cat([part.labels for part in parts]), torch.cat([part.scores for part in parts]))


def select_by_query(
    features: Tensor,  # [N, D]
    query: Tensor,  # [D]
    threshold: float | None = None,
    negatives: Tensor | None = None,  # [M, D]
    *,
    score: Score | None = None,
    logit_scale: float | str = "clip",
) -> Selection:
    """Select the features whose cosine with one query is **above** a threshold, the paper's gamma (Sec. 3.4, single target).

    The paper gives no value for gamma. If you give none, it is the gap below the highest mode of the scores (see
    `similarity_threshold`), and `how` describes it. A scene without the target has a highest mode too, so check `how` and
    the scores before you trust an automatic gamma. With negatives (for instance the other classes of the scene) scores are
    relevancies, and gamma is 0.5.

    Args:
        features: decoded features; any scale. All-zero features score 0 and are never selected.
        query: the target's embedding, or a prototype.
        threshold: gamma, a cosine in [-1, 1], or with negatives a relevancy in [0, 1]; None finds it as above.
        negatives: embeddings of things that should not be found.
        score: "cosine", "softmax" or "relevancy" (`text_scores`); None: the relevancy with negatives, else the cosine.
        logit_scale: for the softmax, as in `text_scores`.

    Raises:
        ValueError: if shapes disagree, the query or a negative is all-zero, the threshold is out of range, or a number
            is not finite.
    """
    features, query = as_tensor("features", features, floating=True), as_tensor("query", query, floating=True)
    negatives = None if negatives is None else as_tensor("negatives", negatives, floating=True)
    check_shapes(("features", features, "N D"), ("query", query, "D"), ("negatives", negatives, "M D"))
    rows = unit_embeddings(query[None], "query").to(features)
    if negatives is not None:
        rows = torch.cat([rows, unit_embeddings(negatives, "negatives").to(features)])
    check_directions("features", features)
    with torch.no_grad():
        similarity = torch.cat([unit_rows(part) @ rows.T for part in features.split(CHUNK)])
        something = row_norms(features) > EPS
    against = None if negatives is None else similarity[:, 1:]
    return select_by_similarity(similarity[:, 0], against, threshold, something, score=score, logit_scale=logit_scale)


def select_by_category(
    features: Tensor,  # [N, D]
    embeddings: Tensor,  # [C, D]
    category: int,
) -> Selection:
    """Select the features for which one class wins among all (Sec. 3.4, max-similarity): no threshold is needed.

    Args:
        features: decoded features; any scale.
        embeddings: one row per class, in class order.
        category: which class.

    Returns:
        The Gaussians that `classify` gives this class; scores are its cosine for these and 0 for the others.

    Raises:
        ValueError: as `classify`, or if `category` is not a class index.
    """
    found = classify(features, embeddings)
    check_whole("category", category, 0, len(embeddings) - 1)
    mask = found.labels == category
    return Selection(mask, found.scores * mask, None, f"class {category} wins among {len(embeddings)}")


def select_like(
    features: Tensor,  # [N, D]
    like: int | Tensor,  # an index, indices [n] int64, or a mask [N] bool
    threshold: float | None = None,
    negatives: Tensor | None = None,  # [M, D]
) -> Selection:
    """Select the features similar to some examples: the query is the mean of their unit vectors (a prototype).

    Args:
        features: decoded features; any scale.
        like: which Gaussians are the examples.
        threshold: as in `select_by_query`.
        negatives: as in `select_by_query`.

    Raises:
        ValueError: as `select_by_query`, or if there are no examples or an index is out of range.
    """
    features = as_tensor("features", features, floating=True)
    check_shapes(("features", features, "N D"))
    rows = torch.atleast_1d(as_tensor("like", like)).to(features.device)
    rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool and len(rows) == len(features) else rows
    if rows.dtype.is_floating_point or rows.dtype == torch.bool or rows.ndim != 1 or len(rows) == 0:
        raise ValueError(f"like: expected at least one index below {len(features)}, got {like!r}; name some examples")
    if int(rows.min()) < 0 or int(rows.max()) >= len(features):
        raise ValueError(
            f"like: expected indices from 0 to {len(features) - 1}, got {int(rows.min())} to {int(rows.max())}; "
            "take them from this cloud"
        )
    return select_by_query(features, unit_rows(features[rows]).mean(dim=0), threshold, negatives)


def select_near(
    means: Tensor,  # [N, 3]
    point: Sequence[float] | Tensor,  # [3]
    *,
    labels: Tensor | None = None,  # [N] int64
    features: Tensor | None = None,  # [N, D]
    threshold: float | None = None,
    distance: float | None = None,
) -> Selection:
    """Select the thing at a point (a click): the Gaussians that are similar to the nearest one and connected with it.

    With `labels`, similar Gaussians have the same label; with `features`, their cosine is above `threshold`.

    Args:
        means: positions of all N Gaussians.
        point: a position in the world, for instance under the mouse.
        labels: a class for each Gaussian; give these or features.
        features: decoded features.
        threshold: gamma, a cosine; only with features. None as in `select_by_query`.
        distance: see `component_numbers`.

    Returns:
        The connected part that contains the nearest Gaussian (the lowest index, if several are equally near).

    Raises:
        ValueError: if neither or both of labels and features are given, the nearest Gaussian has no label or an all-zero
            feature, there is no Gaussian, shapes disagree, or a number is not finite.
    """
    means = as_tensor("means", means)
    labels, features = (
        None if values is None else as_tensor(name, values)
        for name, values in (("labels", labels), ("features", features))
    )
    check_shapes(("means", means, "N 3"), ("labels", labels, "N"), ("features", features, "N D"))
    if (labels is None) == (features is None):
        raise ValueError(
            "labels, features: expected one of them, got none or both; labels define which Gaussians are similar"
        )
    nearest = _nearest(means, point)
    if labels is not None:
        label = int(labels[nearest])
        if label < 0:
            raise ValueError(
                f"labels: expected a label at the nearest Gaussian, got {label} (none) at {nearest}; click elsewhere, or "
                "pass features"
            )
        alike = Selection.of(labels == label, f"label {label}")
    else:
        assert features is not None
        alike = select_like(features, nearest, threshold)
        if not bool(alike.mask[nearest]):  # at a threshold of 1 nothing is above it, not even itself
            alike = Selection(alike.mask | (alike.scores >= alike.scores[nearest]), alike.scores, None, alike.summary)
    numbers = component_numbers(means, alike.mask, distance)
    return alike.within(numbers == numbers[nearest], f"connected with Gaussian {nearest}, the nearest to the point")


def _nearest(means: Tensor, point: Sequence[float] | Tensor) -> int:
    place = torch.as_tensor(point, dtype=torch.float64, device=means.device)
    check_shapes(("point", place, "3"))
    check_finite("point", place)
    check_finite("means", means)
    if len(means) == 0:
        raise ValueError("means: expected at least one Gaussian, got none; load a cloud that is not empty")
    return int(((means.double() - place) ** 2).sum(dim=1).argmin())


def _best(features: Tensor, similarity: Tensor) -> Classification:
    """Row-wise winner (the first of equals); all-zero features have none."""
    scores, labels = similarity.max(dim=-1)
    nothing = row_norms(features) <= EPS
    return Classification(labels.masked_fill(nothing, -1), scores.masked_fill(nothing, 0))
