"""Say that kernels are compiled, before it begins: the first use of the CPU engine on a machine waits for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

COMPILING = "compiling kernels of the CPU engine (seconds each, a minute or two in all; each only once on this machine)"
_listeners: list[Callable[[str], None]] = []
_said: list[str] = []  # the line above, once it was said


@contextmanager
def say_compiling(say: Callable[[str], None]) -> Iterator[None]:
    """Call `say` with one line, once in a process, when a kernel must be compiled before the block ends."""
    _listeners.append(say)
    try:
        yield
    finally:
        _listeners.remove(say)


def tell_compiling() -> None:
    """Called when a kernel is about to be compiled; loading one from disk does not count."""
    if _listeners and not _said:
        _said.append(COMPILING)
        _listeners[-1](COMPILING)
