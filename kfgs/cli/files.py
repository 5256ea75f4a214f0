"""What commands read, write and print: inputs are opened, outputs checked before the work begins, warnings become notes."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import kfgs

from .._files import check_output, real_path
from .._notes import Wait, hear

OUTPUTS = ("out", "target")  # parameters that name what a command writes
SORTED = "neighbours now lie side by side (Morton order), so indices into the old"
LINE, END = 2000, 600
"""Most characters of a printed line, and how many of them are from its end, where an error says what to do."""


def check_outputs(given: Mapping[str, Any], made: str | None = None) -> None:
    """Raise a ValueError if a command would replace what it reads, or write among the parts of a scene.

    `given` are its arguments by parameter; it may write to the part `made`.
    """
    from ..fields.store import find_field
    from ..scenes.load import SCENE_PARTS, is_scene, scene_root

    read = [value for name, value in given.items() if isinstance(value, Path) and name not in OUTPUTS]
    for name, target in ((name, given[name]) for name in OUTPUTS if given.get(name) is not None):
        for file in (find_field(path) or path for path in read):
            if file.is_file() and target.is_file() and target.samefile(file):
                raise ValueError(f"{name}: expected another place than {file}, which is read; give another name")
        place = real_path(target)
        for scene in (path for path in (*read, *place.parents) if is_scene(path)):
            for part in (scene_root(scene) / part for part in SCENE_PARTS if part != made):
                if real_path(part) in (place, *place.parents):
                    apart = f"apart from {part}, a part of a scene"
                    raise ValueError(f"{name}: expected a place {apart}, got {target}; give another")


def check_target(name: str, target: Path) -> None:
    """Raise a ValueError unless `target` can become a splat file."""
    from ..formats.table import find_writer

    find_writer(target, name)
    check_output(name, target, "a file")


def is_field(path: Path) -> bool:
    """Whether a path is a field, or a run folder with one in it."""
    from ..fields.store import find_field

    return find_field(path) is not None


def open_field(name: str, path: Path) -> Any:
    """Load a semantic field, of a run folder its `field.kfgs`. Raises a ValueError if the path is not a field."""
    from ..fields.store import find_field

    field = find_field(path)
    if field is None:
        what = "a file" if path.is_file() else "a folder without one" if path.is_dir() else "no such file"
        got = f"{path}, {what}; make one with `kfgs fit`"
        raise ValueError(f"{name}: expected a field (RUN/field.kfgs, or RUN), got {got}")
    return kfgs.SemanticField.load(field)


def open_splats(name: str, path: Path, *, labelled: bool = False, named: bool = False) -> Any:
    """Read a splat file. A ValueError if it has no classes and `labelled` asks for them, or no names and `named` does."""
    from ..formats.sidecar import NAMES, beside

    if is_field(path):
        raise ValueError(f"{name}: expected a splat file, got {path}, a semantic field; pass what `kfgs color` writes")
    splats = kfgs.read_splats(path)
    if (labelled or named) and splats.labels is None:
        advice = f"run `kfgs attach FIELD {path} --out labelled.ply`"
        raise ValueError(f"{name}: expected a splat with classes, got {path} without; {advice}")
    if named and not splats.names:
        raise ValueError(
            f"{name}: expected the names of its classes in {beside(path, NAMES)}, got no such file; copy it from where the "
            "splat was, or run `kfgs attach` again"
        )
    return splats


def say(text: str, file: TextIO | None = None) -> None:
    r"""Print a line at once, to standard output or a file.

    Names from foreign files may hold anything: what is not printable is shown as Python writes it (`\x1b`), and the middle
    of a very long line is left out.
    """
    try:
        print("\n".join(map(_shown, text.split("\n"))), file=file or sys.stdout, flush=True)
    except OSError as error:
        error.filename = None if isinstance(error, BrokenPipeError) else "standard output"
        raise


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


def say_lost(*files: Any) -> None:
    """Report what the formats of splat files (`Written`) could not store, and whether they reordered the Gaussians."""
    for words in dict.fromkeys(words for written in files for words in written.lost):
        say(f"note: {words}")
    if any(written.order is not None for written in files):
        say(f"note: {SORTED} file do not fit the new one")


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
