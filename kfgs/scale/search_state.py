"""Which fields below a folder are new to an index, have changed, or are gone. Files are read only where size or time differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from stat import S_ISREG
from typing import NamedTuple

from .._card import short_repr
from .._files import current_file, digest_file
from .._files.fields import DESCRIPTION, NUMBERS, fields_below
from .._files.paths import noted_path, utf8
from .search_file import Contents, Entry, FileMark, Unread


class Marked(NamedTuple):
    """A field that is there."""

    path: Path
    name: str
    """Its path relative to the folder."""
    marks: tuple[FileMark, ...]
    """Of its own files; of those of its classes too, if the index knows them."""

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


def own_files(field: Path) -> tuple[str, ...]:
    """The names of a field's files in its folder; a packed field is one file, without a name in it."""
    return (DESCRIPTION, NUMBERS) if field.is_dir() else ("",)


def mark_of(field: Path, name: str) -> FileMark:
    """Size and time of a file of a field."""
    try:
        found = _file(field, name).stat()
    except (OSError, ValueError):  # ValueError: no name that a file can have
        return FileMark(name, -1, 0)
    return FileMark(name, found.st_size, found.st_mtime_ns) if S_ISREG(found.st_mode) else FileMark(name, -1, 0)


def digest_of(field: Path, mark: FileMark) -> str:
    """SHA-256 of a file of a field; an empty text if none is there."""
    return digest_file(_file(field, mark.name)) if mark.size >= 0 else ""


def _file(field: Path, name: str) -> Path:
    """One of `own_files`, or a file of the classes, as the field notes it."""
    return current_file(field, name) if name in (DESCRIPTION, NUMBERS) else noted_path(field, name)


def marked_fields(folder: Path, contents: Contents) -> Iterator[tuple[str, Marked]]:
    """The fields below a folder, with their paths relative to it; bytes that are no UTF-8 are written as backslashes."""
    for path in fields_below(folder):
        name, own = path.relative_to(folder).as_posix(), own_files(path)
        known = contents.entries.get(name)
        others: Iterable[str] = () if known is None else (mark.name for mark in known.marks if mark.name not in own)
        marks = tuple(mark_of(path, one) for one in (*own, *others))
        if marks[0].size >= 0:  # else deleted since it was listed
            yield utf8(name), Marked(path, name, marks)


def is_current(folder: Path, contents: Contents) -> bool:
    """Whether all fields have the sizes and times of the index, none is new and none is gone. No field is read."""
    known = {name: one.marks for name, one in contents.entries.items()}
    known |= {name: one.marks for name, one in contents.unread.items()}
    return known == {name: found.marks for name, found in marked_fields(folder, contents)}


def compare_fields(folder: Path, contents: Contents) -> State:
    """Compare an index with the fields that are there."""
    same: dict[str, Entry] = {}
    changed: dict[str, Marked] = {}
    unread: dict[str, Unread] = {}
    for name, found in marked_fields(folder, contents):
        known, failed = contents.entries.get(name), contents.unread.get(name)
        if known is not None and _is_same(known, found):
            same[name] = replace(known, marks=found.marks)
        elif failed is not None and failed.marks == found.marks:
            unread[name] = failed
        else:
            changed[name] = found
    before = {**contents.entries, **contents.unread}
    gone = tuple(name for name in before if name not in same and name not in changed and name not in unread)
    return State(same, changed, gone, unread)


def _is_same(known: Entry, found: Marked) -> bool:
    """Whether the files have the content of before. Only those with another size or time are read; another size is enough."""
    sizes = [[(mark.name, mark.size) for mark in marks] for marks in (known.marks, found.marks)]
    return sizes[0] == sizes[1] and all(
        before == now or digest_of(found.path, now) == digest
        for before, now, digest in zip(known.marks, found.marks, known.digests, strict=True)
    )
