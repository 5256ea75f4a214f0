"""PLY files: tables with named columns of numbers.

**Why not plyfile**, which reads meshes (`evaluation.replica`): it decodes headers as ASCII, but names of columns and comments are
UTF-8 or Latin-1 in practice.
"""

from __future__ import annotations

import os
import re
from codecs import BOM_UTF8
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import reading
from .._files import as_path, atomic_path

Column = NDArray[Any]  # [N]
Columns = dict[str, Column]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {code: name for name, code in _TYPES.items() if not name[-1].isdigit()}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
NAN = re.compile(r"[+-]?(nan\(\w*\)|1\.#\w+)", re.IGNORECASE)  # as texts of Windows have NaN and infinity
_HEADER_BYTES = 1 << 20  # no real header is longer


class _Property(NamedTuple):
    name: str
    code: str  # of NumPy; "" for an unknown type
    length: str  # NumPy's code of a list's length; "" for a single number


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


class Header(NamedTuple):
    """What a PLY file declares."""

    order: str  # of bytes, "<" or ">"; "" for text
    elements: list[_Element]
    comments: list[str]  # programs write their name and options there


def read_ply(path: str | Path) -> Columns:
    """Read the vertex table of a PLY file as columns of N values each.

    A FileError if it is not a PLY file with scalar vertex properties, or is shorter than its header says.
    """
    with _opened(path) as (file, header):
        if not header.elements or header.elements[0].name != "vertex":
            raise ValueError(f"its first element is not 'vertex', it has {[e.name for e in header.elements]}")
        return _read_rows(file, header.elements[0], header.order)


def read_ply_elements(path: str | Path) -> dict[str, Columns]:
    """Read every table of a PLY file, by the element's name; as `read_ply`, and lists (faces of a mesh) are refused."""
    with _opened(path) as (file, header):
        return {element.name: _read_rows(file, element, header.order) for element in header.elements}


def read_header(path: str | Path) -> Header:
    """The header of a PLY file alone."""
    with _opened(path) as (_, header):
        return header


def write_ply(path: str | Path, columns: Columns, *, comments: tuple[str, ...] = ()) -> None:
    """Write columns of one length, with types that PLY has, as the vertex table of a little-endian file, atomically."""
    write_ply_elements(path, {"vertex": columns}, comments=comments)


def write_ply_elements(path: str | Path, elements: dict[str, Columns], *, comments: tuple[str, ...] = ()) -> None:
    """Write tables as the elements of a binary little-endian PLY file, in their order; see `write_ply`."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    tables = []
    for element, columns in elements.items():
        lengths = {name: len(values) for name, values in columns.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"columns: expected columns of one length, got {lengths}")
        codes = {name: values.dtype.str[1:] for name, values in columns.items()}
        odd = {name: code for name, code in codes.items() if name.split() != [name] or code not in _NAMES}
        if odd:
            expected = f"names without blanks and the types {sorted(_NAMES)}"
            raise ValueError(f"columns: expected {expected}, got {odd!r:.80}; rename or convert them")
        tables.append(np.rec.fromarrays([*columns.values()], [(n, "<" + code) for n, code in codes.items()]))
        header.append(f"element {element} {len(tables[-1])}")
        header += [f"property {_NAMES[code]} {name}" for name, code in codes.items()]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        for rows in tables:
            rows.tofile(file)


def to_number(word: str) -> float:
    """A number of a text file; NaN for what Windows writes for NaN and infinity: `-nan(ind)`, `1.#QNAN`."""
    return float(NAN.sub("nan", word))


def stack_columns(columns: Columns, names: list[str]) -> Tensor:  # [N, len(names)] float32
    """Some columns side by side."""
    with np.errstate(over="ignore"):  # of doubles; `read_splats` leaves them out
        return torch.from_numpy(np.stack([columns[name] for name in names], -1).astype(np.float32))


def points_from_columns(path: str | Path, columns: Columns) -> Tensor:  # [N, 3] float64
    """The x, y, z columns of a file; a ValueError says which is missing."""
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        got = ", ".join(sorted(columns)[:12])
        raise ValueError(f"{path}: expected points with x, y and z, {', '.join(missing)} missing; got {got}")
    return torch.from_numpy(np.stack([columns[name] for name in "xyz"], -1).astype(np.float64))


@contextmanager
def _opened(path: str | Path) -> Iterator[tuple[BinaryIO, Header]]:
    """A file that stands behind its header; whatever fails names it."""
    with reading(path, "a PLY file", "write it again"), as_path(path).open("rb") as file:
        yield file, _read_header(file)


def _read_header(file: BinaryIO) -> Header:
    head = file.read(_HEADER_BYTES)
    end = head.find(b"\nend_header") + 1
    newline = head.find(b"\n", end)
    if not head.removeprefix(BOM_UTF8).startswith(b"ply") or end < 1 or newline < 0:
        raise ValueError("it has no header from 'ply' to 'end_header'")
    file.seek(newline + 1)
    try:
        text = head[:end].decode("utf-8")
    except UnicodeDecodeError:
        text = head[:end].decode("latin-1")  # holds any bytes
    layout, elements, comments = "", list[_Element](), list[str]()
    for line in text.split("\n"):
        match line.split():
            case ["format", layout, *_]:
                pass
            case ["comment", *_]:
                comments.append(line[len("comment ") :].strip())
            case ["element", name, rows]:
                if not rows.isdecimal():
                    raise ValueError(f"its header counts {rows!r:.40} rows of {name!r:.40}")
                elements.append(_Element(name, int(rows), []))
            case ["property", "list", count, kind, name] if elements:
                length = _TYPES.get(count, "f")
                code = "" if length[0] == "f" else _TYPES.get(kind, "")
                elements[-1].properties.append(_Property(name, code, length))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(_Property(name, _TYPES.get(kind, ""), ""))
            case ["property", *_] if elements:
                elements[-1].properties.append(_Property(line, "", ""))
    if layout not in _ORDERS:
        raise ValueError(f"its layout is {layout!r:.40}, not binary or ascii")
    return Header(_ORDERS[layout], elements, comments)


def _read_rows(file: BinaryIO, element: _Element, order: str) -> Columns:
    """Read the rows of one element from where `file` stands, if the rest of the file can hold them."""
    names = [prop.name for prop in element.properties]
    odd = [prop.name for prop in element.properties if prop.length or not prop.code]
    if odd or not names or len(set(names)) != len(names):
        raise ValueError(f"expected {element.name!r} with scalars of different names, got {(odd or names)!r:.80}")
    left = os.fstat(file.fileno()).st_size - file.tell()
    dtype = np.dtype([(prop.name, order + prop.code) for prop in element.properties])
    least = dtype.itemsize if order else 2 * len(names)  # a digit and a separator each, at the very least
    if element.rows * least > left + (not order):
        raise ValueError(f"{element.rows} rows of {element.name!r} are promised, {left} bytes follow: it is truncated")
    if order:
        rows = np.fromfile(file, dtype=dtype, count=element.rows)
        return {prop.name: np.ascontiguousarray(rows[prop.name].astype(prop.code)) for prop in element.properties}
    table = np.zeros((0, len(names)))
    if element.rows:
        lines = (NAN.sub("nan", line) if "#" in line or "(" in line else line for line in map(bytes.decode, file))
        table = np.loadtxt(lines, dtype=np.float64, max_rows=element.rows, ndmin=2)
    if table.shape != (element.rows, len(names)):
        raise ValueError(f"expected {element.rows} rows of {len(names)} numbers, got {list(table.shape)}")
    return {prop.name: table[:, i].astype(prop.code) for i, prop in enumerate(element.properties)}
