"""glTF 2.0 files: JSON with buffers, their typed arrays (accessors), and the nodes that place the meshes of a scene.

Offsets and lengths are compared with the file before anything is read, by NumPy where it makes the arrays. Whatever else is
wrong with the JSON fails inside `reading`, which names the file.
"""

from __future__ import annotations

import base64
import json
import math
import struct
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from numpy.typing import NDArray
from torch import Tensor

from .._files import atomic_path, parse_json, real_path

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_MOST_VALUES = 1 << 20  # values in the JSON, counted by punctuation that buffers as text do not have
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT, _UNSIGNED_BYTE, _ARRAY_BUFFER = 5126, 5121, 34962


class Document:
    """The JSON of a glTF file with its buffers. Raises a ValueError if it is damaged or of another version than 2."""

    def __init__(self, path: Path) -> None:
        self._folder = real_path(path).parent
        text, self._binary = _read_chunks(path)
        self._buffers: dict[int, memoryview] = {}
        self.fetched = 0  # bytes read from other files
        values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
        if values > _MOST_VALUES:  # each becomes an object of Python's, tens of times larger than its text
            raise ValueError(f"its JSON has {values} values, at most {_MOST_VALUES} are read; split the scene")
        self.root: Any = parse_json(text)
        if self.root["asset"]["version"].split(".")[0] != "2":
            raise ValueError(f"asset.version {self.root['asset']['version']!r:.40}, not 2.0")

    def values(self, index: Any, width: int, count: int | None) -> NDArray[np.float32]:  # [N, width]
        """The values of an accessor of a known width and count (None: any); normalised integers become [-1, 1] or [0, 1]."""
        accessor = self.root["accessors"][index]
        rows, dtype = accessor["count"], np.dtype(_COMPONENTS[accessor["componentType"]])
        if _WIDTHS.get(accessor["type"]) != width or count not in (None, rows) or "sparse" in accessor:
            got = f"{accessor['type']!r:.20} of {rows!r:.20}" + " (sparse)" * ("sparse" in accessor)
            raise ValueError(f"accessors[{index}] is {got}, expected {count or 'some'} of {width} numbers, not sparse")
        view = self.root["bufferViews"][accessor["bufferView"]]
        buffer, start, length = self._buffer(view["buffer"]), view.get("byteOffset", 0), view["byteLength"]
        step = view.get("byteStride", 0) or width * dtype.itemsize
        if not 0 <= start <= start + length <= len(buffer) or step < width * dtype.itemsize:
            place = f"bufferViews[{accessor['bufferView']}]"
            raise ValueError(f"{place} has bytes {start} to {start + length} in steps of {step}")
        content, offset = buffer[start : start + length], accessor.get("byteOffset", 0)
        values: NDArray[Any] = np.ndarray((rows, width), dtype, content, offset, (step, dtype.itemsize))
        if not accessor.get("normalized") or dtype.kind == "f":
            return values.astype(np.float32)
        return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), np.float32(-1))

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            buffer = self.root["buffers"][index]
            length, uri = buffer["byteLength"], buffer.get("uri")
            content = self._binary if uri is None and index == 0 else self._fetch(uri, length)
            if not 0 <= length <= len(content):
                raise ValueError(f"buffers[{index}] has {len(content)} bytes, not {length}")
            self._buffers[index] = memoryview(content)[:length]
        return self._buffers[index]

    def _fetch(self, uri: str, length: int) -> bytes:
        """The bytes of a uri: base64 text, or a file that lies, after links are followed, in the document's folder or below."""
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            if not head.endswith(";base64"):
                raise ValueError(f"a uri begins with {uri[:40]!r}, expected data:...;base64,...")
            return base64.b64decode(text, validate=True)
        name = unquote(uri)
        plain = [unicodedata.normalize(form, name.replace("\\", "/")) for form in ("NFC", "NFD")]  # a Mac's zip has NFD
        file = next(filter(Path.is_file, (real_path(self._folder / way) for way in (name, *plain))), self._folder)
        if urlsplit(uri).scheme or not file.is_relative_to(self._folder) or not file.is_file():
            raise ValueError(f"the uri {uri!r:.60} is not a file in its folder; copy it there, or write .glb")
        with file.open("rb") as handle:
            content = handle.read(min(length, file.stat().st_size))
        self.fetched += len(content)
        return content

    def placed_meshes(self) -> Iterator[tuple[int, Tensor]]:  # mesh, [4, 4] float64
        """Every mesh of the default scene, with the matrix from the mesh's axes to the scene's.

        A document without scenes shows all nodes without a parent.
        """
        nodes, scenes = self.root["nodes"], self.root.get("scenes")
        below = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.root.get("scene", 0)]["nodes"] if scenes else set(range(len(nodes))) - below
        waiting, met = [(root, torch.eye(4, dtype=torch.float64)) for root in reversed(list(roots))], 0
        while waiting:
            index, above = waiting.pop()
            node, met = nodes[index], met + 1
            if met > len(nodes):  # in glTF a node has one parent
                raise ValueError("its nodes are not a tree")
            matrix = above @ _matrix(node)
            if "mesh" in node:
                yield node["mesh"], matrix
            waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> Tensor:  # [4, 4] float64
    """From the axes of a node to those of its parent."""

    def numbers(key: str, default: list[float]) -> Tensor:
        values = torch.tensor(node.get(key, default), dtype=torch.float64)
        if values.shape != (len(default),) or not bool((values.abs() < 1e30).all()):  # NaN is not < 1e30
            raise ValueError(f"a node's {key} is not {len(default)} finite numbers")
        return values

    if "matrix" in node:
        return numbers("matrix", [0.0] * 16).view(4, 4).T
    xyzw = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    if not 0.99 < math.hypot(*xyzw.tolist()) < 1.01:
        raise ValueError(f"a node's rotation is not a unit quaternion x, y, z, w: {xyzw.tolist()}")
    local = torch.eye(4, dtype=torch.float64)
    local[:3, :3] = quaternion_to_rotation_matrix(xyzw.roll(1)) * numbers("scale", [1.0] * 3)
    local[:3, 3] = numbers("translation", [0.0] * 3)
    return local


def _read_chunks(path: Path) -> tuple[bytes, bytes]:
    """JSON and binary chunk of a .glb, whose chunks of other kinds are skipped; or the text of a .gltf."""
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        return data, b""
    _, version, length = _HEAD.unpack_from(data)
    if version != 2 or length > len(data):
        raise ValueError(f"a .glb of version {version} and {length} bytes, expected version 2 and {len(data)}")
    chunks, place = dict[int, bytes](), _HEAD.size
    while place + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack_from(data, place)
        place += _CHUNK.size
        if size > length - place:
            raise ValueError(f"a chunk of {size} bytes, {length - place} follow: it is truncated")
        chunks.setdefault(kind, data[place : place + size])
        place += size
    return chunks[_JSON], chunks.get(_BIN, b"")


class BufferWriter:
    """Collects columns into one buffer, with the views and accessors that describe them."""

    def __init__(self) -> None:
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._binary = bytearray()

    def add(self, values: NDArray[Any], **more: Any) -> int:
        """Add float32 values, or bytes that mean [0, 1], [N] or [N, width]; returns the accessor's index."""
        normalized = values.dtype == np.uint8
        content = np.ascontiguousarray(values if normalized else values.astype("<f4"))
        width = 1 if content.ndim == 1 else content.shape[1]
        assert content.strides[0] % 4 == 0  # glTF aligns every element of a vertex attribute to four bytes
        accessor = {
            "bufferView": len(self._views),
            "componentType": _UNSIGNED_BYTE if normalized else _FLOAT,
            "normalized": normalized,
            "count": len(content),
            "type": next(name for name, n in _WIDTHS.items() if n == width),
        }
        place = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": content.nbytes, "target": _ARRAY_BUFFER}
        self._views.append(place)
        self._accessors.append(accessor | more)
        self._binary += content.tobytes()
        return len(self._accessors) - 1

    def write(self, path: Path, root: dict[str, Any]) -> None:
        """Write `.gltf` with the buffer inside, or else `.glb`, atomically. Raises a ValueError if a .glb exceeds 4 GiB."""
        buffer: dict[str, Any] = {"byteLength": len(self._binary)}
        root = root | {"accessors": self._accessors, "bufferViews": self._views, "buffers": [buffer]}
        if path.name.lower().endswith(".gltf"):
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self._binary).decode("ascii")
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(root, allow_nan=False), encoding="utf-8")
            return
        text = json.dumps(root, allow_nan=False, separators=(",", ":")).encode("utf-8")
        text += b" " * (-len(text) % 4)
        binary = bytes(self._binary) + b"\0" * (-len(self._binary) % 4)
        length = _HEAD.size + 2 * _CHUNK.size + len(text) + len(binary)
        if length >= 1 << 32:
            raise ValueError(f"path: expected a .glb below 4 GiB, got {length} bytes; split the cloud, or write .ply")
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(_HEAD.pack(MAGIC, 2, length))
            for kind, content in ((_JSON, text), (_BIN, binary)):
                file.write(_CHUNK.pack(len(content), kind) + content)
