"""PLY files: tables with named columns of numbers, and meshes, whose faces have lists of corners.

**Why not plyfile**: it decodes headers as ASCII (names and comments are UTF-8 or Latin-1 in practice), allocates what a header
promises before it looks at the file, and reads faces with different numbers of corners one by one.
"""

from __future__ import annotations

from codecs import BOM_UTF8
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._card import short_repr
from .._files import as_path, atomic_path

Columns = dict[str, NDArray[Any]]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {code: name for name, code in _TYPES.items() if not name[-1].isdigit()}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_HEADER_BYTES = 1 << 20  # no real header is longer
_CORNERS = ("vertex_indices", "vertex_index")
_STEP = 64  # faces looked at after one of another size: a mesh that mixes sizes is not read over and over


class _Property(NamedTuple):
    name: str
    code: str  # of NumPy
    length: str  # NumPy's code of a list's length; "" for a single number


class _Element(NamedTuple):
    """A table declared in the header."""

    name: str
    rows: int
    properties: list[_Property]
    unknown: list[str]  # header lines of properties of unknown types

    @property
    def row(self) -> str:
        return "vertices" if self.name == "vertex" else f"rows of {self.name!r}"


class _Header(NamedTuple):
    order: str  # of bytes, "<" or ">"; "" for text
    elements: list[_Element]
    comments: list[str]


class Mesh(NamedTuple):
    """The tables of a mesh."""

    vertices: Columns  # N values each
    corners: NDArray[np.int64]  # [C] vertices of all faces, one face after another
    counts: NDArray[np.int64]  # [F] corners of each face
    faces: Columns  # F values each, such as object_id

    def __repr__(self) -> str:
        return short_repr(self)


def read_ply(path: str | Path) -> Columns:
    """Read the vertex table of a PLY file as columns of N values each.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file with scalar vertex properties, or is shorter than its header says.
    """
    with _open(path) as file:
        header = _parse_header(as_path(path), file)
        return _read_element(as_path(path), file, _vertex(as_path(path), header), header.order)


def read_ply_elements(path: str | Path) -> dict[str, Columns]:
    """Read every table of a PLY file, by the element's name and in the file's order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file, an element has lists (the faces of a mesh) or no properties, or the file is
            shorter than its header says.
    """
    with _open(path) as file:
        header = _parse_header(as_path(path), file)
        return {element.name: _read_element(as_path(path), file, element, header.order) for element in header.elements}


def other_elements(path: str | Path) -> list[str]:
    """Names of the non-empty elements after the vertices, for instance the faces of a mesh; `read_ply` skips them."""
    with _open(path) as file:
        header = _parse_header(as_path(path), file)
        _vertex(as_path(path), header)
        return [element.name for element in header.elements[1:] if element.rows]


def read_comments(path: str | Path) -> list[str]:
    """The comments of a PLY file's header, in order; programs write their name and options there."""
    with _open(path) as file:
        return _parse_header(as_path(path), file).comments


def read_mesh(path: str | Path) -> Mesh:
    """Read the vertices and faces of a binary PLY file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a mesh, is shorter than its header says, or a face names a vertex that is not there.
    """
    path = as_path(path)
    with _open(path) as file:
        header = _parse_header(path, file)
        vertex, names = _vertex(path, header), [element.name for element in header.elements]
        if names[1:2] != ["face"] or not header.order:
            raise ValueError(
                f"{path}: expected a binary mesh with a 'face' element after the vertices, got {names!r:.80}"
            )
        vertices = _read_element(path, file, vertex, header.order)
        corners, counts, faces = _read_faces(path, file.read(), header.elements[1], header.order)
    if len(corners) and not 0 <= int(corners.min()) <= int(corners.max()) < vertex.rows:
        raise ValueError(
            f"{path}: expected faces of {vertex.rows} vertices, got one of vertex {int(corners.max())}; it is damaged"
        )
    return Mesh(vertices, corners, counts, faces)


def write_ply(path: str | Path, columns: Columns, *, comments: tuple[str, ...] = ()) -> None:
    """Write columns of equal length as the vertex table of a binary little-endian PLY file, atomically.

    Raises:
        ValueError: if the columns have several lengths, or a type that PLY has no name for.
    """
    write_ply_elements(path, {"vertex": columns}, comments=comments)


def write_ply_elements(path: str | Path, elements: dict[str, Columns], *, comments: tuple[str, ...] = ()) -> None:
    """Write tables as the elements of a binary little-endian PLY file, in their order; see `write_ply`."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    tables = []
    for name, columns in elements.items():
        rows = _pack_rows(columns)
        header.append(f"element {name} {len(rows)}")
        header += [f"property {_NAMES[rows.dtype[column].str[1:]]} {column}" for column in columns]
        tables.append(rows)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        for rows in tables:
            rows.tofile(file)


def stack_columns(columns: Columns, names: list[str]) -> Tensor:  # [N, len(names)] float32
    """Some columns side by side."""
    with np.errstate(over="ignore"):  # of doubles; `read_splats` leaves them out
        return torch.from_numpy(np.stack([columns[name] for name in names], -1).astype(np.float32))


def points_from_columns(columns: Columns) -> Tensor:  # [N, 3] float64
    """The x, y, z columns as one tensor; a ValueError says which is missing."""
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise ValueError(f"columns: expected x, y and z, {', '.join(missing)} missing; got {sorted(columns)[:12]}")
    return torch.from_numpy(np.stack([columns[name] for name in "xyz"], -1).astype(np.float64))


def _open(path: str | Path) -> BinaryIO:
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a PLY file there")
    return path.open("rb")


def _parse_header(path: Path, file: BinaryIO) -> _Header:
    """Read the header, with any elements; leaves `file` at the start of the data."""
    head = file.read(_HEADER_BYTES)
    end = head.find(b"\nend_header") + 1
    newline = head.find(b"\n", end)
    if not head.removeprefix(BOM_UTF8).startswith(b"ply") or end < 1 or newline < 0:
        raise ValueError(f"{path}: expected a PLY file ('ply' ... 'end_header'), got something else")
    file.seek(newline + 1)
    try:
        text = head[:end].decode("utf-8")
    except UnicodeDecodeError:
        text = head[:end].decode("latin-1")  # holds any bytes
    layout, version, elements, comments = "", "", [], []
    for line in text.split("\n"):
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            layout, version = words[1], " ".join(words[2:])
        elif words[:1] == ["comment"]:
            comments.append(line[len("comment ") :].strip())
        elif words[:1] == ["element"] and len(words) == 3:
            if not (words[2].isdigit() and words[2].isascii() and len(words[2]) < 20):
                raise ValueError(f"{path}: expected a {words[1]} count, got {words[2]!r:.40}; write the file again")
            elements.append(_Element(words[1], int(words[2]), [], []))
        elif words[:1] == ["property"] and elements:
            count, *kind = words[2:] if words[1:2] == ["list"] and len(words) == 5 else ["", *words[1:]]
            if len(kind) == 2 and kind[0] in _TYPES and (not count or _TYPES.get(count, "f")[0] != "f"):
                elements[-1].properties.append(_Property(kind[1], _TYPES[kind[0]], _TYPES.get(count, "")))
            else:
                elements[-1].unknown.append(line)
    if layout not in _ORDERS or version not in ("", "1.0"):
        raise ValueError(f"{path}: expected a binary or ascii PLY of version 1.0, got {layout!r:.40} {version!r:.40}")
    names = [element.name for element in elements]
    if len(set(names)) != len(names):
        raise ValueError(f"{path}: expected elements of different names, got {names!r:.80}; write the file again")
    return _Header(_ORDERS[layout], elements, comments)


def _vertex(path: Path, header: _Header) -> _Element:
    """The first element, if it is a vertex table."""
    names = [element.name for element in header.elements]
    if names[:1] != ["vertex"]:
        raise ValueError(f"{path}: expected 'vertex' as the first element, got {names!r:.80}; re-export the file")
    return header.elements[0]


def _read_element(path: Path, file: BinaryIO, element: _Element, order: str) -> Columns:
    """Read the rows of one element from where `file` stands, if the rest of the file can hold them."""
    names = [prop.name for prop in element.properties]
    lists = element.unknown + [f"property list {prop.name}" for prop in element.properties if prop.length]
    if lists or not names or len(set(names)) != len(names):
        raise ValueError(
            f"{path}: expected {element.name!r} with scalar properties of different names, got {(lists or names)!r:.80}"
        )
    left = path.stat().st_size - file.tell()
    dtype = np.dtype([(prop.name, order + prop.code) for prop in element.properties])
    least = dtype.itemsize if order else 2 * len(names)  # a digit and a separator each, at the very least
    if element.rows * least > left + (not order):
        raise ValueError(
            f"{path}: the header promises {element.rows} {element.row} of {least} bytes or more, but only {left} bytes follow; "
            "the file is truncated"
        )
    if order:
        rows = np.fromfile(file, dtype=dtype, count=element.rows)
        return {prop.name: np.ascontiguousarray(rows[prop.name].astype(prop.code)) for prop in element.properties}
    table = np.zeros((0, len(names)))
    try:
        if element.rows:
            table = np.loadtxt(file, dtype=np.float64, max_rows=element.rows, ndmin=2)
        if table.shape != (element.rows, len(names)):
            raise ValueError(f"{table.shape}")
    except ValueError as error:
        raise ValueError(
            f"{path}: expected {element.rows} rows of {len(names)} numbers, but they cannot be parsed ({error}); write the file "
            "again"
        ) from error
    return {prop.name: table[:, i].astype(prop.code) for i, prop in enumerate(element.properties)}


def _read_faces(
    path: Path, data: bytes, face: _Element, order: str
) -> tuple[NDArray[np.int64], NDArray[np.int64], Columns]:
    """Corners, counts and columns. Runs of faces of one size are read at once, in steps that grow while the run goes on."""
    lists = [prop for prop in face.properties if prop.length]
    if len(lists) != 1 or lists[0].name not in _CORNERS or lists[0].code[0] == "f" or face.unknown:
        got = face.unknown + [prop.name for prop in lists]
        raise ValueError(f"{path}: expected faces with one list, {_CORNERS[0]}, got {got!r:.80}")
    scalars = [prop for prop in face.properties if not prop.length]
    columns: dict[str, list[NDArray[Any]]] = {prop.name: [np.zeros(0, prop.code)] for prop in scalars}
    corners, counts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    before = face.properties[: face.properties.index(lists[0])]
    at = sum(np.dtype(prop.code).itemsize for prop in before)  # where a face's count stands
    place, done, step = 0, 0, _STEP
    while done < face.rows:
        start = data[place + at : place + at + np.dtype(lists[0].length).itemsize]
        n = (
            int(np.frombuffer(start, order + lists[0].length)[0])
            if len(start) == np.dtype(lists[0].length).itemsize
            else -1
        )
        fit = 0
        if 0 <= n <= len(data):
            fields: list[Any] = []
            for prop in face.properties:
                count = [("a face's count", order + prop.length)] if prop.length else []
                fields += [*count, (prop.name, order + prop.code, (n,)) if count else (prop.name, order + prop.code)]
            dtype = np.dtype(fields)
            fit = min((len(data) - place) // dtype.itemsize, face.rows - done, step)
        if fit == 0:
            raise ValueError(
                f"{path}: the header promises {face.rows} faces, but only {done} follow; the file is truncated or damaged"
            )
        rows = np.frombuffer(data, dtype, fit, place)
        other = (rows["a face's count"] != n).nonzero()[0]
        rows, step = (rows[: int(other[0])], _STEP) if len(other) else (rows, 2 * step)
        corners.append(rows[lists[0].name].astype(np.int64).reshape(-1))
        counts.append(np.full(len(rows), n, np.int64))
        for prop in scalars:
            columns[prop.name].append(rows[prop.name].astype(prop.code))
        place, done = place + len(rows) * dtype.itemsize, done + len(rows)
    return np.concatenate(corners), np.concatenate(counts), {name: np.concatenate(c) for name, c in columns.items()}


def _pack_rows(columns: Columns) -> NDArray[Any]:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"columns: expected columns of one length, got {lengths}")
    codes = {name: values.dtype.str[1:] for name, values in columns.items()}
    odd = {name: code for name, code in codes.items() if name.split() != [name] or code not in _NAMES}
    if odd:
        raise ValueError(
            f"columns: expected names without blanks and the types {sorted(_NAMES)}, got {odd!r:.80}; rename or convert them"
        )
    rows = np.empty(next(iter(lengths.values())), dtype=[(name, "<" + code) for name, code in codes.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows
