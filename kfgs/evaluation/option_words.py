"""Options of protocols as words of a command line: `threshold=0.5`, `texts=wall,floor`."""

from __future__ import annotations

import difflib
import json
import types
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from .._files import parse_json
from .registry import get_protocol


def parse_options(protocol: str, words: Sequence[str], inputs: Sequence[str] = ()) -> dict[str, Any]:
    """Read `name=value` words in the types of a protocol's options.

    Args:
        protocol: a name of `PROTOCOLS`.
        words: each an option. Lists are written with commas, pairs of numbers as JSON, nothing as "none".
        inputs: other names that are allowed; their values stay text.

    Raises:
        ValueError: if a word has no `=`, an unknown or repeated name, or a value of another type; the message says which.

    Example:
        >>> parse_options("lerf-ovs-2d", ["threshold=0.5", "negatives=object,stuff", "level=2"])
        {'threshold': 0.5, 'negatives': ('object', 'stuff'), 'level': 2}
    """
    kind = type(get_protocol(protocol))
    hints = get_type_hints(kind)
    known = [*(option.name for option in fields(kind)), *inputs]
    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = (part.strip() for part in word.partition("="))
        if not equals or name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"write {known[0]}=VALUE" if known else "leave it out"
            raise ValueError(
                f"set: expected name=value with one of {', '.join(known) or 'no option'}, got {word!r}; {hint}"
            )
        if name in found:
            raise ValueError(f"set: expected {name} once, got it twice; leave one out")
        try:
            found[name] = value if name in inputs else _parse(hints[name], value)
        except ValueError as error:
            raise ValueError(f"set: expected {name} as {_say(hints[name])}, got {value!r}; write it so") from error
    return found


def _parse(hint: Any, text: str) -> Any:
    origin, inside = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        for one in sorted(inside, key=lambda one: _plainness(one)):
            try:
                return _parse(one, text)
            except ValueError:
                continue
        raise ValueError(text)
    if hint is type(None):
        if text.lower() == "none":
            return None
        raise ValueError(text)
    if origin is Literal:
        return _look_up({str(word): word for word in inside}, text)
    if hint is bool:
        return _look_up({"true": True, "yes": True, "false": False, "no": False}, text.lower())
    if origin is tuple:
        return _parse_tuple(inside, text)
    return hint(text)


def _parse_tuple(inside: tuple[Any, ...], text: str) -> tuple[Any, ...]:
    nested = any(get_origin(one) is tuple for one in inside)
    parts = (
        parse_json(text)
        if nested or text.startswith("[")
        else [part.strip() for part in text.split(",") if part.strip()]
    )
    if not isinstance(parts, list):
        raise ValueError(text)
    kinds = [inside[0]] * len(parts) if inside[-1] is Ellipsis else list(inside)
    if len(kinds) != len(parts):
        raise ValueError(text)
    return tuple(
        _parse(kind, part if isinstance(part, str) else json.dumps(part))
        for kind, part in zip(kinds, parts, strict=True)
    )


def _look_up(words: dict[str, Any], text: str) -> Any:
    if text not in words:
        raise ValueError(text)
    return words[text]


def _plainness(kind: Any) -> int:
    """The order in which the members of a union are tried: exact words first, free text last."""
    if kind is type(None) or get_origin(kind) is Literal:
        return 0
    return 2 if get_origin(kind) is tuple and str in get_args(kind) else 1


def _say(hint: Any) -> str:
    """A type in words."""
    origin, inside = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_say(one) for one in inside)
    if origin is Literal:
        return " or ".join(str(word) for word in inside)
    if origin is tuple:
        if any(get_origin(one) is tuple for one in inside):
            return "a JSON list of pairs, [[90, 15], [29, 4]]"
        return f"{_say(inside[0]).removeprefix('a ')}s between commas"
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", type(None): "none"}
    return words.get(hint, str(hint))
