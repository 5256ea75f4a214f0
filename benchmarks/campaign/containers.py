"""Files that hold parts: taken apart, and put together again with right lengths, offsets and checksums."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import zstandard

Parts = list[tuple[str, bytes]]
MOST = 1 << 22  # bytes of an unpacked part: the corpus is small
ZSTD = b"\x28\xb5\x2f\xfd"
PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Container:
    """The parts of a file by name, and how they become a file again."""

    parts: Parts
    close: Callable[[Parts], bytes]


def open_container(data: bytes) -> Container | None:
    """Take a file apart; None if it is of no known kind, or damaged."""
    for head, kind in KINDS:
        if data.startswith(head):
            try:
                return kind(data)
            except Exception:  # an earlier mutation damaged it
                return None
    if len(data) > 9 and data[8:9] == b"{" and struct.unpack_from("<Q", data)[0] < len(data):
        try:
            return _safetensors(data)
        except Exception:
            return None
    return None


def _zip(data: bytes) -> Container:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        infos = archive.infolist()
        parts = [(info.filename, archive.read(info)) for info in infos if info.file_size < MOST]
    kinds = {info.filename: info.compress_type for info in infos}

    def close(parts: Parts) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            seen: set[str] = set()
            for name, body in parts:
                shown = name if name not in seen else f"{name}.again"
                seen.add(shown)
                archive.writestr(zipfile.ZipInfo(shown), body, kinds[name])
        return out.getvalue()

    return Container(parts, close)


def _gzip(data: bytes) -> Container:
    return Container([("", gzip.decompress(data))], lambda parts: gzip.compress(_joined(parts), 1, mtime=0))


def _zstd(data: bytes) -> Container:
    plain = zstandard.ZstdDecompressor().decompress(data, max_output_size=MOST)
    return Container([("", plain)], lambda parts: zstandard.ZstdCompressor(1).compress(_joined(parts)))


def _png(data: bytes) -> Container:
    parts, at = [], len(PNG)
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        parts.append((data[at + 4 : at + 8].decode("latin-1"), data[at + 8 : at + 8 + length]))
        at += 12 + length

    def close(parts: Parts) -> bytes:
        out = PNG
        for name, body in parts:
            kind = name.encode("latin-1")
            out += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        return out

    return Container(parts, close)


def _npy(data: bytes) -> Container:
    start, code = (10, "<H") if data[6] == 1 else (12, "<I")
    (length,) = struct.unpack_from(code, data, 8)
    parts = [("header", data[start : start + length]), ("values", data[start + length :])]

    def close(parts: Parts) -> bytes:
        named = dict(parts)
        header = named.get("header", b"")
        return data[:8] + struct.pack(code, len(header)) + header + named.get("values", b"")

    return Container(parts, close)


def _ply(data: bytes) -> Container:
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return Container([("header", data[:end]), ("values", data[end:])], _joined)


def _glb(data: bytes) -> Container:
    parts, at = [], 12
    while at < len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        parts.append((kind.decode("latin-1"), data[at + 8 : at + 8 + length]))
        at += 8 + length

    def close(parts: Parts) -> bytes:
        body = b""
        for name, part in parts:
            part += b" " * (-len(part) % 4)
            body += struct.pack("<I4s", len(part), name.encode("latin-1")) + part
        return data[:8] + struct.pack("<I", 12 + len(body)) + body

    return Container(parts, close)


def _safetensors(data: bytes) -> Container:
    """The header, and each tensor; offsets follow the lengths of the tensors, unless the header was mutated."""
    (length,) = struct.unpack_from("<Q", data)
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    parts = [("header", data[8 : 8 + length])]
    for name, about in header.items():
        if name != "__metadata__":
            a, b = about["data_offsets"]
            parts.append((name, body[a:b]))

    def close(parts: Parts) -> bytes:
        text = dict(parts).get("header", b"{}")
        tensors = [(name, part) for name, part in parts if name != "header"]
        if text == data[8 : 8 + length]:
            stated, at = json.loads(text), 0
            for name, part in tensors:
                old = stated[name]["data_offsets"]
                if stated[name]["dtype"] == "U8" and old[1] - old[0] != len(part):
                    stated[name]["shape"] = [len(part)]
                stated[name]["data_offsets"] = [at, at + len(part)]
                at += len(part)
            text = json.dumps(stated).encode()
        return struct.pack("<Q", len(text)) + text + _joined(tensors)

    return Container(parts, close)


def _joined(parts: Parts) -> bytes:
    return b"".join(body for _, body in parts)


KINDS: tuple[tuple[bytes, Callable[[bytes], Container]], ...] = (
    (b"PK\x03\x04", _zip),
    (b"\x1f\x8b", _gzip),
    (ZSTD, _zstd),
    (PNG, _png),
    (b"\x93NUMPY", _npy),
    (b"ply\n", _ply),
    (b"glTF", _glb),
)
