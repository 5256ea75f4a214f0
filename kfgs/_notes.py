"""What a reader did about content that it could not use as it is: it leaves it out and notes it, or it refuses the file.

Readers call `tell`, and so does the CPU engine before it compiles. The command line listens with `hear`. If nobody listens,
each note is logged once ("kfgs").
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache


class Repair(str):
    """A note about something broken that a reader left out or mended."""


class Wait(str):
    """A note that something takes long; commands print it next to the progress bars."""


@cache  # each different note once
def _log(note: str) -> None:
    logging.getLogger("kfgs").log(logging.INFO if isinstance(note, Wait) else logging.WARNING, note)


_listeners: list[tuple[Callable[[str], None], bool]] = [(_log, False)]  # the last is told; are readers strict?


@contextmanager
def hear(say: Callable[[str], None], *, strict: bool = False) -> Iterator[None]:
    """Call `say` with each different note until the block ends; with `strict` readers refuse what they would leave out."""
    listener = cache(say), strict
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def tell(note: str) -> None:
    """Pass a note to the command that listens; if there is none, log it."""
    _listeners[-1][0](note)


def is_strict() -> bool:
    """Whether readers refuse a file with broken parts (`--strict`)."""
    return any(strict for _, strict in _listeners)


def tell_repairs(where: str, notes: Iterable[str], strict: bool, error: type[ValueError]) -> None:
    """Tell each note that is a `Repair`; with `strict`, or `--strict`, raise an error instead."""
    for note in notes:
        if isinstance(note, Repair):
            if strict or is_strict():
                advice = "correct it, or read it without --strict (strict=False)"
                raise error(f"{where}: expected nothing broken (strict), got: {note}; {advice}")
            tell(note)
