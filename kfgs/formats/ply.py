"""PLY files: tables with named columns of numbers. Most files have one table, of vertices."""

from __future__ import annotations

from codecs import BOM_UTF8
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._files import as_path, atomic_path

Columns = dict[str, NDArray[Any]]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_HEADER_BYTES = 1 << 20  # no real header is longer


class _Element(NamedTuple):
    """A table declared in the header."""

    name: str
    rows: int
    properties: list[tuple[str, str]]  # (name, numpy code)
    lists: list[str]  # header lines of the properties that this module does not read


class _Header(NamedTuple):
    layout: str  # "ascii", "binary_little_endian" or "binary_big_endian"
    elements: list[_Element]
    comments: list[str]
    start: int  # byte where the data begin


def _parse_header(path: Path, file: BinaryIO) -> _Header:
    """Read the header, with any elements; leaves `file` at the start of the data."""
    head = file.read(_HEADER_BYTES)
    end = head.find(b"\nend_header") + 1
    newline = head.find(b"\n", end)
    if not head.removeprefix(BOM_UTF8).startswith(b"ply") or end < 1 or newline < 0:
        raise ValueError(f"{path}: expected a PLY file ('ply' ... 'end_header'), got something else")
    layout, version, elements, comments = "", "", [], []
    for line in _decode(head[:end]).split("\n"):
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
            if len(words) == 3 and words[1] in _TYPES:
                elements[-1].properties.append((words[2], _TYPES[words[1]]))
            else:
                elements[-1].lists.append(line)
    if layout not in ("binary_little_endian", "binary_big_endian", "ascii"):
        raise ValueError(f"{path}: expected a binary or ascii PLY, got format {layout!r:.40}")
    if version not in ("", "1.0"):
        raise ValueError(f"{path}: expected a PLY file of version 1.0, got {version!r:.40}; write it as 1.0")
    names = [element.name for element in elements]
    if len(set(names)) != len(names):
        raise ValueError(f"{path}: expected elements of different names, got {names!r:.80}; write the file again")
    file.seek(newline + 1)
    return _Header(layout, elements, comments, newline + 1)


def _decode(head: bytes) -> str:
    """A header's text: UTF-8, or else Latin-1, which holds any bytes."""
    try:
        return head.decode("utf-8")
    except UnicodeDecodeError:
        return head.decode("latin-1")


def _check_vertex(path: Path, header: _Header) -> _Element:
    """The first element, if it is a vertex table."""
    if not header.elements:
        raise ValueError(f"{path}: expected one 'vertex' element, got none; re-export the file")
    first = header.elements[0]
    if first.name != "vertex":
        raise ValueError(f"{path}: expected 'vertex' as the first element, got {first.name!r}; re-export the file")
    return first


def _check_scalars(path: Path, element: _Element) -> None:
    if element.lists:
        raise ValueError(f"{path}: expected scalar {element.name} properties, got {element.lists[0]!r:.80}")
    names = [name for name, _ in element.properties]
    if not names or len(set(names)) != len(names):
        raise ValueError(
            f"{path}: expected one {element.name!r} element with properties of different names, got {len(names)}"
        )


def _parse_rows(path: Path, file: BinaryIO, element: _Element) -> Columns:
    try:
        table = np.zeros((0, len(element.properties)))
        if element.rows:
            table = np.loadtxt(file, dtype=np.float64, max_rows=element.rows, ndmin=2)
    except ValueError as error:
        raise ValueError(
            f"{path}: expected {element.rows} rows of numbers, but they cannot be parsed ({error}); write the file again"
        ) from error
    if table.shape != (element.rows, len(element.properties)):
        raise ValueError(
            f"{path}: expected {element.rows} rows of {len(element.properties)} numbers, got {table.shape}"
        )
    return {name: table[:, i].astype(code) for i, (name, code) in enumerate(element.properties)}


def _read_element(path: Path, file: BinaryIO, element: _Element, layout: str, left: int) -> Columns:
    """Read the rows of one element from where `file` stands, if the `left` bytes of the file can hold them."""
    if layout == "ascii":
        if element.rows * 2 * len(element.properties) > left + 1:  # a digit and a separator each, at the very least
            raise ValueError(
                f"{path}: the header promises {element.rows} {_plural(element)}, but the file is too short; it is truncated"
            )
        return _parse_rows(path, file, element)
    order = "<" if layout == "binary_little_endian" else ">"
    dtype = np.dtype([(name, order + code) for name, code in element.properties])
    if element.rows * dtype.itemsize > left:
        raise ValueError(
            f"{path}: the header promises {element.rows} {_plural(element)} of {dtype.itemsize} bytes, but only {left} bytes "
            "follow; the file is truncated"
        )
    rows = np.fromfile(file, dtype=dtype, count=element.rows)
    return {name: np.ascontiguousarray(rows[name].astype(code)) for name, code in element.properties}


def _plural(element: _Element) -> str:
    return "vertices" if element.name == "vertex" else f"rows of {element.name!r}"


def _existing(path: str | Path) -> Path:
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a PLY file there")
    return path


def other_elements(path: str | Path) -> list[str]:
    """Names of the non-empty elements after the vertices, for instance the faces of a mesh; `read_ply` skips them.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file that begins with vertices.
    """
    path = _existing(path)
    with path.open("rb") as file:
        header = _parse_header(path, file)
    _check_vertex(path, header)
    return [element.name for element in header.elements[1:] if element.rows]


def read_comments(path: str | Path) -> list[str]:
    """The comments of a PLY file's header, in order; programs write their name and options there.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file.
    """
    path = _existing(path)
    with path.open("rb") as file:
        return _parse_header(path, file).comments


def read_ply(path: str | Path) -> Columns:
    """Read the vertex table of a PLY file as columns of N values each.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file with scalar vertex properties, or is shorter than its header says.
    """
    path = _existing(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _parse_header(path, file)
        vertex = _check_vertex(path, header)
        _check_scalars(path, vertex)
        return _read_element(path, file, vertex, header.layout, size - header.start)


def read_ply_elements(path: str | Path) -> dict[str, Columns]:
    """Read every table of a PLY file, by the element's name and in the file's order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file, an element has lists (the faces of a mesh) or no properties, or the file is
            shorter than its header says.
    """
    path = _existing(path)
    size = path.stat().st_size
    tables: dict[str, Columns] = {}
    with path.open("rb") as file:
        header = _parse_header(path, file)
        for element in header.elements:
            _check_scalars(path, element)
        for element in header.elements:
            tables[element.name] = _read_element(path, file, element, header.layout, size - file.tell())
    return tables


def write_ply(path: str | Path, columns: Columns, *, comments: tuple[str, ...] = ()) -> None:
    """Write columns of equal length as the vertex table of a binary little-endian PLY file, atomically.

    Raises:
        ValueError: if the columns have several lengths, or a type that PLY has no name for.
    """
    write_ply_elements(path, {"vertex": columns}, comments=comments)


def write_ply_elements(path: str | Path, elements: dict[str, Columns], *, comments: tuple[str, ...] = ()) -> None:
    """Write tables as the elements of a binary little-endian PLY file, in their order, atomically.

    Raises:
        ValueError: if the columns of a table have several lengths, or a type that PLY has no name for.
    """
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    tables = []
    for name, columns in elements.items():
        rows = _pack_rows(columns)
        names = rows.dtype.names or ()
        header.append(f"element {name} {len(rows)}")
        header += [f"property {_NAMES[rows.dtype[column].str[1:]]} {column}" for column in names]
        tables.append(rows)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        for rows in tables:
            rows.tofile(file)


def _pack_rows(columns: Columns) -> NDArray[Any]:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"columns: expected columns of one length, got {lengths}")
    codes = {name: values.dtype.str[1:] for name, values in columns.items()}
    split = [name for name in columns if name.split() != [name]]
    if split:
        raise ValueError(f"columns: expected names without blanks, got {split!r:.80}; rename them")
    unknown = {name: code for name, code in codes.items() if code not in _NAMES}
    if unknown:
        raise ValueError(f"columns: expected types {sorted(_NAMES)}, got {unknown}; convert them with astype")
    rows = np.empty(next(iter(lengths.values())), dtype=[(name, "<" + code) for name, code in codes.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


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
