"""Which fields below a folder are new to an index, have changed, or are gone. Files are read only where size or time differ."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from .._card import short_repr
from .._files import current_file, digest_file
from .._files.fields import DESCRIPTION, fields_below
from .search_file import Contents, Entry, Unread


class Marked(NamedTuple):
    """A field that is there, and the file that stands for its content."""

    path: Path
    file: Path
    mark: tuple[int, int]
    """Size of the file in bytes, and its time in nanoseconds."""

    def __repr__(self) -> str:
        return short_repr(self)


class State(NamedTuple):
    """Fields by their paths relative to the folder."""

    same: dict[str, Entry]
    """With the marks of now."""
    changed: dict[str, Marked]
    """New fields, and changed ones."""
    removed: tuple[str, ...]
    unread: dict[str, Unread]
    """Fields that could not be read before, and have not changed since."""

    def __repr__(self) -> str:
        return short_repr(self)


def marked_fields(folder: Path) -> Iterator[tuple[str, Marked]]:
    """The fields below a folder, with their paths relative to it."""
    for path in fields_below(folder):
        file = current_file(path, DESCRIPTION) if path.is_dir() else path
        try:
            found = file.stat()
        except FileNotFoundError:  # deleted since it was listed
            continue
        yield path.relative_to(folder).as_posix(), Marked(path, file, (found.st_size, found.st_mtime_ns))


def is_current(folder: Path, contents: Contents) -> bool:
    """Whether all fields have the sizes and times of the index, none is new and none is gone. No field is read."""
    known = {name: one.mark for name, one in contents.entries.items()}
    known |= {name: one.mark for name, one in contents.unread.items()}
    return known == {name: found.mark for name, found in marked_fields(folder)}


def compare_fields(folder: Path, contents: Contents) -> State:
    """Compare an index with the fields that are there."""
    same: dict[str, Entry] = {}
    changed: dict[str, Marked] = {}
    unread: dict[str, Unread] = {}
    for name, found in marked_fields(folder):
        known, failed = contents.entries.get(name), contents.unread.get(name)
        if known is not None and (known.mark == found.mark or known.sha256 == digest_file(found.file)):
            same[name] = replace(known, mark=found.mark)
        elif failed is not None and failed.mark == found.mark:
            unread[name] = failed
        else:
            changed[name] = found
    before = {**contents.entries, **contents.unread}
    gone = tuple(name for name in before if name not in same and name not in changed and name not in unread)
    return State(same, changed, gone, unread)
