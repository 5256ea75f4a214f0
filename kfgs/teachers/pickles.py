"""A pickle read as data: a stack machine that never calls, imports or sets up anything a file asks for.

`pickle.Unpickler` runs what a file names, and restricting `find_class` still leaves object construction, `__setstate__`
and memory to the file. Here `pickletools` splits the bytes into opcodes and ~60 of them are carried out on plain lists,
tuples and dicts. A global is only a name; calling one gives whatever the caller's table `builders` has for that name, or
else an `Inert` object, on which everything has no effect. Memory and time are in proportion to the bytes read, about 100
bytes for each: an opcode makes one small object, and what a memoised object could multiply is counted or bounded (the
lists that calls copy, their arguments, the lengths of names and keys).
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from .pickle_names import attributes_of, is_getattr, is_getter, is_unsafe, is_unsafe_attribute, is_way


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


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
    "EMPTY_SET": lambda: _SET,  # no element is hashed: a nested tuple would overflow C's stack
}
_STEPS = (
    10_000_000  # about 300,000 tensors; bounds the time, and the memory that one-byte opcodes ask for (60 bytes each)
)
_NAME = 256  # characters of a global's name: two memoised texts of any length would be joined again and again
_WORDS = 32  # of a global's name, each of which is looked up; Python's own have less than 10
_KEY = 4096  # characters of a dict's key: equal keys that are two objects are compared again and again
_ARGUMENTS = 64  # of a call that a builder answers; torch's have 7
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


@dataclass(frozen=True, eq=False, slots=True)
class Global:
    """A name that a pickle wants imported, such as `collections.OrderedDict`; nothing is."""

    name: str


@dataclass(frozen=True, eq=False, slots=True)
class Inert:
    """Stands for an object that was not made; `name` is that of its class or function."""

    name: str


_SET: Inert = Inert("builtins.set")


def read_pickle(
    source: ByteSource,
    builders: Mapping[str, Callable[..., Any]],
    persistent: Callable[[Any], Any] = lambda key: Inert("a persistent object"),
) -> Any:
    """The value of the pickle that starts at the position of `source`, which is left behind its last byte.

    The result is made of None, bool, int, float, str, bytes, list, tuple, dict (items with other keys than str, or longer
    ones than 4,096 characters, are left out), `Global`, `Inert`, and what `builders` and `persistent` return.

    Args:
        source: where the bytes come from.
        builders: what to call for a global, by its full name. Their arguments come from the file: they must check them.
        persistent: turns a persistent id (torch: a storage) into a value; must check it too.

    Raises:
        UnsafePickleError: if a dangerous global is named anywhere before the end, called or not, or reached by `getattr`;
            or if `getattr` itself is anything but called (an argument, an item, a state).
        BrokenPickleError: if this is no pickle, arguments do not fit `builders`, or it would grow out of proportion.
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


class _Machine:
    """The stack, the marks and the memo of one pickle."""

    def __init__(self, builders: Mapping[str, Callable[..., Any]], persistent: Callable[[Any], Any]) -> None:
        self.builders, self.persistent = builders, persistent
        self.stack: list[Any] = []
        self.marked: list[list[Any]] = []  # stacks below each mark
        self.memo: dict[int, Any] = {}  # no list: a file may put at index 2^32
        self.done = self.copied = 0  # opcodes, and elements of lists that calls got

    def step(self, name: str, argument: Any) -> None:
        """Carry out one opcode."""
        self.done += 1
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
        return _held(items)

    def _pop_held(self) -> Any:
        """The top of the stack, as part of something else."""
        return _held([self.stack.pop()])[0]

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
        return (self._pop_held(),)

    def _tuple2(self, _: Any) -> tuple[Any, ...]:
        b, a = self._pop_held(), self._pop_held()
        return a, b

    def _tuple3(self, _: Any) -> tuple[Any, ...]:
        c, b, a = self._pop_held(), self._pop_held(), self._pop_held()
        return a, b, c

    def _dict(self, _: Any) -> dict[str, Any]:
        return string_items(_pairs(self._pop_marked()))

    def _frozenset(self, _: Any) -> Inert:
        self._pop_marked()
        return Inert("builtins.frozenset")

    def _additems(self, _: Any) -> None:
        self._pop_marked()

    def _append(self, _: Any) -> None:
        self._extend([self._pop_held()])

    def _appends(self, _: Any) -> None:
        self._extend(self._pop_marked())

    def _extend(self, items: list[Any]) -> None:
        if type(self.stack[-1]) is list:
            self.stack[-1].extend(items)

    def _setitem(self, _: Any) -> None:
        value, key = self._pop_held(), self._pop_held()
        self._update([(key, value)])

    def _setitems(self, _: Any) -> None:
        self._update(_pairs(self._pop_marked()))

    def _update(self, pairs: list[tuple[Any, Any]]) -> None:
        if type(self.stack[-1]) is dict:
            self.stack[-1].update(string_items(pairs))

    def _global(self, argument: str) -> Global:  # "module name", as pickletools joins them
        module, _, path = argument.partition(" ")
        name = f"{module}.{path}" if path else module
        if name.count(".") >= _WORDS:
            raise BrokenPickleError(f"it names a global by more than {_WORDS} words")
        inside = path.rpartition(".")[0]  # of a dotted path: what lies on the way
        return self._named(name, is_unsafe(name) or is_unsafe_attribute(inside))

    def _named(self, name: str, unsafe: bool) -> Global:
        if unsafe:
            raise UnsafePickleError(name[:_NAME])
        if len(name) > _NAME:
            raise BrokenPickleError(f"it names a global by more than {_NAME} characters")
        return Global(name)

    def _stack_global(self, _: Any) -> Global:
        name, module = self.stack.pop(), self.stack.pop()
        if type(name) is not str or type(module) is not str:
            raise BrokenPickleError("it names a global by something else than text")
        if len(name) + len(module) > _NAME:
            raise BrokenPickleError(f"it names a global by more than {_NAME} characters")
        return self._global(f"{module} {name}")

    def _ext1(self, code: int) -> Global:
        return Global(f"extension {code}")

    _ext2 = _ext4 = _ext1

    def _call(self, function: Any, arguments: Any) -> Any:
        name = function.name if isinstance(function, Global) else "an inert object"
        listed = arguments if type(arguments) in (list, tuple) else ()  # a named tuple is inert
        if name in self.builders:
            self._charge(listed)
            return self.builders[name](*listed)
        if isinstance(function, Global) and not is_way(name):
            return Inert(name)
        self.copied += len(listed)  # each is looked at
        if self.copied > self.done:
            raise BrokenPickleError("it gives the same arguments many times, which no state dict does")
        if isinstance(function, Global):
            return self._follow(name, listed)
        _check_inert_call(function, listed)
        return Inert(name)

    def _charge(self, arguments: Sequence[Any]) -> None:
        """Refuse what makes more of its lists than it has opcodes: one memoised list, given to many calls."""
        if len(arguments) > _ARGUMENTS:
            raise BrokenPickleError(f"it calls something with more than {_ARGUMENTS} arguments")
        self.copied += sum(len(argument) for argument in arguments if type(argument) is list)
        if self.copied > self.done:
            raise BrokenPickleError("it copies one list many times, which no state dict does")

    def _follow(self, name: str, arguments: Sequence[Any]) -> Any:
        """The result of `getattr` or `attrgetter`, refused if an attribute is dangerous or computed."""
        attributes = attributes_of(name, arguments)
        if not attributes or len(arguments) > _ARGUMENTS:
            raise UnsafePickleError(f"{name} of a name that it hides")
        for attribute in attributes:
            if type(attribute) is not str:
                raise UnsafePickleError(f"{name} of a name that it computes")
            if len(attribute) > _NAME or is_unsafe_attribute(attribute):
                owner = arguments[0].name + "." if is_getattr(name) and isinstance(arguments[0], Global | Inert) else ""
                raise UnsafePickleError(f"{owner}{attribute[:_NAME]}")
        if is_getattr(name) and isinstance(arguments[0], Global):
            reached = f"{arguments[0].name}.{arguments[1]}"  # a nested class, most likely
            return self._named(reached, is_unsafe(reached))
        return Inert(name)

    def _reduce(self, _: Any) -> Any:
        arguments, function = self.stack.pop(), self.stack.pop()
        return self._call(function, arguments)

    _newobj = _reduce

    def _newobj_ex(self, _: Any) -> Any:
        self._pop_held()  # keyword arguments
        return self._reduce(None)

    def _obj(self, _: Any) -> Any:
        (function, *arguments), self.stack = self.stack, self.marked.pop()
        return self._call(function, _held(arguments))

    def _inst(self, argument: str) -> Any:
        return self._call(self._global(argument), self._pop_marked())

    def _build(self, _: Any) -> None:
        self._pop_held()  # the state of an object that was not made, or attributes of a dict (`_metadata`)

    def _persid(self, argument: str) -> Any:
        return self.persistent(argument)

    def _binpersid(self, _: Any) -> Any:
        return self.persistent(self._pop_held())


def _held(values: list[Any]) -> list[Any]:
    """`values`, which become part of something else: refused if `getattr` is one, since another would call it unseen."""
    for value in values:
        if type(value) is Global and is_way(value.name):
            raise UnsafePickleError(value.name)
    return values


def _check_inert_call(function: Any, arguments: Sequence[Any]) -> None:
    """Refuse to fetch items with a getter, and to give a dangerous name to what was not made (a `partial` of getattr)."""
    if isinstance(function, Inert) and is_getter(function.name):
        raise UnsafePickleError(f"{function.name}, called")
    if len(arguments) > _ARGUMENTS:
        raise BrokenPickleError(f"it calls something with more than {_ARGUMENTS} arguments")
    for argument in arguments:
        if type(argument) is str and len(argument) <= _NAME and is_unsafe_attribute(argument):
            raise UnsafePickleError(argument)


def string_items(pairs: Any) -> dict[str, Any]:
    """A dict of those `(key, value)` pairs whose key is text of ordinary length; other keys are not even hashed."""
    return {key: value for key, value in pairs if type(key) is str and len(key) <= _KEY}


def _pairs(items: list[Any]) -> list[tuple[Any, Any]]:
    return list(zip(items[::2], items[1::2], strict=True))
