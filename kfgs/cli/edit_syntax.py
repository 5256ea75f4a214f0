"""Parse edits written on a command line: `plant:#c04040`, `table:0.5,0,0`, `chair/2`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
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
    """A class, "chair", or a part of it, "chair/2"."""
    extract: Several = ()
    """Keep only these classes, or parts of them."""
    insert: Several = ()
    """A splat file to add, "lamp.ply"; with a translation, "lamp.ply:1,0,0". No other edit touches it."""


def parse_edits(asked: Edits, names: Sequence[str] = ()) -> list[tuple[str, Any]]:
    """The edits of the options, each after its words ("--move table:1,0,0"), in the order of `Edits`.

    Parts of a class (`chair/1`) are counted after the earlier edits; removed parts of one class are counted together. If one
    of the class `names` is `chair/1`, that class is meant.

    Raises:
        ValueError: if an option lacks its value, or the value is of another kind (the message quotes the option's text).
    """
    from ..labels.color import parse_color
    from ..labels.edits import Extract, Move, Recolor, Remove

    known = {name.casefold() for name in names}
    edits: list[tuple[str, Any]] = []
    for words in asked.recolor:
        name, value = _split("recolor", words, "plant:#c04040")
        edits.append((f"--recolor {words}", Recolor(_where("recolor", name, known), parse_color(value, "recolor"))))
    for words in asked.move:
        name, value = _split("move", words, "table:0.5,0,0")
        edits.append((f"--move {words}", Move(_where("move", name, known), _three("move", words, value))))
    removed: dict[
        str, list[str]
    ] = {}  # the parts of one class together: removing one changes the numbers of the others
    for words in dict.fromkeys(asked.remove):
        removed.setdefault(_where("remove", words, known).name.casefold(), []).append(words)
    for together in removed.values():
        edits.append((f"--remove {' '.join(together)}", Remove([_where("remove", words, known) for words in together])))
    if asked.extract:
        kept = tuple(_where("extract", words, known) for words in asked.extract)
        edits.append((f"--extract {' '.join(asked.extract)}", Extract(kept)))
    edits += [(f"--insert {words}", _insertion(words)) for words in asked.insert]
    return edits


def classes_of(edits: Sequence[Any]) -> Iterator[str | int]:
    """The classes, by name or index, that edits need in the first splat: those before an inserted one, which may bring some."""
    for edit in edits:
        if edit.op == "insert":
            return
        yield from (rule.name for rule in edit.where if rule.kind == "class")


def check_parts(splats: Any, edits: Sequence[Any]) -> None:
    """Raise a ValueError if an edit names a part of a class (`chair/6`) that `kfgs select` does not list."""
    import torch

    from ..labels import OfClass
    from ..labels.components import component_numbers
    from ..labels.parts import SPECK

    rules = [rule for edit in edits for rule in getattr(edit, "where", ())]
    for rule in (rule for rule in rules if getattr(rule, "part", None) is not None):
        mask = OfClass(rule.name).select(splats).mask
        sizes = torch.bincount(component_numbers(splats.means, mask, rule.distance)[mask])
        count = int((sizes >= SPECK * sizes[0]).sum()) if len(sizes) else 0
        if rule.part >= count:
            raise ValueError(
                f"{rule.name}/{rule.part + 1}: expected one of the {count} parts of {rule.name}, got no part of that number; "
                f"`kfgs select {rule.name} SPLAT` lists them"
            )


def _where(option: str, words: str, names: set[str]) -> Any:
    """A class, or one of its connected parts, as in `chair/2`."""
    from ..labels import OfClass

    name, _, part = words.rpartition("/")
    if words.casefold() in names or not (name and part.isdecimal()):
        return OfClass(words)
    if int(part) == 0:
        raise ValueError(f"{option}: expected parts counted from 1, got {words!r}; '{name}/1' is the largest")
    return OfClass(name, int(part) - 1)


def _insertion(words: str) -> Any:
    import torch

    from ..cameras.similarity import Similarity
    from ..labels import Insert

    path, colon, value = words.rpartition(":")
    if Path(words).exists() or not colon:
        path, value = words, ""
    if not Path(path).exists():
        raise ValueError(f"insert: expected a splat file, or one with a translation, got {words!r}; no file {path!r}")
    if not value:
        return Insert(Path(path))
    shift = torch.tensor(_three("insert", words, value), dtype=torch.float64)
    return Insert(Path(path), Similarity(1.0, torch.eye(3, dtype=torch.float64), shift))


def _split(option: str, words: str, example: str) -> tuple[str, str]:
    name, colon, value = words.rpartition(":")
    if not (name and colon and value):
        raise ValueError(
            f"{option}: expected a class and a value, as in {example!r}, got {words!r}; put a colon between"
        )
    return name, value


def _three(option: str, words: str, value: str) -> tuple[float, ...]:
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{option}: expected 3 numbers between commas after the colon, got {words!r}; write it so")
    return tuple(numbers)
