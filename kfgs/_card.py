"""How an object shows itself: one short line in Python, and a small table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import Any

LONGEST = 100  # characters of one value in a line
LINE = 199  # characters of a whole line: two lines of a terminal
LEFT = "text-align:left;padding:1px 10px 1px 0"  # notebooks centre cells by default


def html_card(title: str, facts: Mapping[str, object]) -> str:
    """An HTML table for `_repr_html_`: a title and one row for each fact that is not None. Everything is escaped."""
    rows = ""
    for name, value in facts.items():
        shown = cut(value) if isinstance(value, str) else f"{value:,}" if type(value) is int else short_value(value)
        if value is not None:
            rows += f'<tr><th style="{LEFT}">{escape(name)}</th><td style="{LEFT}">{escape(shown)}</td></tr>'
    return f'<table><caption style="{LEFT};font-weight:bold">{escape(title)}</caption><tbody>{rows}</tbody></table>'


def short_repr(thing: Any) -> str:
    """A line for `__repr__` of a dataclass or a named tuple: its fields, tensors by shape and type only; at most `LINE` long.

    For instance `Nearest(codeword=[5, 3] int64, similarity=[5, 3] float32)`. Fields that are None, and fields declared with
    `repr=False`, are left out.
    """
    names = [field.name for field in fields(thing) if field.repr] if is_dataclass(thing) else thing._fields
    values = {name: getattr(thing, name) for name in names}
    inside = ", ".join(f"{name}={short_value(value)}" for name, value in values.items() if value is not None)
    return cut(f"{type(thing).__name__}({inside})", LINE)


def short_value(value: object) -> str:
    """One value in at most `LONGEST` characters: a tensor by its shape and type, a path by its name, a long list by its length.

    Example:
        >>> short_value(range(1000)), short_value([1.5, 2.0]), short_value(list("a long list"))
        ('range(0, 1000)', '[1.5, 2.0]', '11 of str')
    """
    shape: Any = getattr(value, "shape", None)
    if shape is not None and hasattr(value, "dtype"):
        device = str(getattr(value, "device", "cpu"))
        return f"{list(shape)} {value.dtype}".replace("torch.", "") + ("" if device == "cpu" else f" on {device}")
    if isinstance(value, Mapping):
        few = cut(", ".join(f"{key}: {short_value(part)}" for key, part in value.items()))
        return few if len(value) <= 3 else f"{len(value)} entries"
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        if value and all(isinstance(item, Path) for item in value):
            return cut(f"[{', '.join(item.name for item in value)}]")
        simple = len(value) <= 4 and all(isinstance(item, str | int | float) for item in value)
        kinds = sorted({type(item).__name__ for item in value})
        return cut(repr(value) if simple else f"{len(value)} of {' or '.join(kinds)}")
    return cut(repr(value))


def cut(text: str, longest: int = LONGEST) -> str:
    """A text in one line of at most `longest` characters; a long one ends at a word, if it has one near there, and "...".

    Example:
        >>> cut("a line of several words", 16)
        'a line of...'
    """
    line = " ".join(text.split())
    if len(line) <= longest:
        return line
    head = line[: longest - 2].rpartition(" ")[0]  # whole words
    return (head if len(head) >= longest // 2 else line[: longest - 3]).rstrip(",;:") + "..."


def error_line(error: BaseException) -> str:
    """The first line of an error, with its type before it and at most 200 characters of its own."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}".rstrip(": ")


def short_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory is short. torch and the C++ library say it in a RuntimeError."""
    words = ("can't allocate memory", "out of memory", "bad_alloc", "can't start new thread")
    is_runtime = isinstance(error, RuntimeError)
    return isinstance(error, MemoryError) or (is_runtime and any(word in str(error).lower() for word in words))


def say_coordinate(value: float, digits: int) -> str:
    """A coordinate for people: some digits, or two after the point if it is far from zero."""
    return f"{value:.{digits}g}" if abs(value) < 10_000 else f"{value:.2f}"
