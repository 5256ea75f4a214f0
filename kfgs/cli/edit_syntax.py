"""Parse edits written on a command line: `plant:#c04040`, `lamp:0.3`, `table:0.5,0,0`, `chair/2:z,90`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from .options import Given, Several

_THREE = "3 numbers between commas"


@dataclass(frozen=True)
class Edits:
    """Done in this order, whatever their order on the line; each may be given several times.

    A class stands for everything that carries it, "chair/1" for the largest of its connected parts, "chair/2" for the next,
    as `kfgs select chair SPLAT` lists them.
    """

    recolor: Several = ()
    """A class and a colour, "plant:#c04040" or "plant:teal"."""
    mode: Literal["tint", "hue"] = "tint"
    """How to recolor: tint gives the colour itself and keeps the shading, hue keeps the lightness."""
    opacity: Several = ()
    """A class and a factor from 0 to 1, "lamp:0.3"."""
    scale: Several = ()
    """A class and a factor, "lamp:1.5"; about the centre of the class, or of its part."""
    rotate: Several = ()
    """A class, an axis of the world and degrees, "table:z,90"; by the right hand about the same centre."""
    move: Several = ()
    """A class and a translation in world units, "table:0.5,0,0"."""
    duplicate: Several = ()
    """A class and the translation of its copy, "chair:1,0,0"."""
    remove: Several = ()
    """A class, "chair", or a part of it, "chair/2"; copies of --duplicate are removed too."""
    extract: Several = ()
    """Keep only these classes, or parts of them."""
    insert: Several = ()
    """A splat file to add, "lamp.ply"; with a translation, "lamp.ply:1,0,0". No other edit touches it."""
    distance: Given[float] = None
    """For parts as in "chair/2": Gaussians at most this far apart are one part, in world units, as in `kfgs select`."""


def parse_edits(asked: Edits, names: Sequence[str] = ()) -> list[tuple[str, Any]]:
    """The edits of the options, each after its words ("--scale lamp:2"), in the order of `Edits`: recolour before remove.

    Parts of a class (`chair/1`) are counted after the earlier edits; removed parts of one class are counted together. If one
    of the class `names` is `chair/1`, that class is meant.

    Raises:
        ValueError: if an option lacks its value, or the value is of another kind (the message quotes the option's text), or
            there is a distance but no part.
    """
    edits = list(_parse(asked, partial(_where, asked.distance, {name.casefold() for name in names})))
    if asked.distance is not None and not any(_parts(edit) for _, edit in edits):
        raise ValueError(
            f"distance: expected an edit of a part with it (--remove chair/2), got {asked.distance} and none; name a part, or "
            "leave it out"
        )
    return edits


def _parse(asked: Edits, where_of: Callable[[str, str], Any]) -> Iterator[tuple[str, Any]]:
    from ..labels.color import parse_color
    from ..labels.edits import Duplicate, Extract, Move, Opacity, Recolor, Remove
    from ..labels.edits.motion import AXES

    for words in asked.recolor:
        name, value = _split("recolor", words, "plant:#c04040")
        yield f"--recolor {words}", Recolor(where_of("recolor", name), parse_color(value, "recolor"), asked.mode)
    for words in asked.opacity:
        name, value = _split("opacity", words, "lamp:0.3")
        (factor,) = _numbers("opacity", words, value, "a factor from 0 to 1", 1)
        if not 0 <= factor <= 1:
            raise ValueError(f"opacity: expected a factor from 0 to 1 after the colon, got {words!r}; 0 hides, 1 keeps")
        yield f"--opacity {words}", Opacity(where_of("opacity", name), factor)
    for words in asked.scale:
        name, value = _split("scale", words, "lamp:1.5")
        (factor,) = _numbers("scale", words, value, "a factor above 0", 1)
        if factor <= 0:
            raise ValueError(f"scale: expected a factor above 0 after the colon, got {words!r}; 0.5 halves, 2 doubles")
        yield f"--scale {words}", Move(where_of("scale", name), scale=factor)
    for words in asked.rotate:
        name, value = _split("rotate", words, "table:z,90")
        axis, _, degrees = value.partition(",")
        if axis not in AXES:
            raise ValueError(
                f"rotate: expected an axis (x, y or z) and degrees, got {words!r}; write it as 'table:z,90'"
            )
        (angle,) = _numbers("rotate", words, degrees, "an axis (x, y or z) and degrees", 1)
        yield f"--rotate {words}", Move(where_of("rotate", name), rotation=(axis, angle))
    for words in asked.move:
        name, value = _split("move", words, "table:0.5,0,0")
        yield f"--move {words}", Move(where_of("move", name), _numbers("move", words, value, _THREE, 3))
    for words in asked.duplicate:
        name, value = _split("duplicate", words, "chair:1,0,0")
        yield (
            f"--duplicate {words}",
            Duplicate(where_of("duplicate", name), _numbers("duplicate", words, value, _THREE, 3)),
        )
    for removed, parts in _together(asked.remove, where_of):
        yield f"--remove {' '.join(removed)}", Remove(parts)
    if asked.extract:
        where = tuple(where_of("extract", words) for words in asked.extract)
        yield f"--extract {' '.join(asked.extract)}", Extract(where)
    for words in asked.insert:
        yield f"--insert {words}", _insertion(words)


def inserted_files(edits: Iterable[Any]) -> list[Path]:
    """The files that some edits read."""
    from ..labels.edits import Insert

    return [Path(edit.source) for edit in edits if isinstance(edit, Insert) and isinstance(edit.source, str | Path)]


def classes_of(edits: Iterable[Any]) -> Iterator[str | int]:
    """The classes, by name or index, that edits need in the first splat: those before an inserted one, which may bring some."""
    for edit in edits:
        if edit.op == "insert":
            return
        yield from (rule.name for rule in edit.where if rule.kind == "class")


def check_parts(splats: Any, edits: Iterable[Any]) -> None:
    """Raise a ValueError if an edit names a part of a class (`chair/6`) that `kfgs select` does not list.

    Args:
        splats: the cloud before the edits.
        edits: those of `parse_edits`, without the words.
    """
    import torch

    from ..labels import OfClass, component_numbers
    from ..labels.parts import SPECK

    for rule in (rule for edit in edits for rule in _parts(edit)):
        name = rule.name
        mask = OfClass(name).select(splats).mask
        numbers = component_numbers(splats.means, mask, rule.distance)
        sizes = torch.bincount(numbers[mask])
        count = int((sizes >= SPECK * sizes[0]).sum()) if len(sizes) else 0
        far = "" if rule.distance is None else f" --distance {rule.distance}"
        if rule.part >= count:
            raise ValueError(
                f"{name}/{rule.part + 1}: expected a part from {name}/1 to {name}/{count}, got no part of that number; "
                f"`kfgs select {name} SPLAT{far}` lists them"
                if count
                else f"{name}/{rule.part + 1}: expected Gaussians of class {name!r}, got none in this splat; "
                "`kfgs info SPLAT` lists what it holds"
            )


def _parts(edit: Any) -> list[Any]:
    """The rules of an edit that name a part of a class."""
    return [rule for rule in getattr(edit, "where", ()) if getattr(rule, "part", None) is not None]


def _where(distance: float | None, names: set[str], option: str, words: str) -> Any:
    """A class, or one of its connected parts, as in `chair/2`."""
    from ..labels import OfClass

    name, _, part = words.rpartition("/")
    if words.casefold() in names or not (name and part.isdecimal()):
        return OfClass(words)
    if int(part) == 0:
        raise ValueError(f"{option}: expected parts counted from 1, got {words!r}; '{name}/1' is the largest")
    return OfClass(name, int(part) - 1, distance)


def _together(remove: Sequence[str], where_of: Callable[[str, str], Any]) -> list[tuple[list[str], list[Any]]]:
    """The removed parts by class (ignoring case), because removing one part changes the numbers of the others."""
    found: dict[str, tuple[list[str], list[Any]]] = {}
    for words in dict.fromkeys(remove):
        where = where_of("remove", words)
        said, parts = found.setdefault(where.name.casefold(), ([], []))
        said.append(words)
        parts.append(where)
    return list(found.values())


def _insertion(words: str) -> Any:
    import torch

    from ..cameras.similarity import Similarity
    from ..labels.edits import Insert

    path, colon, value = words.rpartition(":")
    if Path(words).exists() or not colon:
        path, value = words, ""
    if not Path(path).exists():
        raise ValueError(f"insert: expected a splat file, or one with a translation, got {words!r}; no file {path!r}")
    if not value:
        return Insert(Path(path))
    shift = torch.tensor(_numbers("insert", words, value, _THREE, 3), dtype=torch.float64)
    return Insert(Path(path), Similarity(1.0, torch.eye(3, dtype=torch.float64), shift))


def _split(option: str, words: str, example: str) -> tuple[str, str]:
    name, colon, value = words.rpartition(":")
    if not (name and colon and value):
        raise ValueError(
            f"{option}: expected a class and a value, as in {example!r}, got {words!r}; put a colon between"
        )
    return name, value


def _numbers(option: str, words: str, value: str, wanted: str, count: int) -> tuple[float, ...]:
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"{option}: expected {wanted} after the colon, got {words!r}; write it so")
    return tuple(numbers)
