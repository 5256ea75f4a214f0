"""Rules that select Gaussians by class, place, index or score, and combinations of them. They can be saved as JSON.

A `Where` can be applied to any cloud and gives a `Selection`: `OfClass("chair").select(splats)`.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar

import torch
from torch import Tensor

from .._card import say_coordinate
from .._check import check_range, check_whole
from .._origin import to_world
from .._rows import check_finite
from ..formats.splat_file import SplatFile
from ..gaussians import Gaussians
from ._json import NESTED, build, checked_object, members_of, number_of, numbers_of, set_fields
from .boxes import quaternion_of, rotation_matrix
from .components import component_numbers
from .label_set import LabelSet
from .names import class_of, labelled
from .selection import Selection


class Where(ABC):
    """A rule that selects some Gaussians of a cloud.

    `a & b`, `a | b`, `a - b` and `~a` combine rules as they combine selections. `to_json` gives plain values,
    `Where.from_json` reads them, and equal rules compare equal.

    Example:
        >>> (OfClass("chair") - InSphere((0, 0, 0), 1.0)).to_json()["kind"]
        'both'
    """

    kind: ClassVar[str]

    def select(self, cloud: SplatFile | Gaussians, classes: Sequence[str] | LabelSet = ()) -> Selection:
        """Apply the rule to a cloud.

        Args:
            cloud: a splat with its class names and columns, or Gaussians.
            classes: only for Gaussians: the name of each class index in their labels.

        Raises:
            ValueError: if the cloud lacks the labels, class, column or index that the rule needs.
            TypeError: if it is neither a splat nor Gaussians.
        """
        if isinstance(cloud, Gaussians):
            cloud = SplatFile(cloud, classes=classes.names if isinstance(classes, LabelSet) else tuple(classes))
        if not isinstance(cloud, SplatFile):
            raise TypeError(
                f"cloud: expected a SplatFile or Gaussians, got {type(cloud).__name__}; pass the cloud itself"
            )
        return self._ask(cloud)

    def mask(self, cloud: SplatFile | Gaussians, classes: Sequence[str] | LabelSet = ()) -> Tensor:  # [N] bool
        """`select(...).mask` alone."""
        return self.select(cloud, classes).mask

    @abstractmethod
    def _ask(self, cloud: SplatFile) -> Selection:
        """The selection; each kind of rule defines it."""

    def __and__(self, other: Where) -> Where:
        return Both(_parts(Both, self) + _parts(Both, other)) if isinstance(other, Where) else NotImplemented

    def __or__(self, other: Where) -> Where:
        return Either(_parts(Either, self) + _parts(Either, other)) if isinstance(other, Where) else NotImplemented

    def __sub__(self, other: Where) -> Where:
        return self & ~other if isinstance(other, Where) else NotImplemented

    def __invert__(self) -> Where:
        return self.where if isinstance(self, Not) else Not(self)

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `kind`, and the fields."""
        return {"kind": self.kind} | {name: value for name, value in members_of(self).items() if value is not None}

    @staticmethod
    def from_json(value: Any, name: str = "where") -> Where:
        """Read what `to_json` gave.

        Args:
            value: plain values, from a file that anyone may have written.
            name: their place in the file; errors begin with it.

        Raises:
            ValueError: if the kind is unknown, a member is missing, unknown or of a wrong type, or it nests too deep.
        """
        return _read(value, name, 0)


@dataclass(frozen=True)
class Everything(Where):
    """Every Gaussian."""

    kind: ClassVar[str] = "everything"

    def _ask(self, cloud: SplatFile) -> Selection:
        mask = torch.ones(len(cloud), dtype=torch.bool, device=cloud.gaussians.means.device)
        return Selection.of(mask, "everything")


@dataclass(frozen=True)
class OfClass(Where):
    """The Gaussians labelled with one class."""

    kind: ClassVar[str] = "class"
    name: str | int
    """A name (exact, or else without regard to case), or an index, -1 for Gaussians without a label.

    A name selects all classes with that name. An unknown name is an error; an index that no Gaussian has selects nothing.
    """

    def __post_init__(self) -> None:
        set_fields(self, name=class_of("name", self.name))

    def _ask(self, cloud: SplatFile) -> Selection:
        if cloud.gaussians.labels is None:
            raise ValueError(
                f"gaussians.labels: expected labels to find class {self.name!r} by, got None; attach a semantic field "
                "first, or select by a box or a sphere"
            )
        return Selection.of(labelled(cloud.gaussians.labels, self.name, cloud.classes), f"label {self.name}")


@dataclass(frozen=True)
class InBox(Where):
    """The Gaussians whose centres lie in a box, faces included. For an `OrientedBox` see `OrientedBox.contains`.

    With a rotation R the box is first laid out along the axes and then turned about its own centre c: a point x is inside
    if c + R^T (x - c) lies between `min` and `max`.
    """

    kind: ClassVar[str] = "box"
    min: tuple[float, ...]
    """The least x, y, z, world units."""
    max: tuple[float, ...]
    """The greatest x, y, z."""
    rotation: tuple[float, ...] | None = None
    """A quaternion (w, x, y, z) of any length; None for no rotation."""

    def __post_init__(self) -> None:
        set_fields(self, min=numbers_of("min", self.min, 3), max=numbers_of("max", self.max, 3))
        if any(low > high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError(f"max: expected no less than min {self.min} on every axis, got {self.max}; swap them")
        if self.rotation is not None:
            set_fields(self, rotation=quaternion_of("rotation", self.rotation))

    def _ask(self, cloud: SplatFile) -> Selection:
        points = _points(cloud)
        low, high = points.new_tensor(self.min), points.new_tensor(self.max)
        if self.rotation is not None:
            center = (low + high) / 2
            R = points.new_tensor(rotation_matrix(self.rotation).tolist())
            points = (points - center) @ R + center  # rows: R^T (x - c)
        size = " x ".join(f"{b - a:.4g}" for a, b in zip(self.min, self.max, strict=True))
        return Selection.of(((points >= low) & (points <= high)).all(dim=1), f"in a box of {size}")


@dataclass(frozen=True)
class InSphere(Where):
    """The Gaussians whose centres are at most `radius` from `center`, world units."""

    kind: ClassVar[str] = "sphere"
    center: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        set_fields(self, center=numbers_of("center", self.center, 3), radius=number_of("radius", self.radius))
        check_range("radius", self.radius, 0, closed=(False, False))

    def _ask(self, cloud: SplatFile) -> Selection:
        points = _points(cloud)
        inside = (points - points.new_tensor(self.center)).norm(dim=1) <= self.radius
        return Selection.of(
            inside, f"within {self.radius:.4g} of ({', '.join(say_coordinate(x, 4) for x in self.center)})"
        )


@dataclass(frozen=True)
class OfIndex(Where):
    """The Gaussians with these indices **in the cloud it is applied to**; an earlier edit may have renumbered them."""

    kind: ClassVar[str] = "index"
    indices: tuple[int, ...]
    """Ascending, without repetition; made from numbers in any order, an int tensor, or a boolean mask."""

    def __post_init__(self) -> None:
        given: Any = self.indices
        if isinstance(given, Tensor) and given.dtype == torch.bool and given.ndim == 1:
            given = given.nonzero()[:, 0]
        plain = given.tolist() if hasattr(given, "tolist") else given
        if isinstance(plain, str) or not isinstance(plain, Sequence):
            raise TypeError(f"indices: expected a list of whole numbers, got {plain!r:.80}; write it as [4, 7]")
        for index in plain:
            check_whole("indices", index, 0, 2**62)
        set_fields(self, indices=tuple(sorted({int(index) for index in plain})))

    def _ask(self, cloud: SplatFile) -> Selection:
        if self.indices and self.indices[-1] >= len(cloud.gaussians):
            raise ValueError(
                f"indices: expected indices below {len(cloud.gaussians)} (the number of Gaussians), got {self.indices[-1]}; "
                "were they taken from another cloud, or before an edit that removed some?"
            )
        mask = torch.zeros(len(cloud.gaussians), dtype=torch.bool, device=cloud.gaussians.means.device)
        mask[torch.tensor(self.indices, dtype=torch.int64, device=mask.device)] = True
        return Selection.of(mask, "by index")


@dataclass(frozen=True)
class AboveScore(Where):
    """The Gaussians with more than `threshold` in a column of the splat; `score` is the confidence of their label."""

    kind: ClassVar[str] = "score"
    threshold: float
    column: str = "score"

    def __post_init__(self) -> None:
        set_fields(self, threshold=number_of("threshold", self.threshold))
        if not isinstance(self.column, str):
            raise TypeError(f"column: expected the name of a column, got {self.column!r:.80}; write it as a string")

    def _ask(self, cloud: SplatFile) -> Selection:
        if self.column not in cloud.extra:
            has = ", ".join(cloud.extra) or "none"
            raise ValueError(f"column: expected one of the cloud's columns ({has}), got {self.column!r}; name another")
        values = torch.as_tensor(cloud.extra[self.column]).to(cloud.gaussians.means.device)
        scores = values.to(torch.promote_types(values.dtype, torch.float32)).nan_to_num()
        return Selection(values > self.threshold, scores, self.threshold, f"column {self.column}")


@dataclass(frozen=True)
class Component(Where):
    """One connected part of another rule's selection: the largest, or a smaller one by `rank`."""

    kind: ClassVar[str] = "component"
    where: Where
    distance: float | None = None
    """Gaussians at most this far apart are connected, world units; None takes `component_distance`."""
    rank: int = 0
    """0 is the largest part, 1 the next; a rank past the last part selects nothing."""

    def __post_init__(self) -> None:
        _check_where("where", self.where)
        check_whole("rank", self.rank, 0)
        if self.distance is not None:
            set_fields(self, distance=number_of("distance", self.distance))
            check_range("distance", self.distance, 0, closed=(False, False))

    def _ask(self, cloud: SplatFile) -> Selection:
        found = self.where._ask(cloud)
        if len(found) == 0:
            return found
        numbers = component_numbers(cloud.gaussians.means, found.mask, self.distance)
        return found.within(numbers == self.rank, f"part {self.rank + 1} of {int(numbers.max()) + 1}")


@dataclass(frozen=True)
class Not(Where):
    """The Gaussians that another rule does not select."""

    kind: ClassVar[str] = "not"
    where: Where

    def __post_init__(self) -> None:
        _check_where("where", self.where)

    def _ask(self, cloud: SplatFile) -> Selection:
        return ~self.where._ask(cloud)


@dataclass(frozen=True)
class _Several(Where):
    parts: tuple[Where, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.parts, Sequence) or not self.parts:
            raise ValueError(f"parts: expected at least one Where, got {self.parts!r:.80}; use Everything() for all")
        for part in self.parts:
            _check_where("parts", part)
        set_fields(self, parts=tuple(self.parts))


@dataclass(frozen=True)
class Both(_Several):
    """The Gaussians that all of several rules select."""

    kind: ClassVar[str] = "both"

    def _ask(self, cloud: SplatFile) -> Selection:
        return reduce(operator.and_, (part._ask(cloud) for part in self.parts))


@dataclass(frozen=True)
class Either(_Several):
    """The Gaussians that at least one of several rules selects."""

    kind: ClassVar[str] = "either"

    def _ask(self, cloud: SplatFile) -> Selection:
        return reduce(operator.or_, (part._ask(cloud) for part in self.parts))


KINDS: dict[str, type[Where]] = {
    kind.kind: kind
    for kind in (Everything, OfClass, InBox, InSphere, OfIndex, AboveScore, Component, Not, Both, Either)
}


def _check_where(name: str, value: Any) -> None:
    if not isinstance(value, Where):
        raise TypeError(f"{name}: expected a Where like OfClass('chair'), got {value!r:.80}; build one")


def _parts(kind: type[Both] | type[Either], where: Where) -> tuple[Where, ...]:
    return where.parts if isinstance(where, kind) else (where,)  # a & b & c is one Both of three


def _points(cloud: SplatFile) -> Tensor:  # [N, 3] float64, in the world
    check_finite("gaussians.means", cloud.gaussians.means)
    return to_world(cloud.gaussians.means.detach().double(), cloud.gaussians.origin)


def _read(value: Any, name: str, depth: int) -> Where:
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"{name}: expected a selection whose 'kind' is one of {', '.join(KINDS)}, got {value!r:.80}")
    if depth > NESTED:
        raise ValueError(f"{name}: expected at most {NESTED} levels of nesting, got more; write it flatter")
    members = checked_object(name, value, KINDS[kind], "kind")
    if "where" in members:
        members["where"] = _read(members["where"], f"{name}.where", depth + 1)
    if isinstance(members.get("parts"), list):
        members["parts"] = tuple(_read(p, f"{name}.parts[{i}]", depth + 1) for i, p in enumerate(members["parts"]))
    return build(name, KINDS[kind], members)
