"""Edits as they are written on a command line: `plant:#c04040`, `lamp:0.3`, `table:0.5,0,0`, `chair/2:z,90`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal


def edits_from_words(
    *,
    recolor: Sequence[str] = (),
    opacity: Sequence[str] = (),
    scale: Sequence[str] = (),
    rotate: Sequence[str] = (),
    move: Sequence[str] = (),
    duplicate: Sequence[str] = (),
    remove: Sequence[str] = (),
    extract: Sequence[str] = (),
    insert: Sequence[str] = (),
    mode: Literal["tint", "hue"] = "tint",
) -> Iterator[Any]:
    """The edits that some options ask for, in this order: what is removed later was still there to be recoloured.

    A class may be followed by a part of it: `chair/1` is the largest connected part of all that is chair, `chair/2` the
    next, as `connected_parts` lists them. Each edit counts them anew, in what the edits before left; all parts of one class that
    are removed are counted together. A class whose own name ends so can be edited in Python alone.

    Raises:
        ValueError: if an option lacks its value, or the value is of another kind; the message quotes the words.
    """
    from ..labels.color import parse_color
    from ..labels.edits import Duplicate, Extract, Move, Opacity, Recolor, Remove, Turn
    from ..labels.edits.motion import AXES
    from ..labels.where import Either

    for words in recolor:
        name, value = _split("recolor", words, "plant:#c04040")
        yield Recolor(_where("recolor", name), parse_color(value, "recolor"), mode)
    for words in opacity:
        name, value = _split("opacity", words, "lamp:0.3")
        (factor,) = _numbers("opacity", words, value, "a factor from 0 to 1", 1)
        if not 0 <= factor <= 1:
            raise ValueError(f"opacity: expected a factor from 0 to 1 after the colon, got {words!r}; 0 hides, 1 keeps")
        yield Opacity(_where("opacity", name), factor)
    for words in scale:
        name, value = _split("scale", words, "lamp:1.5")
        (factor,) = _numbers("scale", words, value, "a factor above 0", 1)
        if factor <= 0:
            raise ValueError(f"scale: expected a factor above 0 after the colon, got {words!r}; 0.5 halves, 2 doubles")
        yield Move(_where("scale", name), scale=factor)
    for words in rotate:
        name, value = _split("rotate", words, "table:z,90")
        axis, _, degrees = value.partition(",")
        if axis not in AXES:
            raise ValueError(
                f"rotate: expected an axis (x, y or z) and degrees, got {words!r}; write it as 'table:z,90'"
            )
        (angle,) = _numbers("rotate", words, degrees, "an axis (x, y or z) and degrees", 1)
        yield Move(_where("rotate", name), rotation=Turn(AXES[axis], angle))
    for words in move:
        name, value = _split("move", words, "table:0.5,0,0")
        yield Move(_where("move", name), _numbers("move", words, value, "3 numbers between commas", 3))
    for words in duplicate:
        name, value = _split("duplicate", words, "chair:1,0,0")
        yield Duplicate(_where("duplicate", name), _numbers("duplicate", words, value, "3 numbers between commas", 3))
    for parts in _together(remove).values():
        yield Remove(parts[0] if len(parts) == 1 else Either(tuple(parts)))
    if extract:
        yield Extract(Either(tuple(_where("extract", words) for words in extract)))
    for words in insert:
        yield _insertion(words)


def inserted_files(edits: Iterable[Any]) -> list[Path]:
    """The files that some edits read."""
    from ..labels.edits import Insert

    return [Path(edit.source) for edit in edits if isinstance(edit, Insert) and isinstance(edit.source, str | Path)]


def _where(option: str, words: str) -> Any:
    """A class, or one of its connected parts, as in `chair/2`."""
    from ..labels.where import Component, OfClass

    name, _, part = words.rpartition("/")
    if not (name and part.isdecimal()):
        return OfClass(words)
    if int(part) == 0:
        raise ValueError(f"{option}: expected parts counted from 1, got {words!r}; '{name}/1' is the largest")
    return Component(OfClass(name), rank=int(part) - 1)


def _together(remove: Sequence[str]) -> dict[str, list[Any]]:
    """What is removed of each class, whatever the case of its name: removing one part would number the others anew."""
    found: dict[str, list[Any]] = {}
    for words in dict.fromkeys(remove):
        where = _where("remove", words)
        of_class = getattr(where, "where", where)
        found.setdefault(of_class.name.casefold(), []).append(where)
    return found


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
    shift = torch.tensor(_numbers("insert", words, value, "3 numbers between commas", 3), dtype=torch.float64)
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
