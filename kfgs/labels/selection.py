"""Selections of Gaussians: from cosines with a query (Sec. 3.4), or by rules: class, index or box.

A `Selection` holds for one cloud. A rule works on any: `OfClass("chair").select(gaussians)` is a `Selection`. Edits hold rules,
and JSON can. `as_selection` takes whatever a person holds.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from .._arrays import Array
from .._card import cut
from .._check import as_tensor, check_choice, check_range, check_whole, class_indices
from .._origin import to_world
from .._rows import check_finite
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from .components import number_parts
from .scores import EVEN, TEMPERATURE, Score, similarity_threshold
from .transfer import as_cloud, positions

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Selection:
    """Some of N Gaussians, with a score for every one of them; `gaussians[selection]` are the Gaussians, `len` their number.

    `a & b`, `a | b`, `a - b` and `~a` combine selections of the same Gaussians. Scores follow Zadeh's rules: `&` takes the
    smaller, `|` the larger, `~a` has 1 - score; `a - b` is `a & ~b`.

    Example:
        >>> a, b = Selection.of(torch.tensor([True, True, False])), Selection.of(torch.tensor([True, False, False]))
        >>> (a - b).indices.tolist()
        [1]
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
        for name in ("mask", "scores"):
            if not isinstance(value := getattr(self, name), Tensor):
                object.__setattr__(self, name, as_tensor(name, value))
        if self.mask.ndim != 1 or self.scores.shape != self.mask.shape:
            got = f"{tuple(self.mask.shape)} and {tuple(self.scores.shape)}"
            raise ValueError(f"mask, scores: expected [N] with the same N, got {got}; pass one score per Gaussian")
        if self.mask.dtype != torch.bool:
            raise TypeError(f"mask: expected a boolean mask, got {self.mask.dtype}; compare first, as in labels == 3")
        check_finite("scores", self.scores)

    def __len__(self) -> int:
        return int(self.mask.sum())

    def __repr__(self) -> str:
        return f"Selection({len(self)} of {len(self.mask)} Gaussians: {cut(self.summary, 140)})"

    @property
    def indices(self) -> Tensor:  # [n] int64
        """The selected Gaussians, ascending."""
        return self.mask.nonzero()[:, 0]

    @property
    def summary(self) -> str:
        """How it was made and its threshold, in words."""
        return self.how if self.threshold is None else f"score > {self.threshold:.4g} ({self.how})"

    def __and__(self, other: Selection) -> Selection:
        return self._with(other, "and", torch.logical_and, torch.minimum)

    def __or__(self, other: Selection) -> Selection:
        return self._with(other, "or", torch.logical_or, torch.maximum)

    def __invert__(self) -> Selection:
        return Selection(~self.mask, 1 - self.scores, None, f"not ({self.summary})")

    def __sub__(self, other: Selection) -> Selection:
        return self & ~other

    def _with(self, other: Selection, word: str, both: Callable[..., Tensor], pick: Callable[..., Tensor]) -> Selection:
        if not isinstance(other, Selection):
            raise TypeError(f"other: expected a Selection, got {type(other).__name__}; make one by Selection.of(mask)")
        if len(self.mask) != len(other.mask):
            own, its = len(self.mask), len(other.mask)
            raise ValueError(f"other: expected a selection among the same {own} Gaussians, got one among {its}")
        dtype = torch.promote_types(self.scores.dtype, other.scores.dtype)
        scores = pick(self.scores.to(dtype), other.scores.to(self.scores.device, dtype))
        return Selection(both(self.mask, other.mask), scores, None, f"({self.summary}) {word} ({other.summary})")


def select_by_similarity(
    similarity: Tensor,  # [N]
    negatives: Tensor | None = None,  # [N, M]
    threshold: float | None = None,
    known: Tensor | None = None,  # [N] bool
    score: Score | None = None,
) -> Selection:
    """Select the Gaussians with a score above gamma, from cosines with a query and its negatives (`SemanticField.query`).

    The relevancy of LERF (Kerr 2023, Sec. 3.4) is min over j of the first entry of softmax(10 [s, n_j]), which is
    sigmoid(10 (s - max_j n_j)). Above 0.5, which is gamma without a `threshold`, the Gaussian is more similar to the query
    than to any negative. For a cosine, `similarity_threshold` finds gamma in the scores. Gaussians that are not `known` have
    score 0 and no influence on gamma. On room_0 (mean IoU over 18 classes with the data set's labels): cosine 0.88,
    relevancy 0.90.
    """
    score = score or ("cosine" if negatives is None else "relevancy")
    gamma, how, scores = threshold, "given", similarity
    check_finite("similarity", similarity)
    if score == "relevancy":
        if negatives is None:
            raise ValueError("negatives: expected some for a relevancy, got none; pass words that are not meant")
        check_finite("negatives", negatives)
        scores = torch.sigmoid(TEMPERATURE * (similarity - negatives.amax(dim=1)))
        if gamma is None:
            gamma, how = EVEN, f"more like the query than like any of {negatives.shape[1]} negatives"
    elif score != "cosine":
        check_choice("score", score, get_args(Score))
    if threshold is not None:
        check_range("threshold", threshold, -1 if score == "cosine" else 0, 1)
    known = torch.ones_like(similarity, dtype=torch.bool) if known is None else known
    scores = scores.masked_fill(~known, 0)
    if gamma is None:
        gamma, how = similarity_threshold(scores[known])
    return Selection((scores > gamma) & known, scores, float(gamma), how)


class Rule(ABC):
    """A rule that selects some Gaussians of a cloud. Rules are plain data: equal ones compare equal."""

    kind: ClassVar[str]

    def select(self, gaussians: Any) -> Selection:
        """Apply the rule to Gaussians or a field; a ValueError if the cloud lacks the labels, class or index that it needs."""
        return Selection.of(*self._find(as_cloud(gaussians)))

    __call__ = select  # so that `gaussians[rule]` works

    @abstractmethod
    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        """The mask [N] of what is selected, and the rule in words."""

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `kind`, and the fields."""
        return {"kind": self.kind} | plain_fields(self)


@dataclass(frozen=True)
class OfClass(Rule):
    """The Gaussians labelled with one class, or one connected part of them."""

    kind: ClassVar[str] = "class"
    name: str | int
    """A name (exact, or else without regard to case; an unknown one is an error), or an index, -1 for those without a label."""
    part: int | None = None
    """Which part, as `connected_parts` counts: 0 is the largest, one past the last is an error. None: all of the class."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            check_whole("name", self.name, -1, 2**31 - 1)
        if self.part is not None:
            check_whole("part", self.part, 0)

    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        labels = gaussians.labels
        if labels is None:
            raise ValueError(f"gaussians.labels: expected some for {self.name!r}, got None; attach a field first")
        indices = class_indices(self.name, gaussians.names) if isinstance(self.name, str) else (self.name,)
        mask, how = torch.isin(labels, torch.tensor(indices, device=labels.device)), f"label {self.name}"
        if self.part is not None:
            parts = number_parts(gaussians, mask)
            known = (parts[parts >= 0].unique() + 1).tolist()
            if not known:
                raise ValueError(f"part: expected a class of some Gaussians, got {self.name}, which none has")
            if self.part + 1 not in known:
                numbers = f"1 to {len(known)}" if known[-1] == len(known) else cut(str(known), 80)
                raise ValueError(f"part: expected {numbers}, got {self.name}/{self.part + 1}; `kfgs select` lists them")
            mask, how = parts == self.part, f"{how}; part {self.part + 1} of {len(known)}"
        return mask, how


@dataclass(frozen=True)
class InBox(Rule):
    """The Gaussians whose centres lie in a box along the world's axes, faces included."""

    kind: ClassVar[str] = "box"
    min: tuple[float, ...]
    """The least x, y, z, world units."""
    max: tuple[float, ...]
    """The greatest x, y, z."""

    def __post_init__(self) -> None:
        set_fields(self, min=three_numbers("min", self.min), max=three_numbers("max", self.max))
        if any(low > high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError(f"max: expected no less than min {self.min} on every axis, got {self.max}; swap them")

    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        points = _points(gaussians)
        inside = (points >= points.new_tensor(self.min)) & (points <= points.new_tensor(self.max))
        size = " x ".join(f"{b - a:.4g}" for a, b in zip(self.min, self.max, strict=True))
        return inside.all(dim=1), f"in a box of {size}"


@dataclass(frozen=True)
class OfIndex(Rule):
    """The Gaussians with these indices **in the cloud it is applied to**; an earlier edit may have renumbered them."""

    kind: ClassVar[str] = "index"
    indices: tuple[int, ...]
    """Ascending, without repetition; made from whole numbers in any order."""

    def __post_init__(self) -> None:
        given: Any = self.indices.tolist() if isinstance(self.indices, Tensor) else self.indices
        if not isinstance(given, list | tuple | range):
            raise TypeError(f"indices: expected a list of whole numbers, got {given!r:.80}; write it as [4, 7]")
        for index in given:
            check_whole("indices", index, 0, 2**62)
        set_fields(self, indices=tuple(sorted(set(given))))

    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        if self.indices and self.indices[-1] >= len(gaussians):
            got = f"{self.indices[-1]}; were they taken from another cloud, or before an edit that removed some?"
            raise ValueError(f"indices: expected indices below {len(gaussians)} (the number of Gaussians), got {got}")
        mask = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        mask[list(self.indices)] = True
        return mask, "by index"


def class_names(gaussians: Gaussians) -> tuple[str, ...]:
    """A name for every label of a cloud: a class without a name is called `class 7`."""
    labels, names = gaussians.labels, gaussians.names
    count = 0 if labels is None or not len(labels) else int(labels.max()) + 1
    return (*names, *(f"class {i}" for i in range(len(names), count)))


KINDS: dict[str, type[Rule]] = {kind.kind: kind for kind in (OfClass, InBox, OfIndex)}


def as_selection(value: Any, gaussians: Gaussians, name: str = "selection") -> Selection:
    """What a person holds as a selection: a class name, a rule, a `Selection`, a mask [N]; of several, what any selects."""
    if isinstance(value, list | tuple) and value and isinstance(value[0], str | Rule | Selection):
        return reduce(or_, (as_selection(part, gaussians, name) for part in value))
    if isinstance(value, Tensor | np.ndarray | list):
        return Selection.of(as_tensor(name, value))
    return value if isinstance(value, Selection) else as_rule(value, name).select(gaussians)


def as_rule(value: Any, name: str) -> Rule:
    """What a person holds as a rule: as for `as_selection`, or a rule in JSON. Of a `Selection` or a mask, the indices."""
    if isinstance(value, Selection | Tensor | np.ndarray):
        value = value if isinstance(value, Selection) else Selection.of(value)
        return OfIndex(tuple(value.indices.tolist()))
    if isinstance(value, dict):
        return read_object(name, value, KINDS, "kind")
    if not isinstance(value, str | Rule):
        raise TypeError(f"{name}: expected a class name, a rule like OfClass, a Selection or a mask, got {value!r:.80}")
    return OfClass(value) if isinstance(value, str) else value


def _points(gaussians: Gaussians) -> Tensor:  # [N, 3] float64, in the world
    return to_world(torch.from_numpy(positions("gaussians.means", gaussians.means)), gaussians.origin)


def three_numbers(name: str, values: Any) -> tuple[float, ...]:
    """Three finite numbers from a list, tuple, array or tensor, as a tuple; else a ValueError."""
    plain = values.tolist() if hasattr(values, "tolist") else values
    if not isinstance(plain, list | tuple) or len(plain) != 3:
        raise ValueError(f"{name}: expected 3 numbers, got {values!r:.80}; write them as [x, y, z]")
    for value in plain:
        check_range(name, value, -math.inf, closed=(False, False))
    return tuple(float(value) for value in plain)


def set_fields(frozen: Any, **values: Any) -> None:
    """Replace fields of a frozen dataclass by their checked form; called in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


def plain_fields(value: Any) -> dict[str, Any]:
    """The fields of a rule or an edit by name, as values for JSON; `read_object` reads them."""
    values = {member.name: getattr(value, member.name) for member in fields(value)}
    return {name: _plain(member) for name, member in values.items() if member is not None and member is not False}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, Rule | Similarity):
        return value.to_json() if isinstance(value, Rule) else value.matrix().tolist()
    return str(value) if isinstance(value, Path) else value


def read_object(name: str, value: Any, kinds: Mapping[str, type[T]], tag: str) -> T:
    """Make the rule or the edit that a JSON object names by `tag`; a ValueError begins with `name`, its place in the file."""
    kind = value.get(tag) if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{name}: expected an object whose {tag!r} is one of {', '.join(kinds)}, got {value!r:.80}")
    try:
        own = {key: part for key, part in value.items() if key != tag and (key, part) != ("mode", "tint")}
        return kinds[kind](**own)  # older files name this mode of Recolor, the only one there is now
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: {error}") from error
