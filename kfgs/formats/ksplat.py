"""The `.ksplat` file of mkkellogg's GaussianSplats3D viewer, versions 0.1 and later, read only.

A header of 4096 bytes, then one of 1024 bytes per section, then the sections: counts of the partly filled buckets, bucket
centres, and Gaussians as records. Compression level 0 keeps float32; levels 1 and 2 keep float16 scales and quaternions,
positions as 16 bits against the centre of their bucket, and harmonics as float16 (1) or bytes over a range of the header
(2). Harmonics go band by band, all of red, then green, then blue. Quaternions are (w, x, y, z), axes those of the PLY.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..gaussians import Gaussians
from .values import SH_C0, positive_scales

NAME = "ksplat"
SUFFIXES = (".ksplat",)
HOLDS_LABELS = False
_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = struct.Struct("<BB2xIIIIH14xff")  # version, max sections, sections, max count, count, level, ..., sh range
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_MAX_DEGREE = 2
_SH_RANGE = 1.5  # of level 2, if the header gives none


class _Section(NamedTuple):
    size: int  # Gaussians in it
    capacity: int  # Gaussians that there is room for
    bucket_size: int  # Gaussians in a full bucket
    buckets: int
    block_size: float  # world units along a bucket
    bucket_bytes: int
    quantum: int  # steps in half a block
    full_buckets: int
    partial_buckets: int
    degree: int


def matches(head: bytes) -> bool:
    """Version 0.x, a level up to 2, counts of sections and Gaussians that fit together; the name helps where this fails."""
    if len(head) < _HEADER_BYTES + _SECTION.size:
        return False
    major, minor, most, used, _, size, level, low, high = _HEADER.unpack_from(head)
    return (
        major == 0
        and 1 <= minor < 32
        and head[2:4] == b"\0\0"
        and 1 <= most < 1 << 16
        and used <= most
        and (level <= 2 and size > 0 and low <= 0 <= high)
    )


def read(path: Path) -> Gaussians:
    """Read a .ksplat file of compression level 0, 1 or 2 and harmonics of degree 0 to 2.

    Raises:
        ValueError: if it is damaged: truncated, of another version, with counts that disagree.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES:
        raise ValueError(f"{path}: expected a header of {_HEADER_BYTES} bytes, got {len(data)}; the file is truncated")
    major, minor, most, _, _, count, level, low, high = _HEADER.unpack_from(data)
    if major != 0 or minor < 1 or level > 2:
        raise ValueError(
            f"{path}: expected .ksplat version 0.1 or later and compression level 0 to 2, got {major}.{minor} and {level}; it is "
            "damaged, or of another format"
        )
    if _HEADER_BYTES + most * _SECTION_BYTES > len(data):
        raise ValueError(
            f"{path}: the header promises {most} sections, but only {len(data)} bytes follow; it is truncated"
        )
    sh_range = (low, high) if low < high and np.isfinite([low, high]).all() else (-_SH_RANGE, _SH_RANGE)
    sections = [_Section(*_SECTION.unpack_from(data, _HEADER_BYTES + i * _SECTION_BYTES)) for i in range(most)]
    for i, section in enumerate(sections):
        if section.size > section.capacity or section.degree > _MAX_DEGREE:
            raise ValueError(
                f"{path}: expected at most {section.capacity} Gaussians of degree 0 to {_MAX_DEGREE} in section {i}, got "
                f"{section.size} of degree {section.degree}; the file is damaged"
            )
    degree = max((s.degree for s in sections if s.size), default=0)
    parts, start = [], _HEADER_BYTES + most * _SECTION_BYTES
    for section in sections:
        cloud, start = _read_section(path, data, start, section, level, sh_range, degree)
        parts.append(cloud)
    gaussians = Gaussians.cat(parts) if parts else None
    if gaussians is None or len(gaussians) != count or start != len(data):
        raise ValueError(
            f"{path}: expected {count} Gaussians in {len(data)} bytes, got {0 if gaussians is None else len(gaussians)} in "
            f"{start}; the file is damaged"
        )
    return gaussians


def _record(level: int, degree: int) -> np.dtype[np.void]:
    """The layout of one Gaussian."""
    wide, sh = ("<f4", "<f4") if level == 0 else ("<f2", "<f2" if level == 1 else "u1")
    means = "<f4" if level == 0 else "<u2"
    fields = [("means", means, 3), ("scales", wide, 3), ("quats", wide, 4), ("rgba", "u1", 4)]
    return np.dtype([*fields, ("sh", sh, 3 * ((degree + 1) ** 2 - 1))])


def _read_section(
    path: Path, data: bytes, start: int, s: _Section, level: int, sh_range: tuple[float, float], degree: int
) -> tuple[Gaussians, int]:
    """The Gaussians of a section, its harmonics padded to `degree`, and the byte after it."""
    record = _record(level, s.degree)
    centres_at = start + 4 * s.partial_buckets
    rows_at = centres_at + s.bucket_bytes * s.buckets
    end = rows_at + s.capacity * record.itemsize
    if end > len(data):
        raise ValueError(
            f"{path}: a section promises {s.capacity} Gaussians of {record.itemsize} bytes up to byte {end}, got {len(data)} "
            "bytes; the file is truncated"
        )
    rows = np.frombuffer(data, record, s.size, rows_at)
    means = rows["means"].astype(np.float32)
    if level > 0 and s.size:
        lengths = np.frombuffer(data, "<u4", s.partial_buckets, start)
        if s.bucket_bytes != 12:
            raise ValueError(f"{path}: expected bucket centres of 12 bytes, got {s.bucket_bytes}; the file is damaged")
        centres = np.frombuffer(data, "<f4", 3 * s.buckets, centres_at).reshape(-1, 3)
        quantum = s.quantum or 32767
        with np.errstate(over="ignore", invalid="ignore"):  # overflow is left out
            offsets = (means - quantum) * np.float32(s.block_size / 2 / quantum)
            means = offsets.astype(np.float64) + centres[_buckets(path, s, lengths)]
    scales, quats = rows["scales"].astype(np.float32), rows["quats"].astype(np.float32)
    sh = rows["sh"].astype(np.float32)
    if level == 2:
        sh = np.float32(sh_range[0]) + sh * np.float32((sh_range[1] - sh_range[0]) / 255)
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32)) / 255
    rest = np.zeros((s.size, (degree + 1) ** 2 - 1, 3), np.float32)
    for first, last in ((0, 3), (3, 8))[: s.degree if s.size else 0]:  # the degree of an empty section has no meaning
        rest[:, first:last] = sh[:, 3 * first : 3 * last].reshape(s.size, 3, last - first).transpose(0, 2, 1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), np.float32(1e-12))),
        scales=positive_scales(path, scales),
        opacities=rgba[:, 3].contiguous(),
        sh=torch.cat([((rgba[:, :3] - 0.5) / SH_C0)[:, None], torch.from_numpy(rest)], 1),
    )
    return gaussians, end


def _buckets(path: Path, s: _Section, lengths: NDArray[np.uint32]) -> NDArray[np.int64]:  # [count]
    """The bucket of each Gaussian: full ones first, then partly filled ones of the lengths given."""
    full = s.full_buckets * s.bucket_size
    if s.full_buckets + s.partial_buckets > s.buckets or full + int(lengths.sum(dtype=np.int64)) < s.size:
        raise ValueError(
            f"{path}: expected {s.buckets} buckets for {s.size} Gaussians, got {s.full_buckets} of {s.bucket_size} and "
            f"{s.partial_buckets} of {int(lengths.sum(dtype=np.int64))} together; the file is damaged"
        )
    row = np.arange(s.size)
    ends = full + np.cumsum(lengths, dtype=np.int64)
    partial = s.full_buckets + np.searchsorted(ends, row, side="right")
    return np.where(row < full, row // max(s.bucket_size, 1), partial)
