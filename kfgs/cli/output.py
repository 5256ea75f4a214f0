"""The output of commands: lines, files written, counts of Gaussians, and warnings as notes."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from .._notes import hear

LINE, END = 2000, 600
"""Most characters of a printed line, and how many of them are from its end, where an error says what to do."""


def say(text: str, file: TextIO | None = None) -> None:
    r"""Print a line at once, to standard output or a file; the place that prints.

    Names from foreign files may hold anything: what is not printable is shown as Python writes it (`\x1b`), and the middle
    of a very long line is left out.

    Raises:
        BrokenPipeError: if the reader of the stream has ended, for instance `head`.
        OSError: if the stream cannot take the line, for instance because the disk is full.
    """
    stream = file or sys.stdout
    with _writing(stream):
        print("\n".join(_shown(line) for line in text.split("\n")), file=stream, flush=True)


@contextmanager
def said_whole() -> Iterator[None]:
    """Write what others printed in the block when it ends, not when the interpreter does; raises as `say` does."""
    try:
        yield
    finally:
        with _writing(sys.stdout):
            sys.stdout.flush()


@contextmanager
def _writing(stream: TextIO) -> Iterator[None]:
    """Name the stream in errors of writing, and send to nowhere what it still has to write."""
    try:
        yield
    except OSError as error:
        with suppress(OSError):  # else the interpreter tries again to write what is left, and complains
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        other = "standard error" if stream is sys.stderr else getattr(stream, "name", "the output")
        name = "standard output" if stream is sys.stdout else other
        raise type(error)(f"{name} cannot be written ({error.strerror}); choose another place for it") from error


def open_streams() -> None:
    """Give closed standard streams (`2>&-`) an end that takes everything.

    Otherwise the next file that is opened gets the number of the stream, and what a library says there is written into it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (it lives as long as the process)


def _shown(line: str) -> str:
    left = len(line) - LINE
    if left > 0:
        line = f"{line[: LINE - END]} ... ({left} characters left out) ... {line[-END:]}"
    return "".join(
        character if character.isprintable() or character == "\t" else ascii(character)[1:-1] for character in line
    )


def wrote(paths: list[Path]) -> None:
    """Name the files that a command wrote."""
    say("wrote:")
    for path in paths:
        say(f"  {path}" + (f"  ({sum(1 for p in path.iterdir())} files)" if path.is_dir() else ""))


def say_counts(labels: Any, names: Sequence[str]) -> None:
    """Print the number of Gaussians of each class, and of those without a class."""
    for i, name in enumerate(names):
        say(f"  {_shown(name):<16s} {int((labels == i).sum()):8d} Gaussians")
    if bool((labels < 0).any()):
        say(f"  {'(none)':<16s} {int((labels < 0).sum()):8d} Gaussians")


def say_lost(written: Any) -> None:
    """Report what the format of a splat file (`Written`) could not store, and whether it reordered the Gaussians."""
    for words in written.lost:
        say(f"note: {words}")
    if written.order is not None:
        say("note: neighbours now lie side by side (Morton order), so indices into the old file do not fit the new one")


@contextmanager
def warnings_as_notes(spoken: Callable[[str], str], *, strict: bool = False) -> Iterator[None]:
    """Print warnings about classes and teachers, in the words of `spoken`, and notes of readers, as notes of one line each.

    With `strict`, readers refuse what they would leave out.
    """
    with warnings.catch_warnings(), hear(lambda words: say(f"note: {words}"), strict=strict):
        warnings.filterwarnings("always", message="classes: ")

        def note(message: Warning | str, *_: Any, **__: Any) -> None:
            say(f"note: {spoken(str(message))}")

        warnings.showwarning = note
        yield


@contextmanager
def said_on_stderr() -> Iterator[None]:
    """Say on stderr when the kernels of the CPU engine are compiled, beside the progress bars."""
    from .._compiling import say_compiling

    def tell(text: str) -> None:
        print(f"note: {text}", file=sys.stderr, flush=True)  # noqa: T201

    with say_compiling(tell):
        yield
