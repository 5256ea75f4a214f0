"""The output of commands: lines, files written, and warnings as notes."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from .._notes import Wait, hear

LINE, END = 2000, 600
"""Most characters of a printed line, and how many of them are from its end, where an error says what to do."""


def say(text: str, file: TextIO | None = None) -> None:
    r"""Print a line at once, to standard output or a file.

    Names from foreign files may hold anything: what is not printable is shown as Python writes it (`\x1b`), and the middle
    of a very long line is left out.
    """
    try:
        print("\n".join(map(_shown, text.split("\n"))), file=file or sys.stdout, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from error


def _shown(line: str) -> str:
    left = len(line) - LINE
    if left > 0:
        line = f"{line[: LINE - END]} ... ({left} characters left out) ... {line[-END:]}"
    return "".join(
        character if character.isprintable() or character == "\t" else ascii(character)[1:-1] for character in line
    )


def wrote(paths: Sequence[Path]) -> None:
    """Name the files that a command wrote."""
    say("wrote:")
    for path in paths:
        say(f"  {path}" + (f"  ({sum(1 for p in path.iterdir())} files)" if path.is_dir() else ""))


def say_lost(written: Any) -> None:
    """Report what the format of a splat file (`Written`) could not store, and whether it reordered the Gaussians."""
    for words in written.lost:
        say(f"note: {words}")
    if written.order is not None:
        say("note: neighbours now lie side by side (Morton order), so indices into the old file do not fit the new one")


@contextmanager
def notes_as_lines(spoken: Callable[[str], str], *, strict: bool) -> Iterator[None]:
    """Print warnings, in the words of `spoken`, and notes of readers and engines, as lines.

    With `strict`, readers refuse what they would leave out.
    """

    def note(message: Warning | str, *_: Any, **__: Any) -> None:
        say(f"note: {spoken(str(message))}", sys.stderr if isinstance(message, Wait) else None)

    with warnings.catch_warnings(), hear(note, strict=strict):
        warnings.filterwarnings("always", message="classes: ")
        warnings.showwarning = note
        yield
