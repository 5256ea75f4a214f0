"""PLY files: the vertex table as named columns of numbers, whatever they mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._files import atomic_path

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
_HEADER_BYTES = 1 << 20  # no honest header is longer


def _parse_header(path: Path, head: bytes) -> tuple[str, int, list[tuple[str, str]], int]:
    """Return (format, vertex count, [(property, numpy code)], byte where the data begin)."""
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError(f"{path}: expected a PLY file ('ply' ... 'end_header'), got something else")
    layout, count, properties, element = "", -1, [], ""
    for line in head[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            layout = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if element == "" and words[1] != "vertex":
                raise ValueError(
                    f"{path}: expected 'vertex' as the first element, got {words[1]!r}; re-export the file"
                )
            element = words[1]
            if element == "vertex":
                if not words[2].isdigit():
                    raise ValueError(f"{path}: expected a vertex count, got {words[2]!r}")
                count = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError(f"{path}: expected scalar vertex properties, got {line!r}")
            properties.append((words[2], _TYPES[words[1]]))
    if layout not in ("binary_little_endian", "binary_big_endian", "ascii"):
        raise ValueError(f"{path}: expected a binary or ascii PLY, got format {layout!r}")
    if count < 0 or not properties or len({name for name, _ in properties}) != len(properties):
        raise ValueError(
            f"{path}: expected one 'vertex' element with properties of different names, got {len(properties)}"
        )
    return layout, count, properties, newline + 1


def _parse_rows(path: Path, file: BinaryIO, count: int) -> NDArray[np.float64]:  # [count, properties]
    try:
        return np.loadtxt(file, dtype=np.float64, max_rows=count, ndmin=2)
    except ValueError as error:
        raise ValueError(
            f"{path}: expected {count} rows of numbers, but they cannot be parsed ({error}); write the file again"
        ) from error


def other_elements(path: str | Path) -> list[str]:
    """Names of the elements after the vertices that hold something, such as the faces of a mesh; `read_ply` skips them.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file that begins with vertices.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a PLY file there")
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    _parse_header(path, head)
    lines = head[: head.find(b"end_header")].decode("ascii", "replace").splitlines()
    elements = [words for line in lines if (words := line.split())[:1] == ["element"] and len(words) == 3]
    return [name for _, name, count in elements[1:] if count.strip("0") != ""]


def read_ply(path: str | Path) -> Columns:
    """Read the vertex table of a PLY file as columns of N values each.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a PLY file with scalar vertex properties, or is shorter than its header says.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a PLY file there")
    size = path.stat().st_size
    with path.open("rb") as file:
        layout, count, properties, start = _parse_header(path, file.read(_HEADER_BYTES))
        if layout == "ascii":
            if count * (2 * len(properties)) > size - start + 1:  # a digit and a separator each, at the very least
                raise ValueError(
                    f"{path}: the header promises {count} vertices, but the file is too short; it is truncated"
                )
            file.seek(start)
            table = _parse_rows(path, file, count) if count else np.zeros((0, len(properties)))
            if table.shape != (count, len(properties)):
                raise ValueError(f"{path}: expected {count} rows of {len(properties)} numbers, got {table.shape}")
            return {name: table[:, i].astype(code) for i, (name, code) in enumerate(properties)}
        order = "<" if layout == "binary_little_endian" else ">"
        dtype = np.dtype([(name, order + code) for name, code in properties])
        if count * dtype.itemsize > size - start:
            raise ValueError(
                f"{path}: the header promises {count} vertices of {dtype.itemsize} bytes, but only {size - start} bytes "
                "follow; the file is truncated"
            )
        file.seek(start)
        rows = np.fromfile(file, dtype=dtype, count=count)
    return {name: np.ascontiguousarray(rows[name].astype(code)) for name, code in properties}


def write_ply(path: str | Path, columns: Columns, *, comments: tuple[str, ...] = ()) -> None:
    """Write columns of equal length as the vertex table of a binary little-endian PLY file, atomically."""
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"columns: expected columns of one length, got {lengths}")
    codes = {name: values.dtype.str[1:] for name, values in columns.items()}
    unknown = {name: code for name, code in codes.items() if code not in _NAMES}
    if unknown:
        raise ValueError(f"columns: expected types {sorted(_NAMES)}, got {unknown}; convert them with astype")
    rows = np.empty(next(iter(lengths.values())), dtype=[(name, "<" + code) for name, code in codes.items()])
    for name, values in columns.items():
        rows[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {c}" for c in comments),
        f"element vertex {len(rows)}",
    ]
    header += [f"property {_NAMES[code]} {name}" for name, code in codes.items()] + ["end_header\n"]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        rows.tofile(file)


def stack_columns(columns: Columns, names: list[str]) -> Tensor:  # [N, len(names)] float32
    """Some columns side by side."""
    return torch.from_numpy(np.stack([columns[name] for name in names], -1).astype(np.float32))


def points_from_columns(columns: Columns) -> Tensor:  # [N, 3]
    """The x, y, z columns as one tensor; a ValueError says which is missing."""
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise ValueError(f"columns: expected x, y and z, {', '.join(missing)} missing; got {sorted(columns)[:12]}")
    return stack_columns(columns, ["x", "y", "z"])
