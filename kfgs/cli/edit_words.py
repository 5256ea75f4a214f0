"""Edits as they are written on a command line: `plant:#c04040`, `lamp:0.3`, `table:0.5,0,0`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any


def edits_from_words(
    *,
    recolor: Sequence[str] = (),
    opacity: Sequence[str] = (),
    move: Sequence[str] = (),
    remove: Sequence[str] = (),
    extract: Sequence[str] = (),
) -> Iterator[Any]:
    """The edits that some options ask for, in this order: what is removed later was still there to be recoloured.

    Raises:
        ValueError: if an option lacks its value, or the value is of another kind.
    """
    from ..labels.color import parse_color
    from ..labels.edits import Extract, Move, Opacity, Recolor, Remove
    from ..labels.where import Either, OfClass

    for words in recolor:
        name, value = _split("recolor", words, "plant:#c04040")
        yield Recolor(OfClass(name), parse_color(value, "recolor"))
    for words in opacity:
        name, value = _split("opacity", words, "lamp:0.3")
        yield Opacity(OfClass(name), _numbers("opacity", words, value, 1)[0])
    for words in move:
        name, value = _split("move", words, "table:0.5,0,0")
        yield Move(OfClass(name), tuple(_numbers("move", words, value, 3)))
    for name in remove:
        yield Remove(OfClass(name))
    if extract:
        yield Extract(Either(tuple(OfClass(name) for name in extract)))


def _split(option: str, words: str, example: str) -> tuple[str, str]:
    name, colon, value = words.rpartition(":")
    if not (name and colon and value):
        raise ValueError(
            f"{option}: expected a class and a value, as in {example!r}, got {words!r}; put a colon between"
        )
    return name, value


def _numbers(option: str, words: str, value: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        wanted = "a number" if count == 1 else f"{count} numbers between commas"
        raise ValueError(f"{option}: expected {wanted} after the colon, got {words!r}; write it so")
    return numbers
