"""Answers to questions: a field answers any text (Sec. 3.4), a labelled splat its classes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor
from ..cameras import Camera
from ..formats import SplatFile
from ..formats.splat_file import SCORE
from ..gaussians import Gaussians
from ..labels import LabelSet, OfClass, Selection, class_index, class_indices
from ..labels.questions import class_rows, make_question
from ..viz.field_colors import FeatureColors, colors_of_features, feature_colors

if TYPE_CHECKING:
    from ..fields import SemanticField

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

    def __repr__(self) -> str:
        return short_repr(self)


class Meaning(Protocol):
    """A semantic cloud that answers questions."""

    gaussians: Gaussians
    """With labels, [N] int64, -1 = none; features [N, d] or None."""
    names: tuple[str, ...]
    """Class names in label order."""
    scores: Tensor
    """[N] scores of the labels."""
    by: str
    """One line: how labels and scores were found."""
    phrases: bool
    """Whether it answers more than class names."""
    examples: bool
    """Whether it answers `similar`."""

    def ask(self, words: str) -> Asked:
        """Answer a class name or, if `phrases`, any text.

        Raises:
            ValueError: if there is no answer; the message offers similar names.
        """
        ...

    def similar(self, mask: Tensor) -> Asked:  # [N] bool
        """Answer "what is like these Gaussians?".

        Raises:
            ValueError: if nothing is known about any of them, or there is nothing to compare.
        """
        ...

    def feature_colors(self) -> FeatureColors:
        """The scene's projection of features to colours; called only if there are features."""
        ...


class FieldMeaning:
    """A semantic field: labels come from `SemanticField.classify`, answers from `SemanticField.query`.

    A class is compared with the other classes, any other text with the canonical words (`classes.negatives`). The score
    is then a relevancy, with gamma 0.5. If there is nothing to compare with, the score is the cosine, and gamma is
    derived from the scores.

    Args:
        field: a finished field.
        classes: names and embeddings in the teacher's space; None: those that the field remembers.
        cameras: the training views, used only to compute fused features if the field has none yet
            (`SemanticField.with_answers`); empty: the field's own. Without any view, each Gaussian's own latent decides,
            as in the paper.
        embed: the teacher's text encoder, text -> [D]; without it only classes can be asked.

    Raises:
        ValueError: if the embeddings and the field's features differ in channels, or there are no classes.

    Note:
        Warns if the classes were embedded by another teacher than the field's, when both are known.
    """

    def __init__(
        self,
        field: SemanticField,
        classes: LabelSet | None = None,
        *,
        cameras: Sequence[Camera] = (),
        embed: Callable[[str], Tensor] | None = None,
    ) -> None:
        classes = field.label_set() if classes is None else classes
        class_rows(classes, field.dim, field.info)  # checks them before views are rendered
        self._classes = replace(classes, info={})  # the teachers were compared just now: warn once, not per question
        self.field, self.by = _with_answers(field, cameras or field.cameras)
        labels, self.scores = self.field.classify(self._classes)
        self._embed = embed
        self._answers: dict[str, Asked] = {}
        self.names = classes.names
        self.phrases, self.examples = embed is not None, True
        self.gaussians = field.gaussians.replace(labels=labels)

    def ask(self, words: str) -> Asked:
        """Answer a class name or, with an encoder, any text. Answers are cached.

        Raises:
            ValueError: if it is no class and there is no encoder, or the encoder belongs to another teacher.
        """
        words = words if words in self.names else words.strip()
        known = self._classes.knows(words)
        if known:
            words = self.names[class_index(words, self.names)]
        if words not in self._answers:
            self._answers[words] = self._answer(words, words if known else self._phrase(words))
        return self._answers[words]

    def similar(self, mask: Tensor) -> Asked:  # [N] bool
        """Compare with the mean direction of some Gaussians' features, by cosine; the suggested gamma keeps nine of ten.

        Raises:
            ValueError: if nothing is known about any of them.
        """
        field = self.field
        chosen = as_tensor("mask", mask).to(field.known.device) & field.known
        if not bool(chosen.any()):
            raise ValueError("selection: expected Gaussians with features, got none; select others, or raise lambda")
        rows = chosen.nonzero()[:, 0]
        features = field.own_features(rows[:: max(1, len(rows) // MOST_COMPARED)])
        target = torch.nn.functional.normalize(features, dim=1).mean(0)
        scores = field.query(target, self._classes, score="cosine").scores
        gamma = float(scores[chosen].quantile(1 - KEPT))
        found = Selection(
            field.known & (scores > gamma), scores, gamma, f"{KEPT:.0%} of the selection are more like it"
        )
        return _asked("like the selection", found, field.known, False, False)

    def feature_colors(self) -> FeatureColors:
        """The field's projection, so latents have the same colours as in its rendered views."""
        return feature_colors(self.field)

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
                f"embed: expected [{self.field.dim}] (from the field) for {words!r}, got {tuple(target.shape)}; "
                "pass the text encoder of the teacher whose features this field was fitted to"
            )
        return target

    def _answer(self, words: str, target: str | Tensor) -> Asked:
        found = self.field.query(target, self._classes)
        question = make_question(target, self._classes, "auto", self.field.dim, {})
        return _asked(words, found, self.field.known, question.negatives is not None, isinstance(target, str))


class SplatMeaning:
    """A labelled splat: the answer to a class is its Gaussians, with the scores of the file, or 1 if it has none.

    Args:
        splats: with labels; classes without a name are called "class 3".

    Raises:
        ValueError: if the splat has no labels.
    """

    phrases = examples = False

    def __init__(self, splats: SplatFile) -> None:
        labels = splats.gaussians.labels
        if labels is None:
            raise ValueError(
                "splats.gaussians.labels: expected labels [N] to ask for, got None; label the splat first, with `kfgs attach` "
                "or transfer_labels, or pass a field"
            )
        self.gaussians = splats.gaussians
        count = max(len(splats.classes), int(labels.max()) + 1 if len(labels) else 0)
        self.names = splats.classes + tuple(f"class {i}" for i in range(len(splats.classes), count))
        self.by = "the file's classes"
        score = splats.extra.get(SCORE)
        self.scores = _file_scores(self.gaussians, score)
        if score is not None:
            self.by += " and scores"
        self._answers: dict[str, Asked] = {}

    def ask(self, words: str) -> Asked:
        """Answer a class name; the suggested gamma lies below all scores of the class, so that all are selected.

        Raises:
            ValueError: if there is no such class; the message offers similar names.
        """
        words = self.names[class_indices(words if words in self.names else words.strip(), self.names)[0]]
        if words not in self._answers:
            member = OfClass(words).mask(self.gaussians, self.names)
            scores = torch.where(member, self.scores, 0)
            own = scores[member]
            low, high = (float(own.min()), float(own.max())) if len(own) else UNIT
            if len(own) == 0 or (low > 0 and high <= 1):
                low, high = UNIT
            else:  # strictly below the lowest score, even after rounding to the precision of the scores
                below = float(torch.nextafter(own.min(), own.new_tensor(-torch.inf)))
                low = min(low - 0.01 * max(high - low, 1e-3), below)
            found = Selection(member & (scores > low), scores, low, "all of the class")
            self._answers[words] = Asked(words, found, low, high, True, member)
        return self._answers[words]

    def similar(self, mask: Tensor) -> Asked:  # [N] bool
        """Raises a ValueError: a splat has classes only."""
        raise ValueError("selection: expected a field, whose features can be compared, got a splat; search for a class")

    def feature_colors(self) -> FeatureColors:
        """A projection fitted to the features of the Gaussians that have some."""
        assert self.gaussians.features is not None
        return colors_of_features(self.gaussians.features)


def _with_answers(field: SemanticField, cameras: Sequence[Camera]) -> tuple[SemanticField, str]:
    """Compute fused features if they are missing and there are views; also say where the answers come from."""
    if field.linear is not None:
        return field, "what the training views show of each Gaussian"
    if not cameras:
        return field, "each Gaussian's own latent (Sec. 3.4)"
    views = list(cameras)
    return field.with_answers(views), f"what {len(views)} views show of each Gaussian"


def _file_scores(gaussians: Gaussians, score: np.ndarray | None) -> Tensor:  # type: ignore[type-arg]  # [N]
    """A file's scores; scores that are not finite become the lowest finite one."""
    if score is None:
        return torch.ones_like(gaussians.opacities)
    values = torch.from_numpy(np.asarray(score)).to(gaussians.means)
    finite = torch.isfinite(values)
    return torch.where(finite, values, values[finite].min() if bool(finite.any()) else torch.ones_like(values[:1]))


def _asked(words: str, found: Selection, valid: Tensor, relevant: bool, known: bool) -> Asked:
    """Add the range of useful gammas."""
    if relevant or not bool(valid.any()):
        return Asked(words, found, *UNIT, known, valid)
    own = found.scores[valid]
    gamma = float(found.threshold or 0.0)
    low, high = min(gamma, float(own.min())), max(gamma, float(own.max()))
    return Asked(words, found, low, high if high > low else low + 1e-3, known, valid)
