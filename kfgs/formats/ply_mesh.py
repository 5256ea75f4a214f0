"""PLY meshes: vertices, faces of any number of corners, and the numbers that each face carries."""

from __future__ import annotations

from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._arrays import reading
from .._card import short_repr
from .ply import _TYPES, Columns, _check_scalars, _check_vertex, _Element, _existing, _parse_header, _read_element

_CORNERS = ("vertex_indices", "vertex_index")
_STEP = 64  # faces looked at after one of another size: a mesh that mixes sizes is not read over and over


class Mesh(NamedTuple):
    """The tables of a mesh."""

    vertices: Columns  # N values each
    corners: NDArray[np.int64]  # [C] vertices of all faces, one face after another
    counts: NDArray[np.int64]  # [F] corners of each face
    faces: Columns  # F values each, such as object_id

    def __repr__(self) -> str:
        return short_repr(self)


def read_mesh(path: str | Path) -> Mesh:
    """Read the vertices and faces of a PLY file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no mesh, is shorter than its header says, or a face names a vertex that is not there.
    """
    path = _existing(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _parse_header(path, file)
        vertex = _check_vertex(path, header)
        _check_scalars(path, vertex)
        names = [element.name for element in header.elements]
        if names[1:2] != ["face"]:
            raise ValueError(f"{path}: expected a mesh with a 'face' element after the vertices, got {names!r:.80}")
        vertices = _read_element(path, file, vertex, header.layout, size - file.tell())
        corners, counts, faces = _read_faces(path, file, header.elements[1], header.layout, size - file.tell())
    rows = len(next(iter(vertices.values())))
    if len(corners) and not 0 <= int(corners.min()) <= int(corners.max()) < rows:
        raise ValueError(
            f"{path}: expected faces of {rows} vertices, got one of vertex {int(corners.max())}; it is damaged"
        )
    return Mesh(vertices, corners, counts, faces)


def _read_faces(
    path: Path, file: BufferedReader, face: _Element, layout: str, left: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Columns]:
    words = face.lists[0].split() if len(face.lists) == 1 else []
    good = len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES and words[4] in _CORNERS
    if not good or _TYPES[words[2]][0] == "f" or _TYPES[words[3]][0] == "f":
        raise ValueError(f"{path}: expected faces with one list, {_CORNERS[0]}, got {face.lists!r:.80}")
    if layout == "ascii":
        raise ValueError(f"{path}: expected a binary mesh, got an ascii one; save it as binary PLY")
    if face.rows == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), {name: np.zeros(0, code) for name, code in face.properties}
    order = "<" if layout == "binary_little_endian" else ">"
    data = file.read(left)
    # The header keeps lists and scalars apart; which came first is seen where the data begin.
    before, after = _split(path, face)
    return _rows(path, data, face, order, (words[2], words[3]), before, after)


def _split(path: Path, face: _Element) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """The properties before and after the list."""
    with path.open("rb") as file:
        head = file.read(1 << 20).split(b"end_header")[0].decode("latin-1").split("\n")
    with reading(path, "a mesh whose header has 'element face' and its list"):
        start = next(i for i, line in enumerate(head) if line.split()[:2] == ["element", "face"])
        place = next(i for i, line in enumerate(head[start:]) if line.split()[:2] == ["property", "list"])
    count = sum(line.split()[:1] == ["property"] for line in head[start : start + place])
    return face.properties[:count], face.properties[count:]


def _rows(
    path: Path,
    data: bytes,
    face: _Element,
    order: str,
    types: tuple[str, str],
    before: list[tuple[str, str]],
    after: list[tuple[str, str]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], Columns]:
    """Runs of faces with the same number of corners are read at once, in steps that grow while the run goes on."""
    count_code, corner_code = (order + _TYPES[name] for name in types)
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name, _ in face.properties}
    corners, counts, place, done = [], [], 0, 0
    head = sum(np.dtype(code).itemsize for _, code in before)
    count_size, step = np.dtype(count_code).itemsize, _STEP
    while done < face.rows:
        if place + head + count_size > len(data):
            raise ValueError(
                f"{path}: the header promises {face.rows} faces, but only {done} follow; the file is truncated"
            )
        n = int(np.frombuffer(data, count_code, 1, place + head)[0])
        if not 0 <= n <= len(data):
            raise ValueError(f"{path}: expected a face with some corners, face {done} has {n}; the file is damaged")
        fields: list[Any] = [(f"b{i}", order + code) for i, (_, code) in enumerate(before)]
        fields += [("count", count_code), ("corners", corner_code, (n,))]
        fields += [(f"a{i}", order + code) for i, (_, code) in enumerate(after)]
        dtype = np.dtype(fields)
        fit = min((len(data) - place) // dtype.itemsize, face.rows - done, step)
        if fit == 0:
            raise ValueError(
                f"{path}: the header promises {face.rows} faces, but only {done} follow; the file is truncated"
            )
        rows = np.frombuffer(data, dtype, fit, place)
        other = (rows["count"] != n).nonzero()[0]
        rows, step = (rows[: int(other[0])], _STEP) if len(other) else (rows, 2 * step)
        corners.append(rows["corners"].astype(np.int64).reshape(-1))
        counts.append(np.full(len(rows), n, np.int64))
        for letter, some in (("b", before), ("a", after)):
            for i, (name, code) in enumerate(some):
                columns[name].append(rows[f"{letter}{i}"].astype(code))
        place, done = place + len(rows) * dtype.itemsize, done + len(rows)
    return np.concatenate(corners), np.concatenate(counts), {name: np.concatenate(c) for name, c in columns.items()}
