"""What a camera sees of a semantic field: class per pixel, best classes, and how well a text fits.

Blending is linear. So where a pixel's class follows from blended features, K dot products per Gaussian are blended in place
of the features, and the largest is kept while they are: nothing of [H, W, D] or [H, W, K] is in memory. These products, or
votes, depend on the text alone; the last ones of each field are kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_choice, check_whole
from .._rows import row_norms, unit_embeddings
from .._typed import typed
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import LOGIT_SCALES, label_pixels
from ..labels.questions import Classes
from ..splat import Ranked, rasterize_labels

if TYPE_CHECKING:
    from .semantic_field import SemanticField

Rule = Literal["fused", "paper"]


class Votes(NamedTuple):
    """What the Gaussians say about some classes."""

    classes: Tensor  # [W] int64, which
    shares: Tensor  # [N, W], positive; 0 of a Gaussian about which nothing is known

    def __repr__(self) -> str:
        return short_repr(self)


LEAST_SHARE = 1e-30
"""A smaller share of a vote counts as none: blended, it would be a denormal number, with which a CPU takes ten times as long."""

_KEPT: WeakKeyDictionary[Any, tuple[Any, Tensor, Votes]] = WeakKeyDictionary()
"""For each field: the rule, the text, and the votes that follow from them."""


def divide_votes(cosines: Tensor, known: Tensor) -> Votes:  # [N, C], [N] bool
    """Each Gaussian divides one vote among the classes: the softmax of 100 times the cosines, CLIP's scale.

    A class that no Gaussian prefers gets no vote: it would win pixels where it is second everywhere.
    """
    with torch.no_grad():
        classes = cosines.argmax(dim=1)[known].unique()
        shares = torch.softmax(LOGIT_SCALES["clip"] * cosines[:, classes], dim=1) * known[:, None]
        return Votes(classes, torch.nn.functional.threshold(shares, LEAST_SHARE, 0))


def rank_votes(gaussians: Gaussians, camera: Camera, votes: Votes, top: int = 1, *, early: bool = False) -> Ranked:
    """The classes with most votes at each pixel; votes are blended like colours. Beyond the classes voted for: -1, 0.

    `early` is that of `rasterize_labels`.
    """
    if not len(votes.classes):  # nothing is known about any Gaussian: no votes for one class, and the opacity
        votes = Votes(votes.classes.new_zeros(1), votes.shares.new_zeros(len(votes.shares), 1))
    found = min(top, len(votes.classes))
    with torch.no_grad():
        shown = gaussians.replace(features=votes.shares, sh=None)
        labels, scores, alphas = rasterize_labels(shown, camera, top=found, early=early)
        if len(votes.classes) <= int(votes.classes[-1]):  # else they are all classes, in order
            labels = votes.classes[labels]
        labels.masked_fill_(scores <= 0, -1)
    if found < top:
        labels = torch.nn.functional.pad(labels, (0, top - found), value=-1)
        scores = torch.nn.functional.pad(scores, (0, top - found))
    return Ranked(labels, scores, alphas)


def rank_classes(
    field: SemanticField, camera: Camera, rows: Tensor, rule: Rule, top: int = 1, *, early: bool = False
) -> Ranked:
    """The best classes of each pixel by the rule of `SemanticField.segment`, and their scores.

    Args:
        field: any.
        camera: any viewpoint.
        rows: embeddings [C, D].
        rule: see `SemanticField.segment`.
        top: how many, from 1 to C.
        early: as in `rasterize_labels`, where votes are blended.

    Returns:
        Labels and scores [H, W, top], the best first, and alphas [H, W]. Labels are -1 and scores 0 where nothing is drawn or
        known, and for classes without a vote. What a score is depends on the rule: blended votes, in [0, 1]; of a field with
        codewords, the cosine of the pixel's codeword; else, by the rule "paper", the blended dot product of feature and
        class plus twice the blended length of the features, which only compares the classes of one pixel.

    Raises:
        ValueError: if `rule` is unknown, or `top` is out of range.
    """
    check_choice("rule", rule, get_args(Rule))
    check_whole("top", top, 1, len(rows))
    if field.codebook is None or field.method == "fused" or (rule == "fused" and field.autoencoder is None):
        return rank_votes(field.gaussians, camera, _votes(field, rows, rule), top, early=early)
    rendering = field.render(camera)
    index = label_pixels(
        rendering.map,
        field.codebook,
        torch.arange(field.codebook.size),
        field.autoencoder,
        decode="exact" if rule == "paper" else "latent",
        covered=rendering.alpha > 0,
    )
    table = field.codeword_labels(rows)
    scores, labels = table.similarity.sort(dim=1, descending=True, stable=True)
    empty = ((index < 0) | (table.labels < 0)[index])[..., None]
    found = labels[:, :top][index].masked_fill_(empty, -1), scores[:, :top][index].masked_fill_(empty, 0)
    return Ranked(*found, rendering.alpha)


@typed
def score_pixels(
    field: SemanticField, camera: Camera, target: str | Tensor, classes: Classes | None = None, **options: Any
) -> Ranked:
    """How well each pixel fits one thing: the mean score of the Gaussians that it shows, by how much it shows of each.

    Args:
        field: any.
        camera: any viewpoint.
        target: the name of a class, or an embedding [D].
        classes: as in `SemanticField.query`.
        options: the other keyword arguments of `SemanticField.query`, but no threshold.

    Returns:
        Scores [H, W, 1] (by default relevancies, above 0.5 where the target fits best) and alphas [H, W]. Labels are 0, and
        -1 where nothing was drawn.

    Raises:
        ValueError: as `SemanticField.query`.
    """
    scores = field.query(target, classes, 0.0, **options).scores
    seen = rasterize_labels(field.gaussians.replace(features=scores[:, None].contiguous(), sh=None), camera)
    return seen._replace(scores=seen.scores / seen.alphas[..., None].clamp_min(1e-6))


def _votes(field: SemanticField, rows: Tensor, rule: Rule) -> Votes:
    """The votes of a field's Gaussians; those for the last text are kept."""
    features = field.features
    key = rule, None if features.is_inference() else features._version  # changed in place: votes are counted again
    kept = _KEPT.get(field)
    if kept is not None and None not in key and kept[0] == key and _same(kept[1], rows):
        return kept[2]
    if rule == "fused" and field.method == "fused":
        votes = divide_votes(field.cosines(rows), field.known)
    else:
        votes = _similarity(field, rows)
    _KEPT[field] = key, rows.detach().clone(), votes
    return votes


def _same(one: Tensor, other: Tensor) -> bool:
    return (one.dtype, one.device) == (other.dtype, other.device) and torch.equal(one, other)


def _similarity(field: SemanticField, rows: Tensor) -> Votes:
    """Dot products of the features with the unit rows: the largest of the blended ones is that of the blended feature.

    The same number is added for all classes, twice the feature's length: it changes no order, and makes all positive.
    """
    with torch.no_grad():
        unit = unit_embeddings(rows).to(field.features)
        if field.linear is not None and field.method == "fused":
            unit = unit @ field.linear.basis.to(unit)
        shares = field.features @ unit.T + 2 * row_norms(field.features)[:, None]
        return Votes(torch.arange(len(rows), device=shares.device), shares)
