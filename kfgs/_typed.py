"""The decorator of public functions that checks the kinds of their arguments by the types that they state."""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, TypeVar, Union, cast, get_args, get_origin

import numpy as np
import torch
from torch import Tensor

from ._check import as_tensor

F = TypeVar("F", bound=Callable[..., Any])
MADE = {
    "Scene": "load_scene(path) reads one",
    "SemanticField": "SemanticField.load(path) reads one",
    "LabelSet": "load_label_set(path) reads one",
    "Gaussians": "read_splats(path) gives some",
    "Camera": "a Scene has .cameras",
}
"""How to make what `typed` misses."""


def typed(function: F) -> F:
    """Decorator of public functions and dataclasses: check the kinds of arguments before the work.

    An argument is checked if its type is one or more of classes of kfgs, paths, functions and None; a list, dict or other
    collection; True or False; or a tensor, for which an array or a list of numbers is converted. Other kinds, and the values,
    are left to the function. Raises a TypeError that names the argument and says how to make the object.
    """
    if inspect.isclass(function):
        setattr(function, "__init__", typed(vars(function)["__init__"]))  # noqa: B010 (mypy)
        return function
    signature = inspect.signature(function)
    single = [
        one.name for one in signature.parameters.values() if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    kinds: dict[str, tuple[type, ...]] = {}
    known: list[bool] = []

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_compiling():  # it cannot trace this
            return function(*args, **kwargs)
        if not known:  # not before all modules are there
            kinds.update({name: _kinds(hint) for name, hint in _hints(function).items() if name in single})
            known.append(True)
        bound = signature.bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            bound.arguments[name] = _checked(name, value, kinds.get(name, ()))
        return function(*bound.args, **bound.kwargs)

    return cast(F, checked)


class _Each(NamedTuple):
    """What `typed` knows of a collection."""

    kind: type
    of: tuple[type, ...]
    """Classes of kfgs whose objects it holds; empty if they are others."""


def _hints(function: Any) -> dict[str, Any]:
    """The types of the parameters; without those that a module imports for the type checker only."""
    found = {}
    for name, hint in inspect.get_annotations(function).items():
        with contextlib.suppress(NameError):
            found[name] = eval(hint, function.__globals__) if isinstance(hint, str) else hint
    return found


def _kinds(hint: Any) -> tuple[Any, ...]:
    """The classes and collections of a type hint that `typed` checks; empty if it checks none."""
    members = get_args(hint) if isinstance(hint, UnionType) or get_origin(hint) is Union else (hint,)
    found = tuple(_each(one) for one in members)
    if hint is bool:
        return (int, np.bool_)
    if set(members) <= {Tensor, NoneType}:
        return found
    ours = [one for one in found if one is Callable or isinstance(one, _Each) or _is_ours(one)]
    plain = all(one in ours or one in (str, Path, NoneType) for one in found)
    return found if ours and plain else ()


def _is_ours(kind: Any) -> bool:
    ours = isinstance(kind, type) and kind.__module__.startswith("kfgs.")
    return ours and not getattr(kind, "_is_protocol", False)


def _each(hint: Any) -> Any:
    origin = get_origin(hint) or hint
    if origin is Callable:
        return Callable
    if origin in (list, tuple, Sequence):
        kinds = get_args(hint)[:1] and _kinds(get_args(hint)[0])
        return _Each(Sequence, kinds if all(map(_is_ours, kinds)) else ())
    for kind in (Mapping, Iterable):
        if origin is kind or (kind is Mapping and origin is dict):
            return _Each(kind, ())
    return hint


def _checked(name: str, value: Any, expected: tuple[Any, ...]) -> Any:
    """The value, if it is of one of the kinds; a tensor of numbers where one belongs."""
    if not expected or any(_fits(value, kind) for kind in expected):
        return value
    if Tensor in expected:
        return as_tensor(name, value)
    at, got = name, value
    if type(value) in (list, tuple):  # name what is wrong in it
        of = next((kind.of for kind in expected if isinstance(kind, _Each) and kind.of), ())
        for i, one in enumerate(value):
            if of and not isinstance(one, of):
                at, got, expected = f"{name}[{i}]", one, of
                break
    raise TypeError(f"{at}: expected {_in_words(expected)}, got {type(got).__name__}; {_made(expected)}")


def _fits(value: Any, kind: Any) -> bool:
    if not isinstance(kind, _Each):
        return isinstance(value, kind)
    if isinstance(value, str | bytes | Tensor) or (kind.kind is not Sequence and not isinstance(value, kind.kind)):
        return False
    if type(value) in (list, tuple):
        return not kind.of or all(isinstance(one, kind.of) for one in value)
    return kind.kind is not Sequence or (hasattr(value, "__len__") and hasattr(value, "__getitem__"))


def _in_words(kinds: tuple[Any, ...]) -> str:
    words = {str: "a path", Path: "a path", NoneType: "None", Callable: "a function", Mapping: "a dict"}
    words |= {int: "True", np.bool_: "False"}
    kinds = tuple(kind.kind if isinstance(kind, _Each) else kind for kind in kinds)
    return " or ".join(dict.fromkeys(words.get(kind, f"a {kind.__name__}") for kind in kinds))


def _made(kinds: tuple[Any, ...]) -> str:
    kind = next(kind for kind in kinds if kind not in (str, Path, NoneType))
    if kind is int:
        return "pass a bool"
    if isinstance(kind, _Each):
        return "pass a dict" if kind.kind is Mapping else "pass a list"
    return (
        MADE.get(kind.__name__, f"pass {kind.__name__}(...)")
        if kind is not Callable
        else "pass one, for instance print"
    )
