"""Which names in a pickle only an attack asks for; everything else is let be, since nothing in a pickle is ever run.

Refusing a file is a warning to its user, not the protection: that is `pickles`, which calls nothing. So a name is refused
that runs commands, code or files, and one that is only a way to other names (`getattr`) is judged by where it leads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_UNSAFE_MODULES = _words(
    "os posix nt subprocess sys pty runpy shutil socket webbrowser importlib imp ctypes _ctypes cffi code codeop pdb bdb "
    "timeit profile cProfile asyncio multiprocessing _thread pickle _pickle marshal types urllib urllib2 http ftplib "
    "smtplib ssl requests pip ensurepip venv io _io operator _operator pkgutil zipimport doctest commands popen2"
)
_UNSAFE_BUILTINS = _words(
    "eval exec execfile compile open file __import__ getattr setattr delattr globals locals vars input raw_input "
    "breakpoint apply"
)
_UNSAFE_INSIDE = _words("os posix nt sys subprocess importlib builtins __builtins__ __globals__")
_WAYS_OUT = _words(  # from any object to all others; no setting is reached through them
    "__builtins__ __globals__ __dict__ __class__ __base__ __bases__ __mro__ __subclasses__ __getattribute__ __code__ "
    "__closure__ __loader__ __spec__ __import__ __self__ __func__ __wrapped__"
)
# Attributes: the same words, fewer those that honest classes have too (`Function.apply`, `Config.types`).
_COMMON = _words("apply compile open input file vars io code types profile timeit requests commands http")
_UNSAFE_ATTRIBUTES = (_UNSAFE_MODULES | _UNSAFE_BUILTINS | _UNSAFE_INSIDE | _WAYS_OUT) - _COMMON | _words(
    "system popen Popen spawn"
)
_GETATTR = _words("builtins.getattr __builtin__.getattr")
_ATTRGETTER = _words("operator.attrgetter _operator.attrgetter")
_OPERATORS = _words("itemgetter getitem or_ and_ xor not_ neg add sub mul truediv floordiv mod pow eq ne lt le gt ge")
# How Python writes down nested classes, methods, `list[int]`, `int | str` and sort keys.
_HARMLESS = (
    _GETATTR
    | _ATTRGETTER
    | {f"{module}.{name}" for module in ("operator", "_operator") for name in _OPERATORS}
    | _words("io.BytesIO _io.BytesIO io.StringIO _io.StringIO types.SimpleNamespace types.MappingProxyType")
    | _words("types.GenericAlias types.UnionType types.NoneType")
)


def is_unsafe(name: str) -> bool:
    """Whether a global is one that only an attack asks for: `posix.system`, `builtins.eval`, `torch.os.system`."""
    module, *rest = name.split(".")
    if not rest or name in _HARMLESS:
        return False
    if module in ("builtins", "__builtin__") and not _UNSAFE_BUILTINS.isdisjoint(rest):
        return True
    return module in _UNSAFE_MODULES or not _UNSAFE_INSIDE.isdisjoint(rest[:-1]) or not _WAYS_OUT.isdisjoint(rest)


def is_unsafe_attribute(path: str) -> bool:
    """Whether an attribute, or one of a dotted path of them, leads to what only an attack asks for: `os`, `__globals__`."""
    return not _UNSAFE_ATTRIBUTES.isdisjoint(path.split("."))


def is_getattr(name: str) -> bool:
    """Whether a global is the function `getattr`, whose call names another global."""
    return name in _GETATTR


def is_way(name: str) -> bool:
    """Whether a global is a function from names to attributes: harmless when called, opaque when handed to another."""
    return name in _GETATTR or name in _ATTRGETTER


def attributes_of(name: str, arguments: Sequence[Any]) -> Sequence[Any]:
    """The attributes that calling a global with `arguments` asks for; none unless it is `getattr` or `attrgetter`."""
    if name in _GETATTR:
        return arguments[1:2]
    return arguments[:64] if name in _ATTRGETTER else ()
