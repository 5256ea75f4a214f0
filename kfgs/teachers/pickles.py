"""A pickle read as data: a stack machine that never calls, imports or sets up anything a file asks for.

`pickle.Unpickler` runs what a file names, and restricting `find_class` still leaves object construction, `__setstate__`
and memory to the file. Here `pickletools` splits the bytes into opcodes and ~60 of them are carried out on plain lists,
tuples and dicts. A global is only a name; calling one gives whatever the caller's table `builders` has for that name, or
else an `Inert` object, on which everything has no effect. All memory used is in proportion to the bytes read.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# What attacks ask for and settings never hold. A file that names them is refused; anything else unknown is inert.
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
_HARMLESS = frozenset({"types.SimpleNamespace", "io.BytesIO", "_io.BytesIO"})

_LITERALS = _words(
    "INT BININT BININT1 BININT2 LONG LONG1 LONG4 STRING BINSTRING SHORT_BINSTRING BINBYTES SHORT_BINBYTES BINBYTES8 "
    "BYTEARRAY8 UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8 FLOAT BINFLOAT"
)
_FRESH: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "EMPTY_DICT": dict,
    "EMPTY_SET": lambda: Inert("builtins.set"),  # no element is hashed: a nested tuple would overflow C's stack
}
_STEPS = (
    10_000_000  # about 300,000 tensors; bounds the time, and the memory that one-byte opcodes ask for (60 bytes each)
)
_WITHOUT_RESULT = _words("MARK POP POP_MARK ADDITEMS APPEND APPENDS SETITEM SETITEMS BUILD")


class UnsafePickleError(ValueError):
    """A pickle asks for something that state dicts never need and attacks do; `args[0]` is its name."""


class BrokenPickleError(ValueError):
    """Bytes that are no pickle, or not a whole one."""


class ByteSource(Protocol):
    """What is read from: `io.BytesIO` or `mmap.mmap`, whose `read(n)` reserves no more memory than there are bytes."""

    def read(self, n: int, /) -> bytes:
        """At most `n` bytes."""
        ...

    def readline(self) -> bytes:
        """The bytes up to a line end."""
        ...


@dataclass(frozen=True, eq=False)
class Global:
    """A name that a pickle wants imported, such as `collections.OrderedDict`; nothing is."""

    name: str


@dataclass(frozen=True, eq=False)
class Inert:
    """Stands for an object that was not made; `name` is that of its class or function."""

    name: str


def read_pickle(
    source: ByteSource,
    builders: Mapping[str, Callable[..., Any]],
    persistent: Callable[[Any], Any] = lambda key: Inert("a persistent object"),
) -> Any:
    """The value of the pickle that starts at the position of `source`, which is left behind its last byte.

    The result is made of None, bool, int, float, str, bytes, list, tuple, dict (items with other keys than str are left
    out), `Global`, `Inert`, and what `builders` and `persistent` return.

    Args:
        source: where the bytes come from.
        builders: what to call for a global, by its full name. Their arguments come from the file: they must check them.
        persistent: turns a persistent id (torch: a storage) into a value; must check it too.

    Raises:
        UnsafePickleError: if a dangerous global is named anywhere before the end, called or not.
        BrokenPickleError: if this is no pickle, or arguments do not fit `builders`.
    """
    machine = _Machine(builders, persistent)
    try:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(source)):  # type: ignore[arg-type]
            if step >= _STEPS:
                raise BrokenPickleError(f"it has more than {_STEPS:,} opcodes")
            if opcode.name == "STOP":
                return machine.stack.pop()
            machine.step(opcode.name, argument)
    except UnsafePickleError:
        raise
    except (
        Exception
    ) as error:  # hostile bytes raise almost anything: IndexError, KeyError, TypeError, struct.error, ...
        raise BrokenPickleError(str(error).partition("\n")[0][:120] or type(error).__name__) from error
    raise BrokenPickleError("it has no end")


def is_unsafe(name: str) -> bool:
    """Whether a global is one that only an attack asks for: `posix.system`, `builtins.eval`, `torch.os.system`."""
    module, *rest = name.split(".")
    if not rest or name in _HARMLESS:
        return False
    if module in ("builtins", "__builtin__"):
        return not _UNSAFE_BUILTINS.isdisjoint(rest)
    return module in _UNSAFE_MODULES or not _UNSAFE_INSIDE.isdisjoint(rest[:-1])


class _Machine:
    """The stack, the marks and the memo of one pickle."""

    def __init__(self, builders: Mapping[str, Callable[..., Any]], persistent: Callable[[Any], Any]) -> None:
        self.builders, self.persistent = builders, persistent
        self.stack: list[Any] = []
        self.marked: list[list[Any]] = []  # stacks below each mark
        self.memo: dict[int, Any] = {}  # no list: a file may put at index 2^32

    def step(self, name: str, argument: Any) -> None:
        """Carry out one opcode."""
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _FRESH:
            self.stack.append(_FRESH[name]())
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self.memo[argument] = self.stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[argument])
        elif name not in ("PROTO", "FRAME"):
            action = getattr(self, "_" + name.lower(), None)
            if action is None:
                raise BrokenPickleError(f"it uses {name}, which no state dict does")
            result = action(argument)
            if name not in _WITHOUT_RESULT:
                self.stack.append(result)

    def _pop_marked(self) -> list[Any]:
        items, self.stack = self.stack, self.marked.pop()
        return items

    def _mark(self, _: Any) -> None:
        self.marked.append(self.stack)
        self.stack = []

    def _pop(self, _: Any) -> None:
        if self.stack:
            self.stack.pop()
        else:
            self._pop_marked()

    def _pop_mark(self, _: Any) -> None:
        self._pop_marked()

    def _dup(self, _: Any) -> Any:
        return self.stack[-1]

    def _list(self, _: Any) -> list[Any]:
        return self._pop_marked()

    def _tuple(self, _: Any) -> tuple[Any, ...]:
        return tuple(self._pop_marked())

    def _tuple1(self, _: Any) -> tuple[Any, ...]:
        return (self.stack.pop(),)

    def _tuple2(self, _: Any) -> tuple[Any, ...]:
        b, a = self.stack.pop(), self.stack.pop()
        return a, b

    def _tuple3(self, _: Any) -> tuple[Any, ...]:
        c, b, a = self.stack.pop(), self.stack.pop(), self.stack.pop()
        return a, b, c

    def _dict(self, _: Any) -> dict[str, Any]:
        return string_items(_pairs(self._pop_marked()))

    def _frozenset(self, _: Any) -> Inert:
        self._pop_marked()
        return Inert("builtins.frozenset")

    def _additems(self, _: Any) -> None:
        self._pop_marked()

    def _append(self, _: Any) -> None:
        self._extend([self.stack.pop()])

    def _appends(self, _: Any) -> None:
        self._extend(self._pop_marked())

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is list:
            self.stack[-1].extend(items)

    def _setitem(self, _: Any) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._update([(key, value)])

    def _setitems(self, _: Any) -> None:
        self._update(_pairs(self._pop_marked()))

    def _update(self, pairs: list[tuple[Any, Any]]) -> None:
        if type(self.stack[-1]) is dict:
            self.stack[-1].update(string_items(pairs))

    def _global(self, argument: str) -> Global:  # "module name", as pickletools joins them
        name = argument.replace(" ", ".", 1)
        if is_unsafe(name):
            raise UnsafePickleError(name)
        return Global(name)

    def _stack_global(self, _: Any) -> Global:
        name, module = self.stack.pop(), self.stack.pop()
        if type(name) is not str or type(module) is not str:
            raise BrokenPickleError("it names a global by something else than text")
        return self._global(f"{module} {name}")

    def _ext1(self, code: int) -> Global:
        return Global(f"extension {code}")

    _ext2 = _ext4 = _ext1

    def _call(self, function: Any, arguments: Any) -> Any:
        name = function.name if isinstance(function, Global) else "an inert object"
        if name in self.builders:
            return self.builders[name](*arguments)
        return Inert(name)

    def _reduce(self, _: Any) -> Any:
        arguments, function = self.stack.pop(), self.stack.pop()
        return self._call(function, arguments)

    _newobj = _reduce

    def _newobj_ex(self, _: Any) -> Any:
        self.stack.pop()  # keyword arguments
        return self._reduce(None)

    def _obj(self, _: Any) -> Any:
        function, *arguments = self._pop_marked()
        return self._call(function, arguments)

    def _inst(self, argument: str) -> Any:
        return self._call(self._global(argument), self._pop_marked())

    def _build(self, _: Any) -> None:
        self.stack.pop()  # the state of an object that was not made, or attributes of a dict (`_metadata`)

    def _persid(self, argument: str) -> Any:
        return self.persistent(argument)

    def _binpersid(self, _: Any) -> Any:
        return self.persistent(self.stack.pop())


def string_items(pairs: Any) -> dict[str, Any]:
    """A dict of those `(key, value)` pairs whose key is text; other keys are not even hashed."""
    return {key: value for key, value in pairs if type(key) is str}


def _pairs(items: list[Any]) -> list[tuple[Any, Any]]:
    return list(zip(items[::2], items[1::2], strict=True))
