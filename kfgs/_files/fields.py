"""Where semantic fields are: the names of their files, and all fields below a folder. Nothing is imported for it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from .atomic import current_file
from .paths import as_path

DESCRIPTION = "field.json"
"""In the folder of a field; it holds the digest of the numbers."""
NUMBERS = "field.safetensors"
"""Beside it."""
SUFFIX = ".kfgs.safetensors"
"""Of a field in one file."""
ASIDE = ("stages", "unfinished")
"""Folders of a run that hold parts of its work."""
NOTES = (".run.lock", "digests.json")
"""Files that a run has in its folder from its first stage on."""


def describes_field(folder: Path) -> bool:
    """Whether a folder is that of a field."""
    return current_file(folder, DESCRIPTION).is_file() or (folder / DESCRIPTION).is_file()  # it was just moved there


def fields_below(folder: str | Path) -> Iterator[Path]:
    """All fields below a folder, folders and packed files, in the order of their names.

    Links to folders are not followed. Hidden folders are left out, and so are the stages in the folder of a run; elsewhere
    a folder may have such a name.

    Raises:
        NotADirectoryError: if there is no such folder.
    """
    folder = as_path(folder)
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: no such folder; expected one with runs or fields in it")
    if describes_field(folder):
        yield folder
        return
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        if entry.is_dir(follow_symlinks=False):
            if not entry.name.startswith(".") and not (entry.name in ASIDE and _is_run(folder)):
                yield from fields_below(entry.path)
        elif entry.name.endswith(SUFFIX) and not entry.name.startswith(".") and entry.is_file():
            yield Path(entry.path)


def _is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return describes_field(folder / "field") or any((folder / name).is_file() for name in NOTES)
