"""Extend the index of a search: describe the fields that are new or have changed, and write it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from .._card import error_line
from .._files import locked
from ..fields import SemanticField
from ..labels import LabelSet
from .search_entry import describe
from .search_file import NAME, Contents, Entry, Space, Table, Unread, read_index, write_index
from .search_found import Changes
from .search_state import Marked, compare_fields, digest_of, mark_of, own_files
from .search_words import find_space, teacher_of
from .shared_codebook import TOLERANCE, SharedCodebook

LOCK = ".search.lock"
EVERY, SHARE = 20.0, 0.05
"""A long update writes after so many seconds, but spends at most this share of its time on it: the file may be large."""


def update_index(
    folder: Path, *, progress: bool = False, report: Callable[[str], None] | None = None
) -> tuple[Contents, Changes]:
    """See `SearchIndex.update`. The file is read again under the lock: another process may have extended it."""
    file, say = folder / NAME, report or (lambda text: None)
    with locked(folder, LOCK):
        contents = read_index(file)
        state = compare_fields(folder, contents)
        moved = any(contents.entries[name].marks != entry.marks for name, entry in state.same.items())
        contents = _with_used_tables(Contents(list(contents.spaces), contents.tables, state.same, dict(state.unread)))
        added, failed, due = list[str](), dict[str, str](), time.monotonic() + EVERY
        for name, found in tqdm(state.changed.items(), desc="index", unit="field", disable=not progress):
            try:
                contents.entries[name] = add_field(contents, name, found, say)
                added.append(name)
            except (OSError, ValueError, TypeError) as error:
                failed[name] = error_line(error)
                contents.unread[name] = Unread(found.marks[: len(own_files(found.path))], failed[name])
                say(f"{found.path} is left out: {failed[name]}")
            start = time.monotonic()
            if start > due:
                write_index(file, contents)
                end = time.monotonic()
                due = end + max(EVERY, (end - start) / SHARE)
        if added or failed or moved or state.removed:
            write_index(file, contents)
    return contents, Changes(tuple(added), state.removed, failed)


def add_field(contents: Contents, name: str, found: Marked, say: Callable[[str], None]) -> Entry:
    """Describe a field in the words of its teacher's space; the space, and the table of its classes, are added if new."""
    if name != found.name:
        raise ValueError("expected a path in UTF-8, as the index keeps it, got other bytes; rename the folder")
    marks = [mark_of(found.path, one) for one in own_files(found.path)]
    digests = [
        digest_of(found.path, mark) for mark in marks
    ]  # before it is read: a later change is found by the next update
    field = SemanticField.load(found.path)
    for one in field.info.get("classes", ()) if field.words is None else ():
        marks.append(mark_of(found.path, str(one["path"])))
        digests.append(digest_of(found.path, marks[-1]))
    try:
        classes = field.label_set() if field.has_classes else None
    except (OSError, ValueError) as error:
        say(f"{found.path}: its classes are left out: {error_line(error)}")
        classes = None
    if classes is not None and classes.dim != field.dim:
        classes = None
    space = _space_of(contents, field)
    one = contents.spaces[space]
    described = describe(field, SharedCodebook(torch.from_numpy(one.words), one.tolerance), classes)
    contents.spaces[space] = Space(one.teacher, one.tolerance, described.book.words.cpu().float().numpy())
    table = None if classes is None else _table_of(contents, space, classes)
    views = tuple(camera.name for camera in field.cameras)
    facts = len(field), space, table, views, described.outside, described.rows, field.gaussians.origin
    return Entry(name, tuple(marks), tuple(digests), *facts)


def _with_used_tables(contents: Contents) -> Contents:
    """Without the tables of fields that are gone or have other classes now: names are looked up in all tables."""
    used = sorted({one.table for one in contents.entries.values() if one.table is not None})
    place = {old: new for new, old in enumerate(used)}
    entries = {
        name: one if one.table is None else replace(one, table=place[one.table])
        for name, one in contents.entries.items()
    }
    return Contents(contents.spaces, [contents.tables[old] for old in used], entries, contents.unread)


def _space_of(contents: Contents, field: SemanticField) -> int:
    """The space of a field's teacher; a new one if no field of that teacher is known."""
    space = find_space(contents, field)
    if space is None:
        contents.spaces.append(Space(teacher_of(field), TOLERANCE, np.zeros((0, field.dim), np.float32)))
        space = len(contents.spaces) - 1
    return space


def _table_of(contents: Contents, space: int, classes: LabelSet) -> int:
    rows = classes.embeddings.detach().cpu().float().numpy().copy()  # no map of the field's file, which may change
    negatives = np.zeros((0, classes.dim), np.float32)
    if classes.negatives is not None:
        negatives = classes.negatives.detach().cpu().float().numpy().copy()
    made = Table(space, classes.names, classes.negative_names, classes.info, rows, negatives)
    for i, one in enumerate(contents.tables):
        texts = (one.space, one.names, one.negative_names) == (space, made.names, made.negative_names)
        if texts and np.array_equal(one.embeddings, rows) and np.array_equal(one.negatives, negatives):
            return i
    contents.tables.append(made)
    return len(contents.tables) - 1
