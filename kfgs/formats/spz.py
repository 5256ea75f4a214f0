"""SPZ, Niantic's compressed splat file: versions 1 to 4 are read, 4 is written. Labels are in an extension record.

The streams: positions, 24-bit fixed point (float16 in version 1); alphas, 255 steps of opacity; colors, 255 steps of f_dc from
-0.5/0.15 to 0.5/0.15; scales, ln(s) = byte / 16 - 10; rotations, the three smaller of x, y, z, w, 9 bits and a sign each (x, y,
z as bytes before version 3); sh, (byte - 128) / 128, coefficient by coefficient, red, green and blue together.

**Convention**: SPZ's own axes are x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY.

**Why not a library**: Niantic's Python binding is not in the package index (in 2026 `spz` 0.0.1 there has another author,
and a wheel for Python 3.13 only). gsply 0.4.6 does not convert the axes, drops flags and extension records, and unpacks a
gzip stream to any size. The tests use it as an independent reader and writer.

**Labels** are in kfgs's extension record, type 0x4B460001; other readers skip it. Its payload, little-endian:

| bytes | what |
|---|---|
| u16 | layout version, 1; a reader refuses others |
| u16 | flags: 1 = scores follow |
| u32 | N, the number of Gaussians, as in the file's header |
| u32 | J, bytes of JSON: at most 1 MiB |
| rest | one Zstandard frame of N int32 class_id (-1 = none), N float32 score if flagged, J bytes of a JSON list of names |
"""

from __future__ import annotations

import json
import struct
import zlib
from math import exp, floor, log2, sqrt
from pathlib import Path

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray
from torch import Tensor

from .._files import parse_json
from .._notes import tell
from ..gaussians import Gaussians
from .encodings import join_largest, split_largest
from .spz_container import ANTIALIASED, GZIP, MAGIC, Container, read_container, unpack_frame, write_container
from .values import (
    NO_DEGREE_4,
    UP_AND_BACK,
    colours_to_write,
    describe_coarse,
    describe_cut,
    describe_loss,
    flip_axes,
    unit_quats,
)

NAME = "spz"
SUFFIXES = (".spz",)
HOLDS_LABELS = True
LABELS = 0x4B460001  # vendor 0x4B46 (KF), extension 1
_COORDINATES = 0xADBE0003  # Adobe's record: u32, the axes of the file
_LABELS_VERSION, _HAS_SCORE = 1, 0x1
_LABELS_HEAD = struct.Struct("<HHII")
_MAX_NAMES = 1 << 20
_DC = 0.5 / 0.15  # the degree-0 coefficient of byte 255
_LOG_SCALES = (-10.0, 255 / 16 - 10)
_MAX_FIXED = (1 << 23) - 1
_COMMON_BITS, _STEPS = 12, 14  # bits that every writer uses; a small cloud gets 2^14 steps across


def matches(head: bytes) -> bool:
    """NGSP at the beginning, or at the beginning of a gzip stream."""
    if head[:2] != GZIP:
        return head.startswith(MAGIC)
    try:
        return zlib.decompressobj(wbits=31).decompress(head, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def read(path: Path) -> Gaussians:
    """Read an SPZ file of version 1 to 4, gzipped or plain, into the axes of the 3DGS PLY; harmonics of degree 4 are dropped.

    Raises:
        ValueError: if it is damaged, of another version, or in axes that no flip turns into those of the PLY.
    """
    c = read_container(path)
    records = dict(c.extensions)
    axes = _axes(path, records.get(_COORDINATES))
    if c.degree > 3:
        tell(f"{path.name}: {NO_DEGREE_4}")
    rotations = c.streams["rotations"]
    coefficients = c.streams["sh"].reshape(c.size, (c.degree + 1) ** 2 - 1, 3)[:, :15]
    base = (_floats(c.streams["colors"]) / 255 - 0.5) / 0.15
    gaussians = Gaussians(
        means=torch.from_numpy(_unpack_positions(c)),
        quats=torch.from_numpy(_unpack_xyz(rotations) if c.version < 3 else _unpack_smallest_three(rotations)),
        scales=torch.from_numpy(_floats(c.streams["scales"]) / 16 - 10).view(-1, 3).exp(),
        opacities=torch.from_numpy(_floats(c.streams["alphas"]) / 255),
        sh=torch.cat([torch.from_numpy(base).view(-1, 1, 3), (torch.from_numpy(_floats(coefficients)) - 128) / 128], 1),
        antialiased=bool(c.flags & ANTIALIASED),
    )
    return _with_labels(path, flip_axes(gaussians, axes), records.get(LABELS))


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write version 4 with the finest positions that the cloud's extent allows.

    A step of a position is 2^-12 world units: larger for a cloud that reaches beyond 2048 units, smaller for a small one.

    Raises:
        ValueError: if the cloud has no colours, reaches further than 24 bits hold, or its names take more than 1 MiB.
    """
    g = colours_to_write(gaussians, ".spz")
    bits = choose_fractional_bits(g.means)
    if bits < 0:
        raise ValueError(
            f"means: expected coordinates within {2.0**23:g} units, got {g.means.abs().max().item():g}; write .ply or .sog, "
            "which have no such limit"
        )
    records = [] if g.labels is None else [(LABELS, _pack_labels(g))]
    turned = flip_axes(g, UP_AND_BACK)
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
    degree = int(turned.sh.shape[1] ** 0.5) - 1
    write_container(path, Container(4, len(g), degree, bits, ANTIALIASED * g.antialiased, streams, records))
    return _describe_lost(gaussians, g, bits)


def choose_fractional_bits(means: Tensor) -> int:  # means: [N, 3]
    """The bits after the point for a cloud's extent: usually 12, fewer beyond 2048 units from the origin, more within 2.

    Negative if not even whole units fit into 24 bits.
    """
    reach = means.abs().max().item() if len(means) else 0.0
    if reach == 0.0:
        return _COMMON_BITS
    return min(max(_COMMON_BITS, _STEPS - floor(log2(reach))), 20, floor(log2(_MAX_FIXED / reach)))


def _pack_labels(g: Gaussians) -> bytes:
    """The payload of kfgs's record."""
    assert g.labels is not None
    names = json.dumps(list(g.names), ensure_ascii=False).encode() if g.names else b""
    if len(names) > _MAX_NAMES:
        raise ValueError(f"classes: expected names of at most {_MAX_NAMES} bytes, got {len(names)}; shorten them")
    scores = b"" if g.scores is None else g.scores.numpy().astype("<f4").tobytes()
    flags = 0 if g.scores is None else _HAS_SCORE
    head = _LABELS_HEAD.pack(_LABELS_VERSION, flags, len(g), len(names))
    return head + zstandard.compress(g.labels.numpy().astype("<i4").tobytes() + scores + names, 12)


def _with_labels(path: Path, g: Gaussians, payload: bytes | None) -> Gaussians:
    """Add the labels, scores and names of kfgs's record."""
    if payload is None:
        return g
    n, head, frame = len(g), payload[: _LABELS_HEAD.size], payload[_LABELS_HEAD.size :]
    version, flags, count, names_size = _LABELS_HEAD.unpack(head) if len(head) == _LABELS_HEAD.size else (0, 0, 0, 0)
    if version != _LABELS_VERSION:
        raise ValueError(
            f"{path}: expected labels of layout {_LABELS_VERSION}, got {version}; update kfgs, or write them again"
        )
    if count != n or names_size > _MAX_NAMES:
        raise ValueError(
            f"{path}: expected labels of {n} Gaussians and at most {_MAX_NAMES} bytes of names, got {count} and {names_size}; "
            "the record is damaged"
        )
    size = n * (8 if flags & _HAS_SCORE else 4) + names_size
    plain = unpack_frame(path, "labels", frame, size)
    try:
        names = parse_json(plain[size - names_size :]) if names_size else []
    except ValueError as error:
        raise ValueError(f"{path}: expected names of classes, but they cannot be read ({error})") from error
    labels = np.frombuffer(plain, "<i4", n).astype(np.int64)
    scores = np.frombuffer(plain, "<f4", n, 4 * n).astype(np.float32) if flags & _HAS_SCORE else None
    if (labels < -1).any() or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: expected class_id of -1 or more and a list of names; the labels are damaged")
    return g.replace(
        labels=torch.from_numpy(labels), scores=None if scores is None else torch.from_numpy(scores), names=tuple(names)
    )


def _axes(path: Path, record: bytes | None) -> tuple[int, int, int]:
    """Signs of a file's axes against those of the PLY: RUB, unless Adobe's record says otherwise."""
    value = 0 if record is None else struct.unpack("<I", record)[0] if len(record) == 4 else -1
    if value == 0:  # unspecified
        return UP_AND_BACK
    if not 1 <= value <= 8:
        raise ValueError(
            f"{path}: expected a coordinate system of 1 to 8 (x, y, z with signs), got {value}; turn it to RUB with the program "
            "that wrote it"
        )
    right, up, front = ((value - 1) >> bit & 1 for bit in range(3))  # LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF
    return (1 if right else -1, -1 if up else 1, 1 if front else -1)


def _describe_lost(gaussians: Gaussians, g: Gaussians, bits: int) -> tuple[str, ...]:
    assert g.sh is not None
    lost = describe_loss(gaussians, ".spz", 3) + describe_coarse(g, 0.5 * 2.0**-bits, ".spz")
    lost += describe_cut(g.sh[:, :1], -_DC, _DC, "colours", ".spz")
    lost += describe_cut(g.sh[:, 1:], -1.0, 127 / 128, "higher harmonics", ".spz")
    low, high = (exp(end) for end in _LOG_SCALES)
    cut = int(((g.scales < low / 1.032) | (g.scales > high * 1.032)).any(1).sum())  # 1.032: half a step
    if cut:
        lost += (f"the extent of {cut} Gaussians: .spz holds {low:.1e} to {high:.0f} units along an axis",)
    return lost


def _floats(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    return values.astype(np.float32)


def _bytes(values: Tensor) -> NDArray[np.uint8]:
    return values.round().clamp(0, 255).to(torch.uint8).numpy().reshape(-1)


def _unpack_positions(c: Container) -> NDArray[np.float32]:  # [N, 3]
    stream = c.streams["positions"]
    if c.version == 1:
        return stream.view("<f2").astype(np.float32).reshape(-1, 3)
    wide = np.zeros((c.size, 3, 4), np.uint8)
    wide[..., 1:] = stream.reshape(c.size, 3, 3)  # the upper three bytes of an int32: the shift back keeps the sign
    return (wide.view("<i4")[..., 0] >> 8).astype(np.float32) * np.float32(2.0**-c.fractional_bits)


def _unpack_xyz(stream: NDArray[np.uint8]) -> NDArray[np.float32]:  # [N, 4] wxyz
    xyz = _floats(stream).reshape(-1, 3) / np.float32(127.5) - 1
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
