"""The index of a search on disk: one .safetensors file, whole or absent. It needs NumPy only. docs/formats.md has the layout."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._card import short_repr
from .._files import atomic_path, parse_json
from .._files.paths import utf8

Array = NDArray[Any]
Rows = Mapping[str, Array]
"""Columns of one length, by name."""

KIND, VERSION = "search index", 1
NAME = "search.kfgs"
"""Of the file, in the folder that was searched."""
VIEWS = 8  # best views kept of an atom: parts are joined from atoms, and their views' shares are added
ABOUT = "description"
WORDS = 256 << 20  # most bytes of the description: names of 100 views take 2 kB a field

COLUMNS: dict[str, dict[str, tuple[str, tuple[int, ...]]]] = {
    "atoms": {
        "word": ("<i4", ()),
        "count": ("<i4", ()),
        "pooled": ("|u1", ()),
        "center": ("<f4", (3,)),
        "low": ("<f4", (3,)),
        "high": ("<f4", (3,)),
        "views": ("<i4", (VIEWS,)),
        "shares": ("<f4", (VIEWS,)),
    },
    "links": {"pair": ("<i4", (2,))},
    "classes": {"count": ("<i4", ()), "score": ("<f4", ())},
    "parts": {
        "label": ("<i4", ()),
        "count": ("<i4", ()),
        "score": ("<f4", ()),
        "center": ("<f4", (3,)),
        "low": ("<f4", (3,)),
        "high": ("<f4", (3,)),
        "view": ("<i4", ()),
        "share": ("<f4", ()),
    },
}
"""Type and further axes of each column, for each kind of row of a field."""


class FileMark(NamedTuple):
    """A file from which a field's answers follow. If size and time are the same, so is its content."""

    name: str
    """Relative to the folder of the field; empty: the field itself, which is one file."""
    size: int
    """Bytes; -1: there is none."""
    time: int
    """Of its last change, in nanoseconds."""

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class Entry:
    """What the index knows of one field. Positions are in its scene's frame and units."""

    path: str
    """Of the field, relative to the index's folder, with slashes."""
    marks: tuple[FileMark, ...]
    """Of the field's files, and of those of the classes that it remembers."""
    digests: tuple[str, ...]
    """SHA-256 of each of these files."""
    gaussians: int
    space: int
    """Index of its teacher's words."""
    table: int | None
    """Index of its classes; None if it has none."""
    views: tuple[str, ...]
    """Names of its training views."""
    outside: float
    """Share of its known Gaussians whose word is farther than the tolerance."""
    rows: dict[str, Rows]
    """By kind: see `COLUMNS`."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """That the rows' positions are counted from."""

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class Space:
    """The words of the fields of one teacher."""

    teacher: dict[str, Any] | None
    tolerance: float
    words: Array  # [K, D] float32, unit rows

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class Table:
    """Classes of fields."""

    space: int
    names: tuple[str, ...]
    negative_names: tuple[str, ...]
    info: dict[str, Any]
    embeddings: Array  # [C, D] float32
    negatives: Array  # [M, D] float32; M may be 0

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True)
class Unread:
    """A field that could not be read. It is tried again when its files change."""

    marks: tuple[FileMark, ...]
    reason: str


@dataclass(frozen=True, eq=False)
class Contents:
    """All of an index."""

    spaces: list[Space] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    entries: dict[str, Entry] = field(default_factory=dict)
    """By path."""
    unread: dict[str, Unread] = field(default_factory=dict)
    """By path."""

    def __repr__(self) -> str:
        return short_repr(self)


def empty_rows(kind: str) -> dict[str, Array]:
    """No rows of a kind."""
    return {name: np.zeros((0, *tail), dtype) for name, (dtype, tail) in COLUMNS[kind].items()}


def write_index(path: Path, contents: Contents) -> None:
    """Write the file, whole or not at all; equal content gives equal bytes."""
    from safetensors.numpy import save_file

    entries = [contents.entries[name] for name in sorted(contents.entries)]
    names = ("path", "marks", "digests", "gaussians", "space", "table", "views", "outside", "origin")
    about = {
        "fields": [{name: getattr(entry, name) for name in names} for entry in entries],
        "spaces": [{"teacher": one.teacher, "tolerance": one.tolerance} for one in contents.spaces],
        "tables": [
            {"space": one.space, "names": one.names, "negative_names": one.negative_names, "info": one.info}
            for one in contents.tables
        ],
        "unread": {name: [one.marks, utf8(one.reason)] for name, one in sorted(contents.unread.items())},
    }
    text = json.dumps(about, allow_nan=False).encode()
    if len(text) > WORDS:
        raise ValueError(f"fields: expected names in at most {WORDS} bytes, got {len(text)}; search in smaller folders")
    tensors: dict[str, Array] = {ABOUT: np.frombuffer(text, np.uint8)}
    tensors |= {f"words.{i}": one.words for i, one in enumerate(contents.spaces)}
    for i, one in enumerate(contents.tables):
        tensors |= {f"classes.{i}": one.embeddings, f"negatives.{i}": one.negatives}
    for kind, columns in COLUMNS.items():
        counts = [len(entry.rows[kind][next(iter(columns))]) for entry in entries]
        tensors[f"{kind}.start"] = np.cumsum([0, *counts], dtype=np.int64)
        for name, (dtype, tail) in columns.items():
            parts = [np.zeros((0, *tail), dtype), *(entry.rows[kind][name] for entry in entries)]
            tensors[f"{kind}.{name}"] = np.ascontiguousarray(np.concatenate(parts), dtype)
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"kfgs": json.dumps({"kind": KIND, "version": VERSION})})


def read_index(path: Path) -> Contents:
    """Read what `write_index` wrote; nothing, if there is no file. Numbers are checked before they are used as places.

    Raises:
        ValueError: if it is something else, damaged, or of another version; the message says what to do.
    """
    from safetensors import SafetensorError, safe_open

    advice = "delete it, and the next search makes it again"
    if not path.exists():
        return Contents()
    if not path.is_file():
        raise ValueError(f"{path}: expected a kfgs {KIND}, or nothing there, got a folder; move it away")
    try:
        with safe_open(str(path), framework="np") as file:
            stated = parse_json((file.metadata() or {})["kfgs"])
            kind, version = stated["kind"], stated["version"]
            if (kind, version) == (KIND, VERSION):
                return _contents({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118 (no mapping)
    except PermissionError:
        raise
    except (SafetensorError, ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else str(error)
        raise ValueError(
            f"{path}: expected a kfgs {KIND}, but it is damaged ({ascii(why)[1:160]}); {advice}"
        ) from error
    got, other = f"version {version!r:.20}", f"use the kfgs that wrote it, or {advice}"
    if kind != KIND:
        got, other = f"{kind!r:.40}", "move it away"
    raise ValueError(f"{path}: expected a kfgs {KIND}, version {VERSION}, got {got}; {other}")


def _contents(tensors: dict[str, Array]) -> Contents:
    """The content of the file's tensors; any error if they do not fit together."""
    if tensors[ABOUT].nbytes > WORDS:
        raise ValueError(f"its description has {tensors[ABOUT].nbytes} bytes")
    about = parse_json(_column(tensors, ABOUT, "|u1", ()).tobytes())
    spaces = [
        Space(one["teacher"], float(one["tolerance"]), _matrix(tensors, f"words.{i}"))
        for i, one in enumerate(about["spaces"])
    ]
    tables = []
    for i, one in enumerate(about["tables"]):
        rows, negatives = _matrix(tensors, f"classes.{i}"), _matrix(tensors, f"negatives.{i}")
        names, others = _texts(one["names"]), _texts(one["negative_names"])
        shape = (len(names), spaces[_index(one["space"], len(spaces))].words.shape[1])
        if rows.shape != shape or negatives.shape != (len(others), shape[1]) or not isinstance(one["info"], dict):
            raise ValueError(f"classes.{i} has shape {rows.shape}, expected {shape}")
        tables.append(Table(one["space"], names, others, one["info"], rows, negatives))
    kinds = {kind: _rows(tensors, kind, len(about["fields"])) for kind in COLUMNS}
    entries = {}
    for i, one in enumerate(about["fields"]):
        table = None if one["table"] is None else _index(one["table"], len(tables))
        space, views = _index(one["space"], len(spaces)), _texts(one["views"])
        own = {kind: kinds[kind][i] for kind in COLUMNS}
        classes = 0 if table is None else len(tables[table].names)
        _check_rows(own, len(spaces[space].words), classes, len(views), int(one["gaussians"]))
        (path,), marks, digests = _texts([one["path"]]), _marks(one["marks"]), _texts(one["digests"])
        if len(digests) != len(marks):
            raise ValueError(f"it holds {len(digests)} digests of {len(marks)} files")
        facts = int(one["gaussians"]), space, table, views, float(one["outside"])
        x, y, z = map(float, one.get("origin", (0, 0, 0)))
        entries[path] = Entry(path, marks, digests, *facts, own, (x, y, z))
    unread = {name: Unread(_marks(marks), str(why)) for name, (marks, why) in about["unread"].items()}
    return Contents(spaces, tables, entries, unread)


def _rows(tensors: dict[str, Array], kind: str, fields: int) -> list[Rows]:
    """The rows of one kind of each field."""
    columns = {name: _column(tensors, f"{kind}.{name}", dtype, tail) for name, (dtype, tail) in COLUMNS[kind].items()}
    start = _column(tensors, f"{kind}.start", "<i8", ())
    lengths = {len(column) for column in columns.values()}
    good = len(start) == fields + 1 and start[0] == 0 and (np.diff(start) >= 0).all() and lengths == {int(start[-1])}
    if not good:
        raise ValueError(f"the rows of {kind} do not fit to {fields} fields")
    places = [slice(int(a), int(b)) for a, b in pairwise(start)]
    return [{name: column[place] for name, column in columns.items()} for place in places]


def _check_rows(rows: Mapping[str, Rows], words: int, classes: int, views: int, gaussians: int) -> None:
    atoms, parts = rows["atoms"], rows["parts"]
    counted = int(atoms["count"].sum(dtype=np.int64))
    if counted > gaussians:  # each is in one atom at most
        raise ValueError(f"its atoms have {counted} of {gaussians} Gaussians")
    bounded = (
        (atoms["word"], 0, words),
        (rows["links"]["pair"], 0, len(atoms["word"])),
        (parts["label"], 0, classes),
        (atoms["views"], -1, views),
        (parts["view"], -1, views),
        (atoms["count"], 1, gaussians + 1),
        (parts["count"], 1, gaussians + 1),
        (rows["classes"]["count"], 0, gaussians + 1),
    )
    for values, low, end in bounded:
        if values.size and not low <= int(values.min()) <= int(values.max()) < end:
            raise ValueError(f"it holds numbers outside [{low}, {end})")
    if len(rows["classes"]["count"]) not in (0, classes):
        raise ValueError(f"it has answers for {len(rows['classes']['count'])} of {classes} classes")


def _column(tensors: dict[str, Array], name: str, dtype: str, tail: tuple[int, ...]) -> Array:
    found = tensors[name]
    if found.dtype != np.dtype(dtype) or found.shape[1:] != tail or found.ndim != 1 + len(tail):
        raise ValueError(f"{name} is {found.dtype} {found.shape}")
    if found.dtype.kind == "f" and not np.isfinite(found).all():
        raise ValueError(f"{name} holds NaN or infinity")
    return found


def _matrix(tensors: dict[str, Array], name: str) -> Array:
    found = tensors[name]
    if found.ndim != 2:
        raise ValueError(f"{name} has shape {found.shape}")
    return _column(tensors, name, "<f4", found.shape[1:])


def _marks(rows: Any) -> tuple[FileMark, ...]:
    names = _texts([name for name, _, _ in rows])
    return tuple(FileMark(name, int(size), int(time)) for name, (_, size, time) in zip(names, rows, strict=True))


def _texts(values: Any) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(one, str) for one in values):
        raise ValueError("it holds no names where names belong")
    return tuple(values)


def _index(value: Any, count: int) -> int:
    if type(value) is not int or not 0 <= value < count:
        raise ValueError(f"it names {value!r:.20} of {count}")
    return value
