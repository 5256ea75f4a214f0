"""Answers to questions: a field answers any text (Sec. 3.4), a labelled splat its classes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._check import class_indices
from ..cameras import Camera
from ..fields import Linear, SemanticField, fuse_views
from ..gaussians import Gaussians
from ..labels import LabelSet, OfClass, Selection
from ..labels.label_set import class_rows, make_question
from ..labels.selection import class_names

UNIT = (0.0, 1.0)
KEPT = 0.9  # of a selection, by the suggested gamma of what is like it
MOST_COMPARED = 2000  # features of a selection whose mean is taken


class Asked(NamedTuple):
    """A question and its answer: a score for each Gaussian, and the gamma that it suggests."""

    words: str  # as asked; for a class, in the spelling of the class list
    selection: Selection  # its threshold is the suggested gamma
    low: float  # the smallest useful gamma: 0 for a relevancy, else the lowest score
    high: float  # the largest useful gamma: 1, or the highest score
    known: bool  # whether it is one of the classes
    valid: Tensor  # [N] bool, whether anything is known about a Gaussian; the others are never selected

    def packed(self) -> tuple[dict[str, Any], bytes]:
        """The answer for the browser, and its scores, float32: NaN where nothing is known."""
        own = self.selection
        answer = {"words": self.words, "gamma": own.threshold, "how": own.how, "low": self.low, "high": self.high}
        return answer, torch.where(self.valid, own.scores, torch.nan).cpu().numpy().astype("<f4").tobytes()


class FieldMeaning:
    """A semantic field: labels come from `SemanticField.classify`, answers and gamma from `SemanticField.query`.

    Args:
        field: a finished field.
        classes: names and embeddings in the teacher's space; None: those that the field remembers.
        cameras: the training views, to compute fused features if the field has none (`fields.fuse_views`); empty: the
            field's own. Without any view, each Gaussian's own latent decides, as in the paper.
        embed: the teacher's text encoder, text -> [D]; without it only classes can be asked.
    """

    examples = True

    def __init__(
        self,
        field: SemanticField,
        classes: LabelSet | None = None,
        *,
        cameras: Sequence[Camera] = (),
        embed: Callable[[str], Tensor] | None = None,
    ) -> None:
        classes = field.classes if classes is None else classes
        if classes is None:
            raise ValueError("classes: expected a label set, got none, and the field holds none; pass the classes")
        class_rows(classes, field.dim, field.info)  # checks them before views are rendered
        self._classes = replace(classes, info={})  # the teachers were compared just now: warn once, not per question
        views = list(cameras or field.cameras)
        self.by = "each Gaussian's own latent (Sec. 3.4)"
        if field.fused is not None or isinstance(field.decoder, Linear):
            self.by = "what the training views show of each Gaussian"
        elif views:
            field, self.by = fuse_views(field, views), f"what {len(views)} views show of each Gaussian"
        self.field = field
        labels, self.scores = field.classify(self._classes)
        self._embed = embed
        self._answers: dict[str, Asked] = {}
        self.names, self.phrases = classes.names, embed is not None
        self.gaussians = field.gaussians.replace(labels=labels)

    def ask(self, words: str) -> Asked:
        """Answer a class name or, with an encoder, any text. Answers are cached."""
        words = words if words in self.names else words.strip()
        known = self._classes.knows(words)
        if known:
            words = self.names[self._classes.index(words)]
        if words not in self._answers:
            target = words if known else self._phrase(words)
            selection = self.field.query(target, self._classes)
            rows = make_question(target, self._classes, "auto", self.field.dim, {})
            self._answers[words] = _asked(words, selection, self.field.known, len(rows) > 1, known)
        return self._answers[words]

    def similar(self, mask: Tensor) -> Asked:  # [N] bool
        """Compare with the mean direction of some Gaussians' features, by cosine; the suggested gamma keeps nine of ten."""
        field = self.field
        chosen = mask.to(field.known.device) & field.known
        if not bool(chosen.any()):
            raise ValueError("selection: expected Gaussians with features, got none; select others, or raise lambda")
        rows = chosen.nonzero()[:, 0]
        features = field.features_of(rows[:: max(1, len(rows) // MOST_COMPARED)])
        target = torch.nn.functional.normalize(features, dim=1).mean(0)
        scores = field.query(target, self._classes, score="cosine").scores
        gamma = float(scores[chosen].quantile(1 - KEPT))
        how = f"{KEPT:.0%} of the selection are more like it"
        selection = Selection(field.known & (scores > gamma), scores, gamma, how)
        return _asked("like the selection", selection, field.known, False, False)

    def _phrase(self, words: str) -> Tensor:  # [D]
        if self._embed is None or not words:
            try:
                self._classes.index(words)
            except ValueError as error:  # its message lists the classes and similar names
                more = "" if self.phrases else "; other words need the teacher's text encoder (embed)"
                raise ValueError(f"{error}{more}") from None
        assert self._embed is not None
        target = torch.as_tensor(self._embed(words)).detach()
        if tuple(target.shape) != (self.field.dim,):
            raise ValueError(
                f"embed: expected [{self.field.dim}] (from the field) for {words!r}, got {tuple(target.shape)}; pass the "
                "text encoder of the field's teacher"
            )
        return target


class SplatMeaning:
    """A labelled splat: the answer to a class is its Gaussians, with the scores of the file, or 1 if it has none.

    Classes without a name are called "class 3". Without labels there is nothing to ask for, and all have no class.
    """

    phrases = examples = False

    def __init__(self, splats: Gaussians) -> None:
        labels = torch.full((len(splats),), -1) if splats.labels is None else splats.labels
        self.gaussians = splats.replace(labels=labels)
        self.names = () if splats.labels is None else class_names(splats)
        self.scores, self.by = torch.ones_like(self.gaussians.opacities), "the file's classes"
        if splats.scores is not None:  # scores that are not finite become the lowest finite one
            values = splats.scores.to(self.gaussians.means)
            finite = torch.isfinite(values)
            self.scores = torch.where(finite, values, values[finite].min() if bool(finite.any()) else 1.0)
            self.by += " and scores"
        self._answers: dict[str, Asked] = {}

    def ask(self, words: str) -> Asked:
        """Answer a class name; the suggested gamma lies below all scores of the class, so that all are selected."""
        if not self.names:
            raise ValueError(
                f"words: expected a splat with classes, got one without for {words!r:.80}; `kfgs attach` adds them"
            )
        words = self.names[class_indices(words if words in self.names else words.strip(), self.names)[0]]
        if words not in self._answers:
            member = OfClass(words).select(self.gaussians.replace(names=self.names)).mask
            scores = torch.where(member, self.scores, 0)
            own = scores[member]
            low, high = UNIT
            if len(own) and not (own.min() > 0 and own.max() <= 1):
                low, high = float(own.min()), float(own.max())
                # strictly below the lowest score, even after rounding to the precision of the scores
                below = float(torch.nextafter(own.min(), own.new_tensor(-torch.inf)))
                low = min(low - 0.01 * max(high - low, 1e-3), below)
            selection = Selection(member & (scores > low), scores, low, "all of the class")
            self._answers[words] = Asked(words, selection, low, high, True, member)
        return self._answers[words]

    def similar(self, mask: Tensor) -> Asked:  # [N] bool
        """Raises a ValueError: a splat has classes only."""
        raise ValueError("selection: expected a field, whose features can be compared, got a splat; search for a class")


Meaning = FieldMeaning | SplatMeaning
"""What both have: `gaussians` with labels, `names` in label order, `scores` of the labels, `by` (how they were found), `phrases`
and `examples` (whether they answer other words, and `similar`)."""


def _asked(words: str, selection: Selection, valid: Tensor, relevant: bool, known: bool) -> Asked:
    """Add the range of useful gammas."""
    if relevant or not bool(valid.any()):
        return Asked(words, selection, *UNIT, known, valid)
    own = selection.scores[valid]
    gamma = float(selection.threshold or 0.0)
    low, high = min(gamma, float(own.min())), max(gamma, float(own.max()))
    return Asked(words, selection, low, high if high > low else low + 1e-3, known, valid)
