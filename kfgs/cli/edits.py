"""The options of `kfgs edit`, and their syntax: "plant:teal", "chair/2:fill"."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .options import Several


@dataclass(frozen=True)
class Edits:
    """Done in this order, whatever their order on the line; each may be given several times.

    A class stands for everything that carries it, "chair/1" for the largest of its connected parts, "chair/2" for the next,
    as `kfgs select chair SPLAT` lists them.
    """

    recolor: Several = ()
    """A class and a colour, "plant:#c04040" or "plant:teal"."""
    move: Several = ()
    """A class and a translation in world units, "table:0.5,0,0"."""
    remove: Several = ()
    """A class, "chair", or a part of it, "chair/2"; "chair:fill" also continues the surfaces around through the hole."""
    extract: Several = ()
    """Keep only these classes, or parts of them."""


def parse_edits(asked: Edits, names: Sequence[str] = ()) -> list[Any]:
    """The edits of the options, in the order of `Edits`.

    Parts of a class (`chair/1`) are counted after the earlier edits; removed parts of one class are counted together. If one
    of the class `names` is `chair/1`, that class is meant. A ValueError if an option lacks its value, or it is of another kind.
    """
    from ..labels import Extract, Move, OfClass, Recolor, Remove
    from ..labels.color import parse_color

    known = {name.casefold() for name in names}

    def where(option: str, words: str) -> OfClass:
        name, _, part = words.rpartition("/")
        if words.casefold() in known or not (name and part.isdecimal()):
            return OfClass(words)
        if int(part) == 0:
            raise ValueError(f"{option}: expected parts counted from 1, got {words!r}; '{name}/1' is the largest")
        return OfClass(name, int(part) - 1)

    edits: list[Any] = []
    for words in asked.recolor:
        name, value = _split("recolor", words, "plant:#c04040")
        edits.append(Recolor(where("recolor", name), parse_color(value, "recolor")))
    for words in asked.move:
        name, value = _split("move", words, "table:0.5,0,0")
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            raise ValueError(f"move: expected 3 numbers between commas after the colon, got {words!r}; write it so")
        edits.append(Move(where("move", name), numbers))
    removed: dict[str, list[tuple[OfClass, bool]]] = {}  # by class: removing one part changes the numbers of the others
    for words in dict.fromkeys(asked.remove):
        rule = where("remove", name := words if words.casefold() in known else words.removesuffix(":fill"))
        removed.setdefault(str(rule.name).casefold(), []).append((rule, name != words))
    edits += [Remove([rule for rule, _ in rules], any(fill for _, fill in rules)) for rules in removed.values()]
    if asked.extract:
        edits.append(Extract([where("extract", words) for words in asked.extract]))
    return edits


def _split(option: str, words: str, example: str) -> tuple[str, str]:
    name, colon, value = words.rpartition(":")
    if not (name and colon and value):
        expected = f"a class and a value, as in {example!r}"
        raise ValueError(f"{option}: expected {expected}, got {words!r}; put a colon between")
    return name, value
