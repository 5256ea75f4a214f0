"""SPZ, Niantic's compressed splat file: versions 1 to 4 are read, 2 to 4 written. Labels are in an extension record.

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
from math import exp
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import zstandard
from numpy.typing import NDArray

from .._check import check_choice, check_whole
from .._files import as_path, parse_json
from .._notes import tell
from ..gaussians import Gaussians, check_gaussians
from .spz_codec import (
    DC,
    LOG_SCALES,
    choose_fractional_bits,
    most_fractional_bits,
    pack,
    precision_of,
    unpack,
)
from .spz_streams import ANTIALIASED, GZIP, MAGIC, MAX_FRACTIONAL_BITS, Container, read_container, write_container
from .values import (
    NO_DEGREE_4,
    UP_AND_BACK,
    Precision,
    check_splats,
    colours_to_write,
    describe_coarse,
    describe_cut,
    describe_loss,
)

NAME = "spz"
SUFFIXES = (".spz",)
HOLDS_LABELS = True
_COORDINATES = 0xADBE0003  # Adobe's record: u32, the axes of the file
LABELS = 0x4B460001  # vendor 0x4B46 (KF), extension 1
_LABELS_VERSION, _HAS_SCORE = 1, 0x1
_LABELS_HEAD = struct.Struct("<HHII")
_MAX_NAMES = 1 << 20


def matches(head: bytes) -> bool:
    """NGSP at the beginning, or at the beginning of a gzip stream."""
    if head[:2] != GZIP:
        return head.startswith(MAGIC)
    try:
        return zlib.decompressobj(wbits=31).decompress(head, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def read(path: Path) -> Gaussians:
    """Read an SPZ file of version 1, 2, 3 or 4, gzipped or plain, into the axes of the 3DGS PLY.

    Harmonics of degree 4 are dropped.

    Raises:
        ValueError: if it is damaged, of another version, or in axes that no flip turns into those of the PLY.
    """
    c = read_container(path)
    records: dict[int, bytes] = dict(c.extensions)
    axes = _axes(path, records.pop(_COORDINATES, None))
    label_record = records.pop(LABELS, None)
    if c.degree > 3:
        tell(f"{path.name}: {NO_DEGREE_4}")
    gaussians = unpack(c, axes).replace(antialiased=bool(c.flags & ANTIALIASED))
    if label_record is None:
        return gaussians
    record = _unpack_labels(path, label_record, c.count)
    labels = torch.from_numpy(record.class_id.astype(np.int64))
    scores = None if record.score is None else torch.from_numpy(record.score)
    return gaussians.replace(labels=labels, scores=scores, names=record.classes)


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write version 4 with the finest positions that the cloud's extent allows; see `write_spz`."""
    return write_spz(gaussians, path)


def write_spz(
    gaussians: Gaussians,
    path: str | Path,
    *,
    version: int = 4,
    fractional_bits: int | None = None,
    sh_bits: tuple[int, int] = (8, 8),
) -> tuple[str, ...]:
    """Write an SPZ file, labels, scores and class names included.

    Args:
        gaussians: a cloud with colours.
        path: the file, whole or absent.
        version: 4 (Zstandard streams), or 3 or 2 (gzip) for older readers; 2 keeps rotations as three bytes.
        fractional_bits: bits after the point of positions, 0 to 24: a step is 2^-bits world units. By default 12, fewer
            for a cloud that reaches beyond 2048 units, more for a small one.
        sh_bits: bits kept of harmonics of degree 1, and of degrees 2 and 3, 1 to 8. (5, 4) is what Niantic's own
            writer keeps: on a scene of degree 3 the file was 0.6 times as large, the picture at 33 instead of 49 dB.

    Returns:
        Descriptions of what the file could not store.

    Raises:
        ValueError: if the cloud has no colours, values that `write_splats` refuses, or reaches further than 24 bits hold, or
            an option is out of its range.
    """
    check_choice("version", version, (2, 3, 4))
    for bits in sh_bits:
        check_whole("sh_bits", bits, 1, 8)
    check_gaussians(gaussians)
    check_splats(gaussians)
    g = colours_to_write(gaussians, ".spz")
    if fractional_bits is None:
        fractional_bits = max(choose_fractional_bits(g.means), 0)
    else:
        check_whole("fractional_bits", fractional_bits, 0, MAX_FRACTIONAL_BITS)
    if fractional_bits > (most := most_fractional_bits(g.means)):
        raise ValueError(
            f"means: expected coordinates within {2.0 ** (23 - fractional_bits):g} units for {fractional_bits} fractional "
            f"bits, got {g.means.abs().max().item():g}; "
            + (f"choose {most} bits or fewer" if most >= 0 else "write .ply or .sog, which have no such limit")
        )
    assert g.sh is not None
    degree = int(g.sh.shape[1] ** 0.5) - 1
    flags = ANTIALIASED if g.antialiased else 0
    records = [] if g.labels is None else [(LABELS, _pack_labels(_record(g)))]
    streams = pack(g, version, fractional_bits, sh_bits)
    write_container(as_path(path), Container(version, len(g), degree, fractional_bits, flags, streams, records))
    return _lost(gaussians, g, fractional_bits)


def precision(gaussians: Gaussians) -> Precision:
    """The precision of `write`; the bits of positions depend on the cloud."""
    return precision_of(gaussians, choose_fractional_bits(gaussians.means))


class _LabelRecord(NamedTuple):
    """The content of kfgs's extension record."""

    class_id: NDArray[np.int32]  # [N], -1 = none
    score: NDArray[np.float32] | None  # [N]
    classes: tuple[str, ...]


def _pack_labels(record: _LabelRecord) -> bytes:
    """The payload of a record; a ValueError if the names take more than 1 MiB."""
    names = json.dumps(list(record.classes), ensure_ascii=False).encode() if record.classes else b""
    if len(names) > _MAX_NAMES:
        raise ValueError(f"classes: expected names of at most {_MAX_NAMES} bytes, got {len(names)}; shorten them")
    parts = [record.class_id.astype("<i4").tobytes(), names]
    if record.score is not None:
        parts.insert(1, record.score.astype("<f4").tobytes())
    head = _LABELS_HEAD.pack(
        _LABELS_VERSION, 0 if record.score is None else _HAS_SCORE, len(record.class_id), len(names)
    )
    return head + zstandard.compress(b"".join(parts), 12)


def _unpack_labels(path: Path, payload: bytes, count: int) -> _LabelRecord:
    """Read the record of a file with `count` Gaussians; a ValueError if it is damaged or does not fit."""
    version, flags, n, names_size = (
        _LABELS_HEAD.unpack_from(payload) if len(payload) >= _LABELS_HEAD.size else (0, 0, 0, 0)
    )
    if version != _LABELS_VERSION:
        raise ValueError(
            f"{path}: expected labels of layout {_LABELS_VERSION}, got {version}; update kfgs, or write them again"
        )
    if n != count or names_size > _MAX_NAMES:
        raise ValueError(
            f"{path}: expected labels of {count} Gaussians and at most {_MAX_NAMES} bytes of names, got {n} and {names_size}; "
            "the record is damaged"
        )
    scores = flags & _HAS_SCORE
    size = n * (8 if scores else 4) + names_size
    try:
        if zstandard.get_frame_parameters(payload[_LABELS_HEAD.size :]).content_size != size:
            raise zstandard.ZstdError("of another size")
        plain = (
            zstandard.ZstdDecompressor().decompress(payload[_LABELS_HEAD.size :], allow_extra_data=False)
            if size
            else b""
        )
        classes = parse_json(plain[size - names_size :]) if names_size else []
    except (zstandard.ZstdError, ValueError) as error:
        raise ValueError(f"{path}: expected {size} bytes of labels, but they cannot be read ({error})") from error
    class_id = np.frombuffer(plain, "<i4", n).astype(np.int32)
    score = np.frombuffer(plain, "<f4", n, 4 * n).astype(np.float32) if scores else None
    if (class_id < -1).any() or not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise ValueError(f"{path}: expected class_id of -1 or more and a list of names; the labels are damaged")
    return _LabelRecord(class_id, score, tuple(classes))


def _record(g: Gaussians) -> _LabelRecord:
    assert g.labels is not None
    score = None if g.scores is None else g.scores.numpy().astype(np.float32)
    return _LabelRecord(g.labels.numpy().astype(np.int32), score, g.names)


def _axes(path: Path, record: bytes | None) -> tuple[int, int, int]:
    """Signs of a file's axes against those of the PLY: RUB, unless Adobe's record says otherwise."""
    if record is None:
        return UP_AND_BACK
    value = struct.unpack("<I", record)[0] if len(record) == 4 else -1
    if value == 0:  # unspecified
        return UP_AND_BACK
    if not 1 <= value <= 8:
        raise ValueError(
            f"{path}: expected a coordinate system of 1 to 8 (x, y, z with signs), got {value}; turn it to RUB with the program "
            "that wrote it"
        )
    right, up, front = ((value - 1) >> bit & 1 for bit in range(3))  # LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF
    return (1 if right else -1, -1 if up else 1, 1 if front else -1)


def _lost(gaussians: Gaussians, g: Gaussians, fractional_bits: int) -> tuple[str, ...]:
    lost = list(describe_loss(gaussians, ".spz", 3))
    lost += describe_coarse(g, 0.5 * 2.0**-fractional_bits, ".spz")
    assert g.sh is not None
    lost += describe_cut(g.sh[:, :1], -DC, DC, "colours", ".spz")
    lost += describe_cut(g.sh[:, 1:], -1.0, 127 / 128, "higher harmonics", ".spz")
    low, high = (exp(end) for end in LOG_SCALES)
    cut = int(((g.scales < low / 1.032) | (g.scales > high * 1.032)).any(1).sum())
    if cut:
        lost.append(f"the extent of {cut} Gaussians: .spz holds {low:.1e} to {high:.0f} units along an axis")
    return tuple(lost)
