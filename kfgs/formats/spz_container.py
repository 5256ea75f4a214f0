"""The containers of SPZ files: one gzip stream (versions 1 to 3) or a header, records, a table and Zstandard streams (4).

Both hold the same byte streams, one per attribute: positions, alphas, colors, scales, rotations, sh. Extension records
`[u32 type][u32 length][payload]` lie between the header and the table (4) or after the last stream (1 to 3), announced by
a flag; readers skip types that they do not know. All numbers are little-endian.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from .._arrays import most_unpacked
from .._files import atomic_path
from .values import check_count

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
ANTIALIASED, HAS_EXTENSIONS = 0x1, 0x2
_MAX_DEGREE, _MAX_FRACTIONAL_BITS = 4, 24
_LEGACY = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved
_HEADER = struct.Struct("<4sIIBBBBI12x")  # the same, but the number of streams, and where the table begins
_ENTRY = struct.Struct("<QQ")  # compressed and plain bytes of a stream
_RECORD = struct.Struct("<II")
_PART = 1 << 20  # bytes that are unpacked at once


class Container(NamedTuple):
    """An SPZ file, its streams plain but still quantised."""

    version: int
    size: int  # Gaussians
    degree: int  # of the spherical harmonics, 0 to 4
    fractional_bits: int
    flags: int
    streams: dict[str, NDArray[np.uint8]]  # the bytes of each attribute, in the order of the file
    extensions: list[tuple[int, bytes]]  # records: type, payload


def read_container(path: Path) -> Container:
    """Read an SPZ file of version 1 to 4. Sizes that the file cannot hold are refused before unpacking.

    Raises:
        ValueError: if it is not an SPZ file, or damaged: truncated, or with counts or sizes that do not fit.
    """
    data = path.read_bytes()
    if data[:2] == GZIP:
        return _parse_legacy(path, _inflate(path, data))
    if data[:4] != MAGIC or len(data) < _LEGACY.size:
        raise ValueError(
            f"{path}: expected an SPZ file (NGSP, or gzip around it), got {data[:4]!r}; is it another format?"
        )
    return (_parse_legacy if struct.unpack_from("<I", data, 4)[0] < 4 else _parse_streams)(path, data)


def write_container(path: Path, c: Container) -> None:
    """Write a container of version 4, atomically."""
    records = b"".join(_RECORD.pack(kind, len(payload)) + payload for kind, payload in c.extensions)
    flags = c.flags | (HAS_EXTENSIONS if records else 0)
    streams = [values.tobytes() for values in c.streams.values() if values.size]
    packed = [zstandard.compress(stream, 12) for stream in streams]
    table = [_ENTRY.pack(len(small), len(plain)) for small, plain in zip(packed, streams, strict=True)]
    start = _HEADER.size + len(records)
    head = _HEADER.pack(MAGIC, 4, c.size, c.degree, c.fractional_bits, flags, len(packed), start)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.writelines([head, records, *table, *packed])


def unpack_frame(path: Path, name: str, data: bytes, size: int) -> bytes:
    """One Zstandard frame of exactly `size` plain bytes."""
    if not data and not size:
        return b""
    try:
        promised = zstandard.get_frame_parameters(data).content_size
        if promised not in (size, zstandard.CONTENTSIZE_UNKNOWN):  # the decompressor allocates the promised size
            raise ValueError(
                f"{path}: expected {size} bytes of {name}, got a frame of {promised} bytes; the file is damaged"
            )
        unpacker = zstandard.ZstdDecompressor()
        plain = unpacker.decompress(data, max_output_size=size, allow_extra_data=False) if size else b""
    except zstandard.ZstdError as error:
        raise ValueError(
            f"{path}: expected a Zstandard stream of {name}, but it cannot be unpacked ({error})"
        ) from error
    if len(plain) != size:
        raise ValueError(f"{path}: expected {size} bytes of {name}, got {len(plain)}; the file is damaged")
    return plain


def _check_header(path: Path, data: bytes | bytearray) -> tuple[int, int, int, int, int, dict[str, int]]:
    """Check the fields that all versions share; returns them, and the plain bytes of each stream in the file's order."""
    _, version, count, degree, bits, flags, _ = _LEGACY.unpack_from(data)
    for what, value, low, high in (
        ("SPZ version", version, 1, 4),
        ("spherical harmonics of degree", degree, 0, _MAX_DEGREE),
        ("fractional bits from", bits, 0, _MAX_FRACTIONAL_BITS),
    ):
        if not low <= value <= high:
            raise ValueError(f"{path}: expected {what} {low} to {high}, got {value}; update kfgs, or convert the file")
    position, rotation = (6 if version == 1 else 9), (3 if version < 3 else 4)
    each = {"positions": position, "alphas": 1, "colors": 3, "scales": 3, "rotations": rotation}
    each["sh"] = 3 * ((degree + 1) ** 2 - 1)
    return version, count, degree, bits, flags, {name: size * count for name, size in each.items()}


def _inflate(path: Path, data: bytes) -> bytearray:
    """The plain bytes of a gzip stream (one member or several), at most as many as its SPZ header implies."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            head = file.read(_LEGACY.size)
            if head[:4] != MAGIC or len(head) < _LEGACY.size:
                raise ValueError(
                    f"{path}: expected an SPZ header in the gzip stream (NGSP), got {head[:4]!r}; the file is truncated, or of "
                    "another format"
                )
            _, count, degree, _, flags, sizes = _check_header(path, head)
            check_count(path, count, degree, len(data))
            # Flags other than antialiased announce more after the streams.
            limit = most_unpacked(len(data)) if flags & ~ANTIALIASED else sum(sizes.values())
            plain = bytearray(head)
            while len(plain) <= _LEGACY.size + limit and (part := file.read(_PART)):
                plain += part
    except EOFError as error:
        raise ValueError(f"{path}: expected a whole gzip stream, got a part; the file is truncated") from error
    except (zlib.error, OSError) as error:
        raise ValueError(
            f"{path}: expected a gzip stream, but it cannot be unpacked ({error}); it is damaged"
        ) from error
    if len(plain) > _LEGACY.size + limit:
        raise ValueError(f"{path}: expected {limit} plain bytes by its header, got more; the file is damaged")
    return plain


def _parse_legacy(path: Path, data: bytes | bytearray) -> Container:
    version, count, degree, bits, flags, sizes = _check_header(path, data)
    if version == 4:
        raise ValueError(f"{path}: expected version 1 to 3 in a gzip stream, got 4; the file is damaged")
    needed, have = sum(sizes.values()), len(data) - _LEGACY.size
    if needed > have or (needed < have and not flags & ~ANTIALIASED):
        raise ValueError(
            f"{path}: expected {needed} bytes for {count} Gaussians, got {have}; the file is truncated, or damaged"
        )
    streams, at = {}, _LEGACY.size
    for name, size in sizes.items():
        streams[name] = np.frombuffer(data, np.uint8, size, at)
        at += size
    records = _parse_records(path, data[at:]) if flags & HAS_EXTENSIONS else []
    return Container(version, count, degree, bits, flags, streams, records)


def _parse_records(path: Path, data: bytes | bytearray) -> list[tuple[int, bytes]]:
    records, at = [], 0
    while at < len(data):
        kind, length = _RECORD.unpack_from(data, at) if at + _RECORD.size <= len(data) else (0, len(data))
        at += _RECORD.size
        if at + length > len(data):
            raise ValueError(
                f"{path}: expected extension records of {len(data)} bytes, got one that ends after them; it is damaged"
            )
        records.append((kind, bytes(data[at : at + length])))
        at += length
    return records


def _parse_streams(path: Path, data: bytes) -> Container:
    """Version 4: 32 bytes of header, extension records, the table of contents, one Zstandard frame per stream."""
    if len(data) < _HEADER.size:
        raise ValueError(f"{path}: expected a header of {_HEADER.size} bytes, got {len(data)}; the file is truncated")
    version, count, degree, bits, flags, sizes = _check_header(path, data)
    check_count(path, count, degree, len(data))
    *_, number, start = _HEADER.unpack_from(data)
    names = [name for name, size in sizes.items() if size] if number < len(sizes) else list(sizes)
    end = start + number * _ENTRY.size
    if number != len(names) or start < _HEADER.size or end > len(data):
        raise ValueError(
            f"{path}: expected a table of {len(names)} streams within {len(data)} bytes, got {number} streams at byte "
            f"{start}; the file is truncated, or damaged"
        )
    streams, at = {name: np.zeros(0, np.uint8) for name in sizes}, end
    for name, (small, plain) in zip(names, _ENTRY.iter_unpack(data[start:end]), strict=True):
        if plain != sizes[name] or at + small > len(data):
            raise ValueError(
                f"{path}: expected a stream of {sizes[name]} bytes of {name} within {len(data)} bytes, got {plain} bytes "
                f"packed up to byte {at + small}; the file is truncated, or damaged"
            )
        streams[name] = np.frombuffer(unpack_frame(path, name, data[at : at + small], plain), np.uint8)
        at += small
    if at != len(data):
        raise ValueError(f"{path}: expected the end at byte {at}, got {len(data) - at} bytes more; the file is damaged")
    records = _parse_records(path, data[_HEADER.size : start]) if flags & HAS_EXTENSIONS else []
    return Container(version, count, degree, bits, flags, streams, records)
