"""Read and write dataclasses as JSON, with checks of single values that name the argument."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from torch import Tensor

T = TypeVar("T")
NESTED = 32  # levels of one expression; people do not write deeper ones


def numbers_of(name: str, values: Any, count: int) -> tuple[float, ...]:
    """`count` finite numbers from a list, tuple, array or tensor, as a tuple.

    Raises:
        TypeError: if a value is not a number.
        ValueError: if there are more or fewer, or one is not finite.
    """
    plain = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(plain, str) or not isinstance(plain, Sequence) or not all(is_number(value) for value in plain):
        raise TypeError(f"{name}: expected {count} numbers, got {values!r:.80}; write them as [x, y, ...]")
    if len(plain) != count or not all(math.isfinite(value) for value in plain):
        raise ValueError(f"{name}: expected {count} finite numbers, got {values!r:.80}; give one number per axis")
    return tuple(float(value) for value in plain)


def number_of(name: str, value: Any) -> float:
    """One finite number, as a float.

    Raises:
        TypeError: if it is not a number.
        ValueError: if it is not finite.
    """
    plain = value.item() if isinstance(value, Tensor) and value.ndim == 0 else value
    if not is_number(plain):
        raise TypeError(f"{name}: expected a number, got {value!r:.80}; write it without quotes")
    if not math.isfinite(plain):
        raise ValueError(f"{name}: expected a finite number, got {value!r}; leave it out for its default")
    return float(plain)


def is_number(value: Any) -> bool:
    """Whether it is a real number that a float can hold; a bool is not."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    return not isinstance(value, numbers.Integral) or abs(int(value)) < 2**1000


def checked_object(name: str, value: Any, kind: Any, tag: str) -> dict[str, Any]:
    """Check the members of a JSON object against the fields of a dataclass, and return them without the tag.

    Raises:
        ValueError: if it is not an object, a member is unknown, or one is missing; `name` says where in the file.
    """
    if not isinstance(value, dict):
        raise ValueError(f"{name}: expected an object {{...}} with {tag!r}, got {value!r:.80}; write one")
    members = [member for member in fields(kind) if member.init]
    known = [member.name for member in members]
    needed = [m.name for m in members if m.default is MISSING and m.default_factory is MISSING]
    given = [key for key in value if key != tag]
    unknown = [key for key in given if key not in known]
    if unknown:
        raise ValueError(
            f"{name}: expected {tag} {value.get(tag)!r} with {', '.join(known) or 'nothing else'}, got {unknown[0]!r:.80}; "
            "correct or delete it"
        )
    missing = [key for key in needed if key not in given]
    if missing:
        raise ValueError(f"{name}: expected {missing[0]!r} for {tag} {value.get(tag)!r}, got none; add it")
    return {key: value[key] for key in given}


def build(name: str, kind: type[T], members: dict[str, Any]) -> T:
    """Make a dataclass from members read from a file; errors begin with the place in the file."""
    try:
        return kind(**members)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}.{error}") from error


def members_of(value: Any) -> dict[str, Any]:
    """The fields of a dataclass by name, as values for JSON; `checked_object` reads them."""
    return {member.name: _plain(getattr(value, member.name)) for member in fields(value) if member.init}


def _plain(value: Any) -> Any:
    if hasattr(value, "to_json"):
        return value.to_json()
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def set_fields(frozen: Any, **values: Any) -> None:
    """Replace fields of a frozen dataclass by their checked form; called in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)
