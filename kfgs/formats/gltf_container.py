"""glTF 2.0 files as a JSON document with buffers: `.glb`, and `.gltf` with buffers inside or in other files.

Every index, offset and length is checked against the file before anything is read.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import unquote, urlsplit

from .._files import atomic_path, parse_json, real_path

MAGIC = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_MOST_JSON = 1 << 24  # bytes of a .glb's JSON: sixty thousand accessors take less
_MOST_TEXT = 1 << 32  # bytes of a .gltf, which may hold buffers as text
_MOST_VALUES = 1 << 20  # values in the JSON, counted by punctuation that buffers as text do not have
_WHOLE = 2**53  # above this, JSON numbers are not exact integers


class Document:
    """The JSON of a glTF file with its buffers; errors name the file and the damaged place."""

    def __init__(self, path: Path, root: dict[str, Any], binary: bytes | None) -> None:
        self.path, self.root = path, root
        self._binary = binary
        self._buffers: dict[int, memoryview] = {}
        self.fetched = 0
        """Bytes read from other files."""

    def wrong(self, where: str, expected: str, got: object) -> ValueError:
        """Make the error for a place in the document."""
        return ValueError(f"{self.path}: {where}: expected {expected}, got {got!r:.80}; the file is damaged")

    def all(self, kind: str) -> list[Any]:
        """A list at the top of the document, for example "nodes"; empty if it is absent."""
        return self.list_of(self.root, kind, kind)

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """One entry of a list at the top of the document."""
        items = self.all(kind)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
            raise self.wrong(kind, f"an index below {len(items)}", index)
        if not isinstance(items[index], dict):
            raise self.wrong(f"{kind}[{index}]", "an object", items[index])
        entry: dict[str, Any] = items[index]
        return entry

    def list_of(self, holder: dict[str, Any], key: str, where: str) -> list[Any]:
        """A list inside an object; absent is empty."""
        value = holder.get(key, [])
        if not isinstance(value, list):
            raise self.wrong(where, "a list", value)
        return value

    def table(self, holder: dict[str, Any], key: str, where: str) -> dict[str, Any]:
        """An object inside an object; absent is empty."""
        value = holder.get(key, {})
        if not isinstance(value, dict):
            raise self.wrong(where, "an object", value)
        return value

    def whole(self, holder: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
        """A whole number of 0 or more inside an object."""
        value = holder.get(key, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < _WHOLE:
            raise self.wrong(f"{where}.{key}", "a whole number of 0 or more", value)
        return value

    def view(self, index: object) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride (0: none given)."""
        view, where = self.item("bufferViews", index), f"bufferViews[{index}]"
        buffer = self._buffer(self.whole(view, "buffer", where))
        start, length = self.whole(view, "byteOffset", where, 0), self.whole(view, "byteLength", where)
        if start + length > len(buffer):
            raise self.wrong(where, f"bytes below {len(buffer)}", f"{start} to {start + length}")
        stride = self.whole(view, "byteStride", where, 0)
        if stride and not 4 <= stride <= 252:
            raise self.wrong(f"{where}.byteStride", "4 to 252 bytes", stride)
        return buffer[start : start + length], stride

    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            buffer, where = self.item("buffers", index), f"buffers[{index}]"
            length = self.whole(buffer, "byteLength", where)
            uri = buffer.get("uri")
            if uri is None and (self._binary is None or index != 0):
                raise self.wrong(where, "a uri, or the binary chunk of a .glb", "neither")
            content = self._binary if uri is None else self._fetch(uri, length, where)
            assert content is not None
            if len(content) < length:
                raise self.wrong(where, f"{length} bytes", f"{len(content)} bytes")
            self._buffers[index] = memoryview(content)[:length]
        return self._buffers[index]

    def _fetch(self, uri: object, length: int, where: str) -> bytes:
        if not isinstance(uri, str):
            raise self.wrong(f"{where}.uri", "a text", uri)
        if uri.startswith("data:"):
            head, comma, text = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise self.wrong(f"{where}.uri", "data:...;base64,...", uri[:40])
            try:
                return base64.b64decode(text, validate=True)
            except ValueError as error:
                raise self.wrong(f"{where}.uri", "base64", str(error)) from error
        file = self._beside(uri, where)
        if not file.is_file():
            raise ValueError(
                f"{self.path}: {where}: expected the file {file.name!r} in the same folder, got none; copy it there"
            )
        with file.open("rb") as handle:
            content = handle.read(min(length, file.stat().st_size))
        self.fetched += len(content)
        return content

    def _beside(self, uri: str, where: str) -> Path:
        """The file that a uri names; after links are followed, it must lie in the document's folder or below."""
        name = unquote(uri)
        odd = urlsplit(uri).scheme or "\0" in name or PureWindowsPath(name).drive or name.startswith(("/", "\\"))
        if odd or ".." in PurePosixPath(name.replace("\\", "/")).parts:
            raise ValueError(
                f"{self.path}: {where}: expected a file in the same folder, got the uri {uri!r:.80}; "
                "kfgs opens nothing elsewhere, pack the scene as .glb"
            )
        folder = real_path(self.path).parent
        file = real_path(folder / name)
        if not file.is_relative_to(folder):
            raise ValueError(
                f"{self.path}: {where}: expected a file in the same folder, got a link to {file}; copy it there"
            )
        return file


def open_document(path: Path) -> Document:
    """Read a `.glb` or `.gltf` file. Raises a ValueError if it is neither, truncated, or of another version than 2."""
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
        if head.startswith(MAGIC):
            text, binary = _read_chunks(path, file.read(), head)
        elif path.stat().st_size > _MOST_TEXT:
            raise ValueError(
                f"{path}: expected at most {_MOST_TEXT} bytes of JSON, got {path.stat().st_size}; use .glb"
            )
        else:
            text, binary = head + file.read(), None
    values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
    if values > _MOST_VALUES:  # each becomes an object of Python's, tens of times larger than its text
        raise ValueError(f"{path}: expected at most {_MOST_VALUES} values in its JSON, got {values}; split the scene")
    try:
        root = parse_json(text)
    except ValueError as error:
        raise ValueError(
            f"{path}: expected glTF, but its JSON cannot be parsed ({error!s:.120}); write it again"
        ) from error
    asset = root.get("asset") if isinstance(root, dict) else None
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str) or version.partition(".")[0] != "2":
        raise ValueError(f"{path}: expected glTF 2.0 (asset.version), got {version!r:.40}; export it again")
    return Document(path, root, binary)


def _read_chunks(path: Path, rest: bytes, head: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a .glb; chunks of other kinds are skipped."""
    _, version, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (MAGIC, 0, 0)
    if version != 2:
        raise ValueError(f"{path}: expected a .glb of version 2, got {version}; export it again")
    if length > _HEAD.size + len(rest):
        raise ValueError(f"{path}: expected {length} bytes, got {_HEAD.size + len(rest)}; the file is truncated")
    chunks: dict[int, bytes] = {}
    place, end = 0, length - _HEAD.size
    while place + _CHUNK.size <= end:
        size, kind = _CHUNK.unpack_from(rest, place)
        place += _CHUNK.size
        if size > end - place:
            raise ValueError(f"{path}: expected a chunk of {size} bytes, got {end - place}; the file is truncated")
        if kind in (_JSON, _BIN) and kind not in chunks:
            chunks[kind] = rest[place : place + size]
        place += size
    if _JSON not in chunks or len(chunks[_JSON]) > _MOST_JSON:
        got = f"{len(chunks[_JSON])} bytes" if _JSON in chunks else "none"
        raise ValueError(f"{path}: expected a JSON chunk of at most {_MOST_JSON} bytes, got {got}; export it again")
    return chunks[_JSON], chunks.get(_BIN)


def write_document(path: Path, root: dict[str, Any], binary: bytes) -> None:
    """Write `.gltf` with its buffer inside, or else `.glb`, atomically; the document's only buffer is filled in.

    Raises:
        ValueError: if a .glb would be larger than its header can say (4 GiB).
    """
    buffer: dict[str, Any] = {"byteLength": len(binary)}
    root = root | {"buffers": [buffer]}
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
