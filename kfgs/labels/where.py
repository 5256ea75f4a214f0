"""Selections that can be written down: expressions over classes, places and scores that give a mask when asked.

A `Selection` is a mask of one cloud; a `Where` is the question, which can be saved and asked again of another cloud.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from .._check import check_range, check_whole
from ..gaussians import Gaussians
from ._plain import NESTED, checked_object, members_of, number_of, numbers_of, quaternion_of, rotation_matrix
from .components import component_numbers
from .names import class_of, labelled


class _Cloud(NamedTuple):
    gaussians: Gaussians
    classes: Sequence[str]
    extra: Mapping[str, Any]


class Where(ABC):
    """A question that every Gaussian answers with yes or no.

    `a & b`, `a | b`, `a - b` and `~a` combine questions. `to_json` gives plain values, `Where.from_json` reads them, and
    equal questions compare equal.

    Example:
        >>> (OfClass("chair") - InSphere((0, 0, 0), 1.0)).to_json()["kind"]
        'both'
    """

    kind: ClassVar[str]

    def mask(
        self, gaussians: Gaussians, classes: Sequence[str] = (), extra: Mapping[str, Any] | None = None
    ) -> Tensor:  # [N] bool
        """Which Gaussians answer yes.

        Args:
            gaussians: N Gaussians.
            classes: the name of each class index in `gaussians.labels`.
            extra: further columns, N values each, as in `SplatFile.extra`.

        Raises:
            ValueError: if the cloud lacks what is asked for: labels, a class, a column, an index.
        """
        return self._ask(_Cloud(gaussians, classes, extra or {}))

    @abstractmethod
    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        """The mask; what a new kind of question has to say."""

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
        members = {name: _plain(value) for name, value in members_of(self).items()}
        return {"kind": self.kind} | {name: value for name, value in members.items() if value is not None}

    @staticmethod
    def from_json(value: Any, name: str = "where") -> Where:
        """Read what `to_json` gave.

        Args:
            value: plain values, from a file that anyone may have written.
            name: where they stand in the file; errors begin with it.

        Raises:
            ValueError: if the kind is unknown, a member is missing, unknown or of a wrong type, or it nests too deep.
        """
        return _read(value, name, 0)


@dataclass(frozen=True)
class Everything(Where):
    """Every Gaussian."""

    kind: ClassVar[str] = "everything"

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        return torch.ones(len(cloud.gaussians), dtype=torch.bool, device=cloud.gaussians.means.device)


@dataclass(frozen=True)
class OfClass(Where):
    """The Gaussians labelled with one class."""

    kind: ClassVar[str] = "class"
    name: str | int
    """A name, looked up exactly, then whatever its case; or an index, -1 for those without a label.

    Where several classes have that name, all of them are meant. An unknown name is an error; an index that no Gaussian
    carries selects nothing.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", class_of("name", self.name))

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        if cloud.gaussians.labels is None:
            raise ValueError(
                f"gaussians.labels: expected labels to find class {self.name!r} by, got None; attach a semantic field "
                "first, or select by a box or a sphere"
            )
        return labelled(cloud.gaussians.labels, (self.name,), cloud.classes)


@dataclass(frozen=True)
class InBox(Where):
    """The Gaussians whose centres lie in a box, faces included.

    With a rotation R the box is first laid out along the axes and then turned about its own centre c: a point x is inside
    when c + R^T (x - c) lies between `min` and `max`.
    """

    kind: ClassVar[str] = "box"
    min: tuple[float, ...]
    """The least x, y, z, world units."""
    max: tuple[float, ...]
    """The greatest x, y, z."""
    rotation: tuple[float, ...] | None = None
    """A quaternion (w, x, y, z), normalised where used; None for no turn."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "min", numbers_of("min", self.min, 3))
        object.__setattr__(self, "max", numbers_of("max", self.max, 3))
        if any(low > high for low, high in zip(self.min, self.max, strict=True)):
            raise ValueError(f"max: expected no less than min {self.min} on every axis, got {self.max}; swap them")
        if self.rotation is not None:
            object.__setattr__(self, "rotation", quaternion_of("rotation", self.rotation))

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        points = cloud.gaussians.means.detach().double()
        low, high = points.new_tensor(self.min), points.new_tensor(self.max)
        if self.rotation is not None:
            center = (low + high) / 2
            R = points.new_tensor(rotation_matrix(self.rotation).tolist())
            points = (points - center) @ R + center  # rows: R^T (x - c)
        return ((points >= low) & (points <= high)).all(dim=1)


@dataclass(frozen=True)
class InSphere(Where):
    """The Gaussians whose centres are no farther than `radius` from `center`, world units."""

    kind: ClassVar[str] = "sphere"
    center: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", numbers_of("center", self.center, 3))
        object.__setattr__(self, "radius", number_of("radius", self.radius))
        check_range("radius", self.radius, 0, closed=(False, False))

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        points = cloud.gaussians.means.detach().double()
        return (points - points.new_tensor(self.center)).norm(dim=1) <= self.radius


@dataclass(frozen=True)
class OfIndex(Where):
    """The Gaussians with these indices **in the cloud that is asked**: an edit before it may have renumbered them."""

    kind: ClassVar[str] = "index"
    indices: tuple[int, ...]
    """Ascending, without repetition; any order, an int tensor or a boolean mask will do to make one."""

    def __post_init__(self) -> None:
        given: Any = self.indices
        if isinstance(given, Tensor) and given.dtype == torch.bool and given.ndim == 1:
            given = given.nonzero()[:, 0]
        plain = given.tolist() if hasattr(given, "tolist") else given
        if isinstance(plain, str) or not isinstance(plain, Sequence):
            raise TypeError(f"indices: expected a list of whole numbers, got {plain!r:.80}; write it as [4, 7]")
        for index in plain:
            check_whole("indices", index, 0, 2**62)
        object.__setattr__(self, "indices", tuple(sorted({int(index) for index in plain})))

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        if self.indices and self.indices[-1] >= len(cloud.gaussians):
            raise ValueError(
                f"indices: expected indices below {len(cloud.gaussians)} (the number of Gaussians), got {self.indices[-1]}; "
                "were they taken from another cloud, or before an edit that removed some?"
            )
        mask = torch.zeros(len(cloud.gaussians), dtype=torch.bool, device=cloud.gaussians.means.device)
        mask[torch.tensor(self.indices, dtype=torch.int64, device=mask.device)] = True
        return mask


@dataclass(frozen=True)
class AboveScore(Where):
    """The Gaussians with more than `threshold` in a column: how sure their label is, unless another column is named."""

    kind: ClassVar[str] = "score"
    threshold: float
    column: str = "score"

    def __post_init__(self) -> None:
        object.__setattr__(self, "threshold", number_of("threshold", self.threshold))
        if not isinstance(self.column, str):
            raise TypeError(f"column: expected the name of a column, got {self.column!r:.80}; write it as a string")

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        if self.column not in cloud.extra:
            has = ", ".join(cloud.extra) or "none"
            raise ValueError(f"column: expected one of the cloud's columns ({has}), got {self.column!r}; name another")
        return torch.as_tensor(cloud.extra[self.column] > self.threshold).to(cloud.gaussians.means.device)


@dataclass(frozen=True)
class Component(Where):
    """One connected part of what another question selects: the largest, or a smaller one by `rank`."""

    kind: ClassVar[str] = "component"
    where: Where
    distance: float | None = None
    """Gaussians closer than this are connected, world units; None takes it from the cloud's spacing."""
    rank: int = 0
    """0 is the largest part, 1 the next; a rank past the last part selects nothing."""

    def __post_init__(self) -> None:
        _check_where("where", self.where)
        check_whole("rank", self.rank, 0)
        if self.distance is not None:
            object.__setattr__(self, "distance", number_of("distance", self.distance))
            check_range("distance", self.distance, 0, closed=(False, False))

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        mask = self.where._ask(cloud)
        if not bool(mask.any()):
            return mask
        return component_numbers(cloud.gaussians.means, mask, self.distance) == self.rank


@dataclass(frozen=True)
class Not(Where):
    """The Gaussians that another question does not select."""

    kind: ClassVar[str] = "not"
    where: Where

    def __post_init__(self) -> None:
        _check_where("where", self.where)

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        return ~self.where._ask(cloud)


@dataclass(frozen=True)
class _Several(Where):
    parts: tuple[Where, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.parts, Sequence) or not self.parts:
            raise ValueError(f"parts: expected at least one Where, got {self.parts!r:.80}; use Everything() for all")
        for part in self.parts:
            _check_where("parts", part)
        object.__setattr__(self, "parts", tuple(self.parts))


@dataclass(frozen=True)
class Both(_Several):
    """The Gaussians that all of several questions select."""

    kind: ClassVar[str] = "both"

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        return reduce(torch.logical_and, (part._ask(cloud) for part in self.parts))


@dataclass(frozen=True)
class Either(_Several):
    """The Gaussians that at least one of several questions selects."""

    kind: ClassVar[str] = "either"

    def _ask(self, cloud: _Cloud) -> Tensor:  # [N] bool
        return reduce(torch.logical_or, (part._ask(cloud) for part in self.parts))


KINDS: dict[str, type[Where]] = {
    kind.kind: kind
    for kind in (Everything, OfClass, InBox, InSphere, OfIndex, AboveScore, Component, Not, Both, Either)
}


def _check_where(name: str, value: Any) -> None:
    if not isinstance(value, Where):
        raise TypeError(f"{name}: expected a Where, such as OfClass('chair'), got {value!r:.80}; build one")


def _parts(kind: type[Both] | type[Either], where: Where) -> tuple[Where, ...]:
    return where.parts if isinstance(where, kind) else (where,)  # a & b & c is one Both of three


def _plain(value: Any) -> Any:
    if isinstance(value, Where):
        return value.to_json()
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


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
    try:
        return KINDS[kind](**members)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}.{error}") from error
