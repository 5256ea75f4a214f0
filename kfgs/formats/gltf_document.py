"""glTF 2.0 files: JSON with buffers, their typed arrays (accessors), and the nodes that place the meshes of a scene.

Every index, offset and length is compared with the file before anything is read. Whatever else is wrong with the JSON fails
inside `reading`, which names the file.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from .._arrays import FileError
from .._files import atomic_path, parse_json, real_path

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_MOST_JSON = 1 << 24  # bytes of a .glb's JSON: sixty thousand accessors take less
_MOST_TEXT = 1 << 32  # bytes of a .gltf, which may hold buffers as text
_MOST_VALUES = 1 << 20  # values in the JSON, counted by punctuation that buffers as text do not have
_WHOLE = 2**53  # above this, JSON numbers are not exact integers
_DEEPEST = 256  # nodes below nodes
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER = 5126, 5121, 34962


class Document:
    """The JSON of a glTF file with its buffers. Raises a FileError if it is damaged or of another version than 2."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self._binary = _read_chunks(path)
        self._buffers: dict[int, memoryview] = {}
        self.fetched = 0  # bytes read from other files
        values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
        if values > _MOST_VALUES:  # each becomes an object of Python's, tens of times larger than its text
            raise FileError(
                f"{path}: expected at most {_MOST_VALUES} values in its JSON, got {values}; split the scene"
            )
        self.root: Any = parse_json(text)
        version = self.root["asset"]["version"]
        if not isinstance(version, str) or version.partition(".")[0] != "2":
            raise self.wrong("asset.version", "glTF 2.0", version)

    def wrong(self, where: str, expected: str, got: object) -> FileError:
        """Make the error for a place in the document."""
        return FileError(f"{self.path}: {where}: expected {expected}, got {got!r:.80}; the file is damaged")

    def item(self, kind: str, index: object) -> Any:
        """One entry of a list at the top of the document, for example of "nodes"."""
        items = self.root.get(kind, [])
        if type(index) is not int or not 0 <= index < len(items):
            raise self.wrong(kind, f"an index below {len(items)}", index)
        return items[index]

    def whole(self, holder: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
        """A whole number of 0 or more inside an object."""
        value = holder.get(key, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not 0 <= value < _WHOLE:
            raise self.wrong(f"{where}.{key}", "a whole number of 0 or more", value)
        return value

    def values(self, index: object, width: int, count: int | None) -> NDArray[np.float32]:  # [N, width]
        """The values of an accessor; normalised integers become [-1, 1] or [0, 1].

        Args:
            index: which accessor.
            width: expected numbers per element; 0: any.
            count: expected number of elements; None: any.

        Raises:
            FileError: if it is damaged, sparse, or not of that width and count.
        """
        accessor, where = self.item("accessors", index), f"accessors[{index}]"
        have = _WIDTHS.get(str(accessor.get("type")), 0)
        if have == 0 or width not in (0, have):
            raise self.wrong(f"{where}.type", f"a type of {width or 'few'} numbers", accessor.get("type"))
        code = _COMPONENTS.get(self.whole(accessor, "componentType", where))
        rows = self.whole(accessor, "count", where)
        if code is None or count not in (None, rows) or "sparse" in accessor:
            expected = (
                f"{rows if count is None else count} elements of {' or '.join(map(str, _COMPONENTS))}, not sparse"
            )
            raise self.wrong(where, expected, {key: accessor[key] for key in sorted(accessor) if key != "bufferView"})
        dtype = np.dtype(code)
        content, stride = self._view(accessor["bufferView"])
        start, size = self.whole(accessor, "byteOffset", where, 0), have * dtype.itemsize
        step = stride or size
        needed = start + (rows - 1) * step + size if rows else start
        if step < size or needed > len(content):
            raise self.wrong(where, f"{rows} elements in {len(content)} bytes", f"{needed} bytes, {step} apart")
        values = (
            np.ndarray((rows, have), dtype, content, start, (step, dtype.itemsize)) if rows else np.zeros((0, have))
        )
        if not accessor.get("normalized") or dtype.kind == "f":
            return values.astype(np.float32)
        return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), np.float32(-1))

    def _view(self, index: object) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride (0: none given)."""
        view, where = self.item("bufferViews", index), f"bufferViews[{index}]"
        buffer = self._buffer(self.whole(view, "buffer", where))
        start, length = self.whole(view, "byteOffset", where, 0), self.whole(view, "byteLength", where)
        stride = self.whole(view, "byteStride", where, 0)
        if start + length > len(buffer) or (stride and not 4 <= stride <= 252):
            raise self.wrong(where, f"bytes below {len(buffer)}, 4 to 252 apart", [start, start + length, stride])
        return buffer[start : start + length], stride

    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            buffer, where = self.item("buffers", index), f"buffers[{index}]"
            length, uri = self.whole(buffer, "byteLength", where), buffer.get("uri")
            if uri is None and (self._binary is None or index != 0):
                raise self.wrong(where, "a uri, or the binary chunk of a .glb", "neither")
            content = self._binary if uri is None else self._fetch(uri, length, where)
            assert content is not None
            if len(content) < length:
                raise self.wrong(where, f"{length} bytes", f"{len(content)} bytes")
            self._buffers[index] = memoryview(content)[:length]
        return self._buffers[index]

    def _fetch(self, uri: str, length: int, where: str) -> bytes:
        """The bytes of a uri: base64 text, or a file that lies, after links are followed, in the document's folder or below."""
        if uri.startswith("data:"):
            head, comma, text = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise self.wrong(f"{where}.uri", "data:...;base64,...", uri[:40])
            return base64.b64decode(text, validate=True)
        name, folder = unquote(uri), real_path(self.path).parent
        odd = urlsplit(uri).scheme or "\0" in name or PureWindowsPath(name).drive or name.startswith(("/", "\\"))
        odd = odd or ".." in PurePosixPath(name.replace("\\", "/")).parts
        if odd or not (file := real_path(folder / name)).is_relative_to(folder):
            raise FileError(
                f"{self.path}: {where}: expected a file in the same folder, got the uri {uri!r:.80}, or a link elsewhere; kfgs "
                "opens nothing elsewhere, pack the scene as .glb"
            )
        if not file.is_file():
            raise FileError(
                f"{self.path}: {where}: expected the file {file.name!r} in the same folder, got none; copy it there"
            )
        with file.open("rb") as handle:
            content = handle.read(min(length, file.stat().st_size))
        self.fetched += len(content)
        return content

    def placed_meshes(self) -> Iterator[tuple[str, int, Tensor]]:  # name of the node, mesh, [4, 4] float64
        """Every mesh of the default scene, with the matrix from the mesh's axes to the scene's.

        A document without scenes shows all nodes without a parent; one without nodes shows all meshes unmoved.
        """
        nodes, unmoved = self.root.get("nodes", []), torch.eye(4, dtype=torch.float64)
        if not nodes:
            yield from (("", mesh, unmoved) for mesh in range(len(self.root.get("meshes", []))))
            return
        if self.root.get("scenes"):
            roots = self.item("scenes", self.root.get("scene", 0)).get("nodes", [])
        else:
            below = {child for node in nodes for child in node.get("children", [])}
            roots = [i for i in range(len(nodes)) if i not in below]
        waiting, seen = [(root, unmoved, 0) for root in reversed(roots)], set()
        while waiting:
            index, above, depth = waiting.pop()
            node, where = self.item("nodes", index), f"nodes[{index}]"
            if index in seen or depth > _DEEPEST:  # in glTF a node has one parent
                raise self.wrong(where, "a tree of nodes", "a node that is met twice")
            seen.add(index)
            matrix = above @ self._local(node, where)
            if "mesh" in node:
                yield where, self.whole(node, "mesh", where), matrix
            waiting += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]

    def _local(self, node: dict[str, Any], where: str) -> Tensor:  # [4, 4] float64
        def numbers(key: str, default: list[float]) -> Tensor:
            values = torch.tensor(node.get(key, default), dtype=torch.float64)
            if values.shape != (len(default),) or not bool((values.abs() < 1e30).all()):  # NaN is not < 1e30
                raise self.wrong(f"{where}.{key}", f"{len(default)} finite numbers", node[key])
            return values

        if "matrix" in node:
            return numbers("matrix", [0.0] * 16).view(4, 4).T
        xyzw = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
        if not 0.99 < math.hypot(*xyzw.tolist()) < 1.01:
            raise self.wrong(f"{where}.rotation", "a unit quaternion x, y, z, w", xyzw.tolist())
        local = torch.eye(4, dtype=torch.float64)
        local[:3, :3] = torch.from_numpy(Rotation.from_quat(xyzw.tolist()).as_matrix()) * numbers("scale", [1.0] * 3)
        local[:3, 3] = numbers("translation", [0.0] * 3)
        return local


def _read_chunks(path: Path) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a .glb, whose chunks of other kinds are skipped; or the text of a .gltf."""
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
        if not head.startswith(MAGIC):
            if path.stat().st_size > _MOST_TEXT:
                raise FileError(f"{path}: expected at most {_MOST_TEXT} bytes of JSON; use .glb")
            return head + file.read(), None
        rest = file.read()
    _, version, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (MAGIC, 0, 0)
    if version != 2:
        raise FileError(f"{path}: expected a .glb of version 2, got {version}; export it again")
    if length > _HEAD.size + len(rest):
        raise FileError(f"{path}: expected {length} bytes, got {_HEAD.size + len(rest)}; the file is truncated")
    chunks: dict[int, bytes] = {}
    place, end = 0, length - _HEAD.size
    while place + _CHUNK.size <= end:
        size, kind = _CHUNK.unpack_from(rest, place)
        place += _CHUNK.size
        if size > end - place:
            raise FileError(f"{path}: expected a chunk of {size} bytes, got {end - place}; the file is truncated")
        if kind in (_JSON, _BIN) and kind not in chunks:
            chunks[kind] = rest[place : place + size]
        place += size
    if not 0 < len(chunks.get(_JSON, b"")) <= _MOST_JSON:
        raise FileError(f"{path}: expected a JSON chunk of at most {_MOST_JSON} bytes; export it again")
    return chunks[_JSON], chunks.get(_BIN)


class BufferWriter:
    """Collects columns into one buffer, with the views and accessors that describe them."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self._parts: list[bytes] = []

    def add(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Add float32 values, or bytes that mean [0, 1], [N] or [N, width]; returns the accessor's index.

        `bounds` adds minimum and maximum of each component, which glTF requires for positions.
        """
        normalized = values.dtype == np.uint8
        content = np.ascontiguousarray(values if normalized else values.astype("<f4"))
        width = 1 if content.ndim == 1 else content.shape[1]
        assert content.strides[0] % 4 == 0  # glTF aligns every element of a vertex attribute to four bytes
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": _UNSIGNED_BYTE if normalized else _FLOAT,
            "count": len(content),
            "type": next(name for name, n in _WIDTHS.items() if n == width),
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": content.min(0).tolist(), "max": content.max(0).tolist()}
        start = sum(map(len, self._parts))
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": content.nbytes, "target": _ARRAY_BUFFER})
        self.accessors.append(accessor)
        self._parts.append(content.tobytes())
        return len(self.accessors) - 1

    def write(self, path: Path, root: dict[str, Any]) -> None:
        """Write `.gltf` with the buffer inside, or else `.glb`, atomically. Raises a ValueError if a .glb exceeds 4 GiB."""
        binary = b"".join(self._parts)
        buffer: dict[str, Any] = {"byteLength": len(binary)}
        root = root | {"accessors": self.accessors, "bufferViews": self.views, "buffers": [buffer]}
        if path.name.lower().endswith(".gltf"):
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode("ascii")
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(root, allow_nan=False), encoding="utf-8")
            return
        text = json.dumps(root, allow_nan=False, separators=(",", ":")).encode("utf-8")
        chunks = [(_JSON, text + b" " * (-len(text) % 4)), (_BIN, binary + b"\0" * (-len(binary) % 4))]
        length = _HEAD.size + sum(_CHUNK.size + len(content) for _, content in chunks)
        if length >= 1 << 32:
            raise ValueError(f"path: expected a .glb below 4 GiB, got {length} bytes; split the cloud, or write .ply")
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(_HEAD.pack(MAGIC, 2, length))
            for kind, content in chunks:
                file.write(_CHUNK.pack(len(content), kind))
                file.write(content)
