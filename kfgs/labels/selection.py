"""Rules that select Gaussians by class, index, box or sphere.

A rule works on any cloud: `OfClass("chair").select(gaussians)` is a `Selection`. Edits hold rules, and JSON can.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from .._card import say_coordinate
from .._check import check_range, check_whole, class_indices
from .._origin import to_world
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from .components import component_numbers
from .scores import Selection
from .transfer import positions

T = TypeVar("T")


class Where(ABC):
    """A rule that selects some Gaussians of a cloud. Rules are plain data: equal ones compare equal."""

    kind: ClassVar[str]

    def select(self, gaussians: Gaussians) -> Selection:
        """Apply the rule; a ValueError if the cloud lacks the labels, class or index that it needs."""
        return Selection.of(*self._find(gaussians))

    @abstractmethod
    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        """The mask [N] of what is selected, and the rule in words."""

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `kind`, and the fields."""
        return {"kind": self.kind} | plain_fields(self)


@dataclass(frozen=True)
class OfClass(Where):
    """The Gaussians labelled with one class, or one connected part of them."""

    kind: ClassVar[str] = "class"
    name: str | int
    """A name (exact, or else without regard to case; an unknown one is an error), or an index, -1 for those without a label."""
    part: int | None = None
    """Which connected part: 0 is the largest, one past the last is an error. None: all of the class."""
    distance: float | None = None
    """Gaussians at most this far apart are in one part, world units; None takes it from their spacing."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            check_whole("name", self.name, -1, 2**31 - 1)
        if self.part is not None:
            check_whole("part", self.part, 0)
        if self.distance is not None:
            check_range("distance", self.distance, 0, closed=(False, False))

    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        labels = gaussians.labels
        if labels is None:
            raise ValueError(f"gaussians.labels: expected some for {self.name!r}, got None; attach a field first")
        indices = class_indices(self.name, gaussians.names) if isinstance(self.name, str) else (self.name,)
        mask, how = torch.isin(labels, torch.tensor(indices, device=labels.device)), f"label {self.name}"
        if self.part is not None:
            parts = component_numbers(gaussians.means, mask, self.distance)
            count = len(parts[mask].unique())
            if count == 0:
                raise ValueError(f"part: expected a class of some Gaussians, got {self.name}, which none has")
            if self.part >= count:
                raise ValueError(
                    f"part: expected 1 to {count}, got {self.name}/{self.part + 1}; `kfgs select` lists them"
                )
            mask, how = parts == self.part, f"{how}; part {self.part + 1} of {count}"
        return mask, how


@dataclass(frozen=True)
class InBox(Where):
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
class InSphere(Where):
    """The Gaussians whose centres are at most `radius` from `center`, world units."""

    kind: ClassVar[str] = "sphere"
    center: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        set_fields(self, center=three_numbers("center", self.center))
        check_range("radius", self.radius, 0, closed=(False, False))

    def _find(self, gaussians: Gaussians) -> tuple[Tensor, str]:
        points = _points(gaussians)
        inside = (points - points.new_tensor(self.center)).norm(dim=1) <= self.radius
        center = ", ".join(say_coordinate(x, 4) for x in self.center)
        return inside, f"within {self.radius:.4g} of ({center})"


@dataclass(frozen=True)
class OfIndex(Where):
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


def class_name(names: Sequence[str], index: int) -> str:
    """The name of a class; one without a name is called `class 7`."""
    return names[index] if index < len(names) else f"class {index}"


KINDS: dict[str, type[Where]] = {kind.kind: kind for kind in (OfClass, InBox, InSphere, OfIndex)}


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
    return {name: _plain(member) for name, member in values.items() if member is not None}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, Where):
        return value.to_json()
    if isinstance(value, Similarity):
        return value.matrix().tolist()
    return str(value) if isinstance(value, Path) else value


def read_object(name: str, value: Any, kinds: Mapping[str, type[T]], tag: str) -> T:
    """Make the rule or the edit that a JSON object names by `tag`; a ValueError begins with `name`, its place in the file."""
    kind = value.get(tag) if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{name}: expected an object whose {tag!r} is one of {', '.join(kinds)}, got {value!r:.80}")
    try:
        return kinds[kind](**{key: part for key, part in value.items() if key != tag})
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name}: {error}") from error
