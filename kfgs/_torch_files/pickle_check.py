"""Check a pickle before torch reads it: which classes it names, and whether reading it takes too much time or memory.

`torch.load(weights_only=True)` runs nothing that a file names, but a few bytes can still make it run forever or fill the
memory: nested tuples whose hash visits 2^60 values, a set made of a tensor, one long list copied by 100,000 calls. This is
a dry run: it follows the opcodes and counts, for each object, how many values a walk through it would visit.
"""

from __future__ import annotations

import pickletools
from dataclasses import dataclass, field
from typing import Any, Protocol

from torch._utils import IMPORT_MAPPING, NAME_MAPPING  # Python 2's names, as torch.load translates them

from .._check import one_line


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_OPCODES = _words(  # the opcodes of torch.load(weights_only=True)
    "GLOBAL NEWOBJ REDUCE BUILD APPEND APPENDS SETITEM SETITEMS MARK TUPLE TUPLE1 TUPLE2 TUPLE3 NONE NEWFALSE NEWTRUE "
    "EMPTY_TUPLE EMPTY_LIST EMPTY_DICT EMPTY_SET BININT BININT1 BININT2 BINFLOAT BINUNICODE SHORT_BINSTRING BINPERSID "
    "BINGET LONG_BINGET BINPUT LONG_BINPUT LONG1 PROTO STOP"
)
_TAKEN = dict.fromkeys(_words("APPEND BUILD TUPLE1 BINPERSID"), 1)  # objects that an opcode takes off the stack
_TAKEN |= dict.fromkeys(_words("SETITEM TUPLE2 REDUCE NEWOBJ"), 2) | {"TUPLE3": 3}
STEPS = 600_000  # opcodes: about 20,000 tensors, read in about 2 seconds
_WORK = 1_000_000  # values visited in any case, plus one per opcode; about 100 bytes each
_DEPTH = 1000  # of tuples in tuples: their hash recurses in C
_NAMES = 500  # classes: each call of one looks through all of them
_ARGUMENTS = 64  # of a call; torch's have 7

# Functions that torch calls for plain tensors. Others (sparse, nested, quantised tensors, bytearray) could fill the memory,
# and no state dict of plain tensors needs them.
_REBUILDS = _words(
    "torch._utils._rebuild_tensor torch._utils._rebuild_tensor_v2 torch._utils._rebuild_tensor_v3 "
    "torch._utils._rebuild_parameter torch._utils._rebuild_parameter_with_state torch.nn.parameter.Parameter"
)
_COPIES = _words(
    "collections.OrderedDict collections.Counter builtins.set builtins.complex torch.Size torch.device _codecs.encode"
)
_UNSAFE_MODULES = _words(
    "os posix nt sys subprocess shutil pty socket runpy importlib ctypes code pdb pickle cPickle marshal webbrowser pip commands"
)
_UNSAFE_BUILTINS = _words("eval exec compile open __import__ globals breakpoint input delattr setattr")


class UnsafePickleError(ValueError):
    """A pickle names something that only a malicious pickle would contain; `args[0]` is the name."""


class BrokenPickleError(ValueError):
    """Bytes that are not a pickle, or a pickle that is cut short, or one that torch does not read."""


class OtherProtocolError(BrokenPickleError):
    """A pickle of a protocol that torch does not read without running it."""


class ByteSource(Protocol):
    """`io.BytesIO` or `mmap.mmap`: their `read(n)` never allocates more memory than there are bytes."""

    def read(self, n: int, /) -> bytes:
        """At most `n` bytes."""
        ...

    def readline(self) -> bytes:
        """The bytes up to a line end."""
        ...


@dataclass(slots=True, eq=False)
class _Value:
    """An object that the pickle would make, as far as the dry run knows it."""

    kind: str  # its opcode
    literal: Any = None  # a text or number; of GLOBAL the name, of REDUCE and NEWOBJ the name that was called
    parts: tuple[_Value, ...] = ()  # of a tuple
    weight: int = 1  # values that a walk through it visits
    depth: int = 0  # of tuples in tuples
    endless: bool = False  # a tensor or storage: a walk through it may never end

    @property
    def foreign(self) -> bool:
        """Whether this is the result of a call of something that is not torch's."""
        return self.kind in ("REDUCE", "NEWOBJ") and self.literal not in _REBUILDS | _COPIES


@dataclass
class PickleNames:
    """Names in a pickle (`module.name`, in Python 3's spelling), without the few functions of torch it needs."""

    called: set[str] = field(default_factory=set)
    """Must be replaced by something that ignores arguments, state and further calls."""
    filled: dict[str, type] = field(default_factory=dict)
    """Those of them whose results get items, as a dict or a list does."""


def check_pickle(source: ByteSource, most: int = STEPS) -> PickleNames:
    """Raise unless torch can read the pickle at the position of `source` in time and memory proportional to its length.

    Moves `source` to the first byte after the pickle, which has at most `most` opcodes.

    Raises:
        UnsafePickleError: if it names something that runs commands or code or opens files, called or not.
        BrokenPickleError: if it is damaged, of another protocol, or would take too much time or memory.
    """
    run = _DryRun()
    try:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(source)):  # type: ignore[arg-type]
            if opcode.name not in _OPCODES:
                raise OtherProtocolError(f"it uses {opcode.name} of protocol {opcode.proto}")
            if step >= most:
                raise BrokenPickleError(f"it has more than {most:,} opcodes")
            if opcode.name == "STOP":
                run.stack.pop()
                return run.found
            run.step(opcode.name, argument)
            if run.work > _WORK + step:
                raise BrokenPickleError("it copies or compares the same values too many times")
    except (UnsafePickleError, BrokenPickleError):
        raise
    except Exception as error:  # hostile bytes raise almost anything: IndexError, UnicodeDecodeError, ...
        raise BrokenPickleError(one_line(error, 120) or type(error).__name__) from error
    raise BrokenPickleError("it has no end")


class _DryRun:
    """The stack, the marks and the memo of one pickle."""

    def __init__(self) -> None:
        self.stack: list[_Value] = []
        self.below: list[list[_Value]] = []  # the stacks below each mark
        self.memo: dict[int, _Value] = {}
        self.named: set[str] = set()
        self.found = PickleNames()
        self.work = 0

    def step(self, name: str, argument: Any) -> None:
        """Carry out one opcode."""
        if name == "MARK":
            if len(self.below) >= _DEPTH:
                raise BrokenPickleError(f"it nests more than {_DEPTH} deep")
            self.below.append(self.stack)
            self.stack = []
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[argument] = self.stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[argument])
        elif name in ("TUPLE", "APPENDS", "SETITEMS"):
            parts, self.stack = self.stack, self.below.pop()
            self._combine(name, parts)
        elif name in _TAKEN:
            parts = self.stack[-_TAKEN[name] :]
            if len(parts) < _TAKEN[name]:
                raise BrokenPickleError("its stack is empty")
            del self.stack[-len(parts) :]
            self._combine(name, parts)
        elif name == "GLOBAL":
            self.stack.append(self._global(argument))
        elif name != "PROTO":
            self.stack.append(_Value(name, argument))

    def _combine(self, name: str, parts: list[_Value]) -> None:
        """An opcode that takes objects off the stack."""
        inside = sum(part.weight if part.kind == "TUPLE" else 1 for part in parts)
        if name.startswith("TUPLE"):
            depth = 1 + max((part.depth for part in parts), default=0)
            if depth > _DEPTH:
                raise BrokenPickleError(f"it has tuples in tuples, more than {_DEPTH} deep")
            self.stack.append(_Value("TUPLE", parts=tuple(parts), weight=1 + inside, depth=depth))
        elif name in ("REDUCE", "NEWOBJ"):
            self.stack.append(self._call(name, *parts))
        elif name == "BINPERSID":
            self.stack.append(_Value(name, endless=True))
        elif name == "BUILD":
            if not self.stack[-1].foreign:  # those ignore their state
                self._charge(parts[0], *parts[0].parts)
        else:  # items of a list or dict
            target, to_dict = self.stack[-1], name.startswith("SET")
            target.weight += inside
            if target.foreign:
                self.found.filled[target.literal] = dict if to_dict else list
            if to_dict:
                self._charge(*parts[::2])  # keys are hashed

    def _global(self, argument: str) -> _Value:
        module, _, name = argument.partition(" ")  # as pickletools joins them
        if " " in name:
            raise BrokenPickleError("it names a class with a space")
        module, name = NAME_MAPPING.get((module, name), (IMPORT_MAPPING.get(module, module), name))
        full = f"{module}.{name}"
        self.named.add(full)
        if len(self.named) > _NAMES:
            raise BrokenPickleError(f"it names more than {_NAMES} classes")
        first = module.partition(".")[0].lstrip("_")
        if first in _UNSAFE_MODULES or (module == "builtins" and not _UNSAFE_BUILTINS.isdisjoint(name.split("."))):
            raise UnsafePickleError(full)
        return _Value("GLOBAL", full)

    def _call(self, opcode: str, function: _Value, arguments: _Value) -> _Value:
        if function.kind != "GLOBAL" and not function.foreign:
            raise BrokenPickleError("it calls something that is not a function")
        name, parts = function.literal, arguments.parts
        if arguments.kind not in ("TUPLE", "EMPTY_TUPLE") or len(parts) > _ARGUMENTS:
            raise BrokenPickleError(f"it calls {one_line(name)} with something else than up to {_ARGUMENTS} arguments")
        if name in _REBUILDS:
            self._charge(*parts[1:])  # the first is a storage or a tensor
            return _Value(opcode, name, endless=True)
        if name not in _COPIES:
            self.found.called.add(name)
            return _Value(opcode, name)
        if name == "_codecs.encode" and (len(parts) != 2 or parts[1].literal not in ("latin1", "latin-1")):
            raise BrokenPickleError("it encodes a text as something else than latin1")
        letters = sum(len(part.literal) for part in parts if type(part.literal) is str)
        self.work += letters
        return _Value(opcode, name, weight=1 + letters + self._charge(*parts))

    def _charge(self, *values: _Value) -> int:
        """Count a walk through each of these."""
        if any(value.endless for value in values):
            raise BrokenPickleError("it takes a tensor for a list")
        work = sum(value.weight for value in values)
        self.work += work
        return work
