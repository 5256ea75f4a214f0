"""SPZ, Niantic's compressed splat file: versions 1 to 4 are read, 4 is written.

Versions 1 to 3 are one gzip stream: 16 bytes of header, the streams of bytes one after another, extension records. Version 4
has 32 bytes of header, the records, a table, and a Zstandard frame per stream. A record is `[u32 type][u32 length][payload]`;
readers skip types that they do not know. All numbers are little-endian. The streams: positions, 24-bit fixed point (float16
in version 1); alphas, 255 steps of opacity; colors, 255 steps of f_dc from -0.5/0.15 to 0.5/0.15; scales, ln(s) = byte / 16 -
10; rotations, the three smaller of x, y, z, w, 9 bits and a sign each (x, y, z as bytes before version 3); sh, (byte - 128) /
128, coefficient by coefficient, red, green and blue together. There is no place for labels, so they go to a separate file.

**Convention**: SPZ's own axes are x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY.

**Why not a library**: Niantic's binding is not in the package index. gsply 0.4.6 does not convert the axes, drops flags and
extension records, and unpacks a gzip stream to any size.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from math import floor, log2, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray
from torch import Tensor

from .._arrays import most_unpacked
from .._files import atomic_path
from ..gaussians import Gaussians
from .encodings import join_largest, split_largest
from .values import UP_AND_BACK, check_count, describe_coarse, describe_cut, flip_axes, unit_quats, up_to_degree_3

NAME = "spz"
SUFFIXES = (".spz",)
HOLDS = frozenset({"harmonics", "antialiased"})
MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_ANTIALIASED, _HAS_EXTENSIONS = 0x1, 0x2
_COORDINATES = 0xADBE0003  # Adobe's record: u32, the axes of the file
_LEGACY = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved
_HEADER = struct.Struct("<4sIIBBBBI12x")  # the same, but the number of streams, and where the table begins
_ENTRY = struct.Struct("<QQ")  # compressed and plain bytes of a stream
_RECORD = struct.Struct("<II")
_PART = 1 << 20  # bytes that are unpacked at once
_DC = 0.5 / 0.15  # the degree-0 coefficient of byte 255
_LOG_SCALES = (-10.0, 255 / 16 - 10)
_MAX_FIXED = (1 << 23) - 1
_COMMON_BITS, _STEPS = 12, 14  # bits that every writer uses; a small cloud gets 2^14 steps across


class _Header(NamedTuple):
    """What both containers begin with."""

    version: int
    size: int  # Gaussians
    degree: int  # of the spherical harmonics, 0 to 4
    fractional_bits: int
    flags: int

    def streams(self) -> dict[str, int]:
        """The plain bytes of each stream, in the order of the file."""
        position, rotation = (6 if self.version == 1 else 9), (3 if self.version < 3 else 4)
        each = {"positions": position, "alphas": 1, "colors": 3, "scales": 3, "rotations": rotation}
        each["sh"] = 3 * ((self.degree + 1) ** 2 - 1)
        return {name: size * self.size for name, size in each.items()}


_Streams = tuple[_Header, dict[str, NDArray[np.uint8]], dict[int, bytes]]  # header, plain streams, extension records


def matches(head: bytes) -> bool:
    """NGSP at the beginning, or at the beginning of a gzip stream."""
    if head[:2] != _GZIP:
        return head.startswith(MAGIC)
    try:
        return zlib.decompressobj(wbits=31).decompress(head, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def read(path: Path) -> Gaussians:
    """Read an SPZ file of version 1 to 4, gzipped or plain, into the axes of the 3DGS PLY."""
    data = path.read_bytes()
    if data[:2] == _GZIP:
        header, streams, records = _read_plain(_inflate(data))
    else:
        header, streams, records = (_read_plain if _read_header(data).version < 4 else _read_packed)(data)

    def floats(name: str) -> Tensor:
        return torch.from_numpy(streams[name].astype(np.float32))

    rotations = streams["rotations"]
    base = ((floats("colors") / 255 - 0.5) / 0.15).view(-1, 1, 3)
    rest = ((floats("sh") - 128) / 128).view(header.size, (header.degree + 1) ** 2 - 1, 3)
    gaussians = Gaussians(
        means=torch.from_numpy(_unpack_positions(header, streams["positions"])),
        quats=torch.from_numpy(_unpack_xyz(rotations) if header.version < 3 else _unpack_smallest_three(rotations)),
        scales=(floats("scales") / 16 - 10).view(-1, 3).exp(),
        opacities=floats("alphas") / 255,
        sh=up_to_degree_3(path, torch.cat([base, rest], 1)),
        antialiased=bool(header.flags & _ANTIALIASED),
    )
    return flip_axes(gaussians, _axes(records.get(_COORDINATES)))


def write(path: Path, g: Gaussians) -> list[str]:
    """Write version 4 with the finest positions that the cloud's extent allows.

    A step of a position is 2^-12 world units: larger for a cloud that reaches beyond 2048 units, smaller for a small one.
    A ValueError if the cloud reaches further than 24 bits hold.
    """
    bits = choose_fractional_bits(g.means)
    if bits < 0:
        raise ValueError(
            f"means: expected coordinates within {2.0**23:g} units, got {g.means.abs().max().item():g}; write .ply or .sog, "
            "which have no such limit"
        )
    turned = flip_axes(g, UP_AND_BACK)
    assert g.sh is not None
    assert turned.sh is not None
    fixed = (turned.means * 2**bits).round().to(torch.int32).numpy()
    streams = {
        "positions": np.ascontiguousarray(fixed.astype("<i4")[..., None].view(np.uint8)[..., :3]).reshape(-1),
        "alphas": _bytes(turned.opacities * 255),
        "colors": _bytes(turned.sh[:, 0] * (0.15 * 255) + 127.5),
        "scales": _bytes((turned.scales.log().clamp(*_LOG_SCALES) + 10) * 16),
        "rotations": _pack_smallest_three(unit_quats(turned.quats).numpy()),
        "sh": _bytes((turned.sh[:, 1:] * 128 + 128 + 0.5).floor()),
    }
    plain = [values.tobytes() for values in streams.values() if values.size]
    packed = [zstandard.compress(stream, 12) for stream in plain]
    table = [_ENTRY.pack(len(small), len(stream)) for small, stream in zip(packed, plain, strict=True)]
    degree = int(turned.sh.shape[1] ** 0.5) - 1
    head = (MAGIC, 4, len(g), degree, bits, _ANTIALIASED * g.antialiased, len(packed), _HEADER.size)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.writelines([_HEADER.pack(*head), *table, *packed])
    lost = describe_coarse(g, 0.5 * 2.0**-bits, ".spz")
    lost += describe_cut(g.sh[:, :1], -_DC, _DC, "colours", ".spz")
    lost += describe_cut(g.sh[:, 1:], -1.0, 127 / 128, "higher harmonics", ".spz")
    return lost + describe_cut(g.scales.log(), *_LOG_SCALES, "scales", ".spz")


def choose_fractional_bits(means: Tensor) -> int:  # means: [N, 3]
    """The bits after the point for a cloud's extent: usually 12, fewer beyond 2048 units from the origin, more within 2.

    Negative if not even whole units fit into 24 bits.
    """
    reach = means.abs().max().item() if len(means) else 0.0
    if reach == 0.0:
        return _COMMON_BITS
    return min(max(_COMMON_BITS, _STEPS - floor(log2(reach))), 20, floor(log2(_MAX_FIXED / reach)))


def _read_header(data: bytes | bytearray) -> _Header:
    if data[:4] != MAGIC or len(data) < _LEGACY.size:
        raise ValueError(f"it begins with {bytes(data[:4])!r}, not with NGSP and {_LEGACY.size - 4} bytes more")
    _, version, count, degree, bits, flags, _ = _LEGACY.unpack_from(data)
    for what, value, low, high in (
        ("its version", version, 1, 4),
        ("the degree of its harmonics", degree, 0, 4),
        ("the number of its fractional bits", bits, 0, 24),
    ):
        if not low <= value <= high:
            raise ValueError(f"{what} is {value}, not {low} to {high}")
    return _Header(version, count, degree, bits, flags)


def _inflate(data: bytes) -> bytearray:
    """The plain bytes of a gzip stream (one member or several), at most as many as its SPZ header implies."""
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        plain = bytearray(file.read(_LEGACY.size))
        header = _read_header(plain)
        check_count(header.size, header.degree, len(data))
        # Flags other than antialiased announce more after the streams.
        limit = most_unpacked(len(data)) if header.flags & ~_ANTIALIASED else sum(header.streams().values())
        while len(plain) <= _LEGACY.size + limit and (part := file.read(_PART)):
            plain += part
    if len(plain) > _LEGACY.size + limit:
        raise ValueError(f"its header promises {limit} plain bytes, it has more")
    return plain


def _read_plain(data: bytes | bytearray) -> _Streams:
    """Versions 1 to 3: 16 bytes of header, the streams, extension records."""
    header = _read_header(data)
    if header.version == 4:
        raise ValueError("a gzip stream holds version 1 to 3, not 4")
    sizes = header.streams()
    needed, have = sum(sizes.values()), len(data) - _LEGACY.size
    if needed > have or (needed < have and not header.flags & ~_ANTIALIASED):
        raise ValueError(f"{header.size} Gaussians take {needed} bytes, it has {have}: is it truncated?")
    streams, at = {}, _LEGACY.size
    for name, size in sizes.items():
        streams[name] = np.frombuffer(data, np.uint8, size, at)
        at += size
    return (header, streams, _read_records(data[at:]) if header.flags & _HAS_EXTENSIONS else {})


def _read_packed(data: bytes) -> _Streams:
    """Version 4: 32 bytes of header, extension records, the table of contents, one Zstandard frame per stream."""
    header = _read_header(data)
    check_count(header.size, header.degree, len(data))
    *_, number, start = _HEADER.unpack_from(data)
    sizes = header.streams()
    names = [name for name, size in sizes.items() if size] if number < len(sizes) else list(sizes)
    end = start + number * _ENTRY.size
    if number != len(names) or start < _HEADER.size or end > len(data):
        raise ValueError(f"{len(names)} streams expected in {len(data)} bytes, got {number} listed at byte {start}")
    streams, at = {name: np.zeros(0, np.uint8) for name in sizes}, end
    for name, (small, plain) in zip(names, _ENTRY.iter_unpack(data[start:end]), strict=True):
        if plain != sizes[name] or at + small > len(data):
            raise ValueError(f"{sizes[name]} bytes of {name} expected, got {plain} up to byte {at + small}: truncated?")
        streams[name] = np.frombuffer(_unpack_frame(name, data[at : at + small], plain), np.uint8)
        at += small
    if at != len(data):
        raise ValueError(f"it should end at byte {at}, it has {len(data) - at} bytes more")
    return (header, streams, _read_records(data[_HEADER.size : start]) if header.flags & _HAS_EXTENSIONS else {})


def _read_records(data: bytes | bytearray) -> dict[int, bytes]:
    records, at = dict[int, bytes](), 0
    while at < len(data):
        kind, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise ValueError("an extension record reaches beyond all of them")
        records[kind] = bytes(data[at : at + length])
        at += length
    return records


def _unpack_frame(name: str, data: bytes, size: int) -> bytes:
    """One Zstandard frame of exactly `size` plain bytes."""
    promised = zstandard.get_frame_parameters(data).content_size if data else 0
    if promised not in (size, zstandard.CONTENTSIZE_UNKNOWN):  # the decompressor allocates the promised size
        raise ValueError(f"{size} bytes of {name} expected, {promised} promised")
    plain = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False) if size else b""
    if len(plain) != size:
        raise ValueError(f"{size} bytes of {name} expected, got {len(plain)}")
    return plain


def _axes(record: bytes | None) -> tuple[int, int, int]:
    """Signs of a file's axes against those of the PLY: RUB, unless Adobe's record says otherwise."""
    (value,) = (0,) if record is None else struct.unpack("<I", record)
    if value == 0:  # unspecified
        return UP_AND_BACK
    if not 1 <= value <= 8:
        raise ValueError(f"its coordinate system is {value}, not 1 to 8 (x, y, z with signs)")
    right, up, front = ((value - 1) >> bit & 1 for bit in range(3))  # LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF
    return (1 if right else -1, -1 if up else 1, 1 if front else -1)


def _bytes(values: Tensor) -> NDArray[np.uint8]:
    return values.round().clamp(0, 255).to(torch.uint8).numpy().reshape(-1)


def _unpack_positions(header: _Header, stream: NDArray[np.uint8]) -> NDArray[np.float32]:  # [N, 3]
    if header.version == 1:
        return stream.view("<f2").astype(np.float32).reshape(-1, 3)
    wide = np.zeros((header.size, 3, 4), np.uint8)
    wide[..., 1:] = stream.reshape(header.size, 3, 3)  # the upper bytes of an int32: the shift back keeps the sign
    return (wide.view("<i4")[..., 0] >> 8).astype(np.float32) * np.float32(2.0**-header.fractional_bits)


def _unpack_xyz(stream: NDArray[np.uint8]) -> NDArray[np.float32]:  # [N, 4] wxyz
    xyz = stream.astype(np.float32).reshape(-1, 3) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1)


def _unpack_smallest_three(stream: NDArray[np.uint8]) -> NDArray[np.float32]:  # [N, 4] wxyz
    """Bits 30-31 name the largest of x, y, z, w; the other three follow in order, the last one in the lowest 10 bits."""
    word = stream.view("<u4").astype(np.uint32)
    values = np.stack([(word >> shift) & 0x3FF for shift in (20, 10, 0)], 1)  # [N, 3]
    small = (values & 0x1FF).astype(np.float32) * np.float32(sqrt(0.5) / 511)
    small = np.where(values & 0x200, -small, small)
    return join_largest((word >> 30).astype(np.int64), small)[:, [3, 0, 1, 2]]


def _pack_smallest_three(quats: NDArray[np.float64]) -> NDArray[np.uint8]:  # quats: [N, 4] wxyz, unit
    largest, small = split_largest(quats[:, [1, 2, 3, 0]])
    sizes = np.minimum(np.round(np.abs(small) * (511 / sqrt(0.5))), 511).astype(np.uint32)
    values = sizes | np.where(small < 0, 0x200, 0).astype(np.uint32)
    word = (largest.astype(np.uint32) << 30) | (values[:, 0] << 20) | (values[:, 1] << 10) | values[:, 2]
    return word.astype("<u4").view(np.uint8)
