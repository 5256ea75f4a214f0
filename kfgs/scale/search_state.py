"""Which fields below a folder are new to an index, have changed, or are gone. Files are read only where size or time differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from .._card import short_repr
from .._files import current_file, digest_file
from .._files.fields import DESCRIPTION, fields_below
from .search_file import Contents, Entry, Unread


class State(NamedTuple):
    """Fields by their paths relative to the folder."""

    same: dict[str, Entry]
    """With the marks of now."""
    changed: dict[str, Path]
    """New fields, and changed ones."""
    removed: tuple[str, ...]
    unread: dict[str, Unread]
    """Fields that could not be read before, and have not changed since."""

    def __repr__(self) -> str:
        return short_repr(self)


def mark_of(path: Path) -> tuple[Path, tuple[int, int]]:
    """The file that stands for a field's content, with its size in bytes and its time in nanoseconds."""
    file = current_file(path, DESCRIPTION) if path.is_dir() else path
    found = file.stat()
    return file, (found.st_size, found.st_mtime_ns)


def compare_fields(folder: Path, contents: Contents) -> State:
    """Compare an index with the fields that are there."""
    same: dict[str, Entry] = {}
    changed: dict[str, Path] = {}
    unread: dict[str, Unread] = {}
    for path in fields_below(folder):
        name = path.relative_to(folder).as_posix()
        known, failed = contents.entries.get(name), contents.unread.get(name)
        file, mark = mark_of(path)
        if known is not None and (known.mark == mark or known.sha256 == digest_file(file)):
            same[name] = replace(known, mark=mark)
        elif failed is not None and failed.mark == mark:
            unread[name] = failed
        else:
            changed[name] = path
    before = {**contents.entries, **contents.unread}
    gone = tuple(name for name in before if name not in same and name not in changed and name not in unread)
    return State(same, changed, gone, unread)
