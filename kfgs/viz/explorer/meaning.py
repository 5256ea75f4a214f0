"""What a semantic cloud can be asked: a field by text (Sec. 3.4), a labelled splat by class."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ..._card import short_repr
from ...cameras import Camera
from ...formats import SplatFile
from ...formats.splat_file import SCORE
from ...gaussians import Gaussians
from ...labels import (
    LabelSet,
    OfClass,
    Selection,
    class_index,
    class_indices,
)
from ...labels.questions import class_rows, make_question
from ..field_colors import FeatureColors, colors_of_features, feature_colors

if TYPE_CHECKING:
    from ...fields import SemanticField

UNIT = (0.0, 1.0)


class Asked(NamedTuple):
    """A question and its answer: a score for each Gaussian, and the gamma that it suggests."""

    words: str  # as asked; a class's own spelling where it is one
    selection: Selection  # threshold: the gamma it suggests
    low: float  # the least gamma that makes a difference: 0 of a relevancy, else the least score
    high: float  # the largest: 1, or the largest score
    known: bool  # one of the classes
    valid: Tensor  # [N] bool, whether anything is known of a Gaussian; the others are never selected

    def __repr__(self) -> str:
        return short_repr(self)


class Meaning(Protocol):
    """What a semantic cloud can be asked."""

    gaussians: Gaussians
    """With labels, [N] int64, -1 = none; features [N, d] or None."""
    names: tuple[str, ...]
    """Of the classes, in label order."""
    scores: Tensor
    """[N] of the labels."""
    by: str
    """One line: how labels and scores came about."""
    phrases: bool
    """Whether anything but a class can be asked."""

    def ask(self, words: str) -> Asked:
        """The answer to a class's name or, where `phrases`, to any words.

        Raises:
            ValueError: for words that cannot be answered; near names are offered.
        """
        ...

    def feature_colors(self) -> FeatureColors:
        """The scene's one projection of features to colours; asked for only where there are features."""
        ...


class FieldMeaning:
    """A semantic field asked by text: labels are those of `SemanticField.classify`, answers those of `SemanticField.query`.

    A class is compared with the other classes, anything else with the canonical words (`classes.negatives`): the score is a
    relevancy, gamma 0.5. Where there are none it is the cosine, and gamma is read off the scores.

    Args:
        field: a finished field.
        classes: names and embeddings in the teacher's space; None: those that the field remembers.
        cameras: used only if the field has no fused features yet: views to find them from (`SemanticField.with_answers`),
            those that it was trained with. None given: the field's own. Without any each Gaussian's own latent decides, as
            in the paper.
        embed: the teacher's text encoder, words -> [D]; without it only classes can be asked.

    Raises:
        ValueError: if the embeddings have another number of channels than the field's features, or classes are neither
            given nor remembered.

    Note:
        Warns where the classes were embedded by another teacher than the field's, as far as both are known.
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
        class_rows(classes, field.dim, field.info)  # refuses them before views are rendered
        self._classes = replace(classes, info={})  # the teacher has been compared: one warning, not one per question
        self._field, self.by = _with_answers(field, cameras or field.cameras)
        labels, self.scores = self._field.classify(self._classes)
        self._embed = embed
        self._answers: dict[str, Asked] = {}
        self.names = classes.names
        self.phrases = embed is not None
        self.gaussians = field.gaussians.replace(labels=labels)

    def ask(self, words: str) -> Asked:
        """The answer to a class's name or, with an encoder, to any words; the second time it is at hand.

        Raises:
            ValueError: for a word that is no class where there is no encoder (near names are offered), or an encoder of
                another teacher.
        """
        words = words.strip()
        known = self._classes.knows(words)
        if known:
            words = self.names[class_index(words, self.names)]
        if words not in self._answers:
            self._answers[words] = self._answer(words, words if known else self._phrase(words))
        return self._answers[words]

    def feature_colors(self) -> FeatureColors:
        """The field's own projection: latents have the colours that they have in its rendered views."""
        return feature_colors(self._field)

    def _phrase(self, words: str) -> Tensor:  # [D]
        if self._embed is None or not words:
            try:
                class_indices(words, self.names)
            except ValueError as error:  # says which classes there are, and which are near
                more = "" if self.phrases else "; other words need the teacher's text encoder (embed)"
                raise ValueError(f"{error}{more}") from None
        assert self._embed is not None
        target = torch.as_tensor(self._embed(words)).detach()
        if tuple(target.shape) != (self._field.dim,):
            raise ValueError(
                f"embed: expected [{self._field.dim}] (from the field) for {words!r}, got {tuple(target.shape)}; "
                "pass the text encoder of the teacher whose features this field was fitted to"
            )
        return target

    def _answer(self, words: str, target: str | Tensor) -> Asked:
        found = self._field.query(target, self._classes)
        question = make_question(target, self._classes, "auto", self._field.dim, {})
        return _asked(words, found, self._field.known, question.negatives is not None, isinstance(target, str))


class SplatMeaning:
    """A labelled splat asked by class: its Gaussians of that class, with the file's score where there is one, else 1.

    Args:
        splats: with labels; classes without a name are called "class 3".

    Raises:
        ValueError: if the splat carries no labels.
    """

    phrases = False

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
        """The Gaussians of a class; gamma is suggested below all of their scores, so all are selected.

        Raises:
            ValueError: if there is no such class (near names are offered).
        """
        words = self.names[class_indices(words.strip(), self.names)[0]]
        if words not in self._answers:
            member = OfClass(words).mask(self.gaussians, self.names)
            scores = torch.where(member, self.scores, 0)
            own = scores[member]
            low, high = (float(own.min()), float(own.max())) if len(own) else UNIT
            if len(own) == 0 or (low > 0 and high <= 1):
                low, high = UNIT
            else:  # strictly below the least score, also once it is rounded to the scores' precision
                below = float(torch.nextafter(own.min(), own.new_tensor(-torch.inf)))
                low = min(low - 0.01 * max(high - low, 1e-3), below)
            found = Selection(member & (scores > low), scores, low, "all of the class")
            self._answers[words] = Asked(words, found, low, high, True, member)
        return self._answers[words]

    def feature_colors(self) -> FeatureColors:
        """A projection fitted to the features of all Gaussians that have any."""
        assert self.gaussians.features is not None
        return colors_of_features(self.gaussians.features)


def _with_answers(field: SemanticField, cameras: Sequence[Camera]) -> tuple[SemanticField, str]:
    """A field with fused features if it has them or there are views to find them from, and where its answers come from."""
    if field.linear is not None:
        return field, "what the training views show of each Gaussian"
    if not cameras:
        return field, "each Gaussian's own latent (Sec. 3.4)"
    views = list(cameras)
    return field.with_answers(views), f"what {len(views)} views show of each Gaussian"


def _file_scores(gaussians: Gaussians, score: np.ndarray | None) -> Tensor:  # type: ignore[type-arg]  # [N]
    """A file's scores; those that are not finite count as the least of the others."""
    if score is None:
        return torch.ones_like(gaussians.opacities)
    values = torch.from_numpy(np.asarray(score)).to(gaussians.means)
    finite = torch.isfinite(values)
    return torch.where(finite, values, values[finite].min() if bool(finite.any()) else torch.ones_like(values[:1]))


def _asked(words: str, found: Selection, valid: Tensor, relevant: bool, known: bool) -> Asked:
    """With the range in which a gamma makes a difference."""
    if relevant or not bool(valid.any()):
        return Asked(words, found, *UNIT, known, valid)
    own = found.scores[valid]
    gamma = float(found.threshold or 0.0)
    low, high = min(gamma, float(own.min())), max(gamma, float(own.max()))
    return Asked(words, found, low, high if high > low else low + 1e-3, known, valid)
