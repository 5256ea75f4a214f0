"""The identity of a user's teacher as JSON (code, weights, options), so that a cache notices changes."""

from __future__ import annotations

import dis
import functools
import inspect
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from .._files import as_path, digest_file, digest_value

_DIGITS = 16  # of a digest of code: 64 bits
_PLAIN = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis))
_NESTED = (tuple, list, slice, set, frozenset, dict, torch.dtype, torch.device)


def code_identity(source: Any) -> dict[str, str]:
    """The place where a function (or a class, or an object's class) is defined, and a digest of its code.

    The digest covers the compiled code: instructions with their names and constants, and plain default arguments. For a
    class it covers all methods and plain attributes (also in tuples, lists, dicts) of the class and of its bases in the
    same module. Comments, line numbers and docstrings do not count. **Not noticed** are the values of globals and
    closures, the attributes of an object, nested classes, and changes in called functions: a teacher that relies on those
    needs an `identity`. Another minor version of Python compiles to other code, so it counts as a change.

    Returns:
        `source`, "package.module:name", and `code`, hexadecimal digits.

    Example:
        >>> code_identity(lambda image: image)["code"] == code_identity(lambda image: 1 - image)["code"]
        False
    """
    named = source
    while isinstance(named, functools.partial):
        named = named.func
    named = named if hasattr(named, "__qualname__") else type(named)
    where = f"{getattr(named, '__module__', None) or 'builtins'}:{named.__qualname__}"
    return {"source": where, "code": digest_value(_describe(source))[:_DIGITS]}


def weights_identity(weights: str | Path | None) -> str | None:
    """SHA-256 of a file, or of the files in a folder (without hidden ones); any other text as it is."""
    if weights is None or weights == "":
        return None
    path = as_path(weights)
    if path.is_file():
        return digest_file(path)
    if path.is_dir():
        names = sorted(file.relative_to(path) for file in path.rglob("*") if file.is_file())
        seen = [name for name in names if not any(part.startswith(".") for part in name.parts)]
        return digest_value([[name.as_posix(), digest_file(path / name)] for name in seen])
    return str(weights)


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as JSON: tuples become lists, and unknown types text (without an object's address)."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(key): plain(one) for key, one in value.items()}
        if isinstance(value, list | tuple):
            return [plain(one) for one in value]
        if value is None or type(value) in (bool, int, str) or (type(value) is float and abs(value) < float("inf")):
            return value
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        text = str(value)
        return kind if " at 0x" in text else f"{kind} {text}"

    return {name: plain(value) for name, value in options.items()}


def _describe(source: Any) -> Any:
    """JSON of everything visible that decides what a callable does."""
    if isinstance(source, functools.partial):
        named = {name: _constant(value) for name, value in source.keywords.items()}
        return ["partial", _describe(source.func), [_constant(value) for value in source.args], named]
    if inspect.isclass(source):
        return _describe_class(source)
    source = inspect.unwrap(getattr(source, "__func__", source))  # removes decorators, for instance torch.no_grad()
    code = getattr(source, "__code__", None)
    if isinstance(code, types.CodeType):
        defaults = [
            *(getattr(source, "__defaults__", None) or ()),
            *(getattr(source, "__kwdefaults__", None) or {}).values(),
        ]
        return [_describe_code(code), [_constant(value) for value in defaults]]
    if hasattr(source, "__qualname__"):  # a builtin
        return source.__qualname__
    return _describe_class(type(source))


def _describe_class(source: type) -> list[Any]:
    found = []
    for base in source.__mro__:
        if base.__module__ != source.__module__:
            continue
        for name, member in sorted(vars(base).items()):
            methods: list[Any] = [member]
            if isinstance(member, property):
                methods = [member.fget, member.fset]
            elif isinstance(member, functools.cached_property):
                methods = [member.func]
            for method in methods:
                code = getattr(inspect.unwrap(getattr(method, "__func__", method)), "__code__", None)
                if isinstance(code, types.CodeType):
                    found.append([base.__qualname__, name, _describe(method)])
                elif isinstance(method, (*_PLAIN, *_NESTED)) and not name.startswith("__"):
                    found.append([base.__qualname__, name, _constant(method)])
    return found


def _describe_code(code: types.CodeType) -> list[Any]:
    """Instructions with names and constants instead of their numbers, which change when a docstring is added."""
    return [[step.opname, _constant(step.argval)] for step in dis.get_instructions(code)]


def _constant(value: Any) -> Any:
    """A constant as JSON; only the type of a constant that is not plain."""
    if isinstance(value, types.CodeType):  # a nested function
        return _describe_code(value)
    if isinstance(value, tuple | list):
        return [_constant(one) for one in value]
    if isinstance(value, slice):
        return ["slice", *(_constant(one) for one in (value.start, value.stop, value.step))]
    if isinstance(value, set | frozenset):  # in no order, and another one in each process
        return ["set", *sorted(repr(one) for one in value)]
    if isinstance(value, dict):
        return ["dict", *([repr(key), _constant(one)] for key, one in value.items())]
    if isinstance(value, torch.dtype | torch.device):
        return repr(value)
    return repr(value) if isinstance(value, _PLAIN) else type(value).__qualname__
