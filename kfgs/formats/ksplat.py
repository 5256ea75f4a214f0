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
_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = struct.Struct("<BB2xI8xIH14xff")  # version, sections, Gaussians, level of compression, range of harmonics
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_MAX_DEGREE = 2
_SH_RANGE = (-1.5, 1.5)  # of level 2, if the header gives none


class _Section(NamedTuple):
    size: int  # Gaussians in it
    capacity: int  # Gaussians for which there is room
    bucket_size: int  # Gaussians in a full bucket
    buckets: int
    block_size: float  # world units along a bucket
    bucket_bytes: int
    quantum: int  # steps in half a block
    full_buckets: int
    partial_buckets: int
    degree: int


def read(path: Path) -> Gaussians:
    """Read a .ksplat file of compression level 0, 1 or 2 and harmonics of degree 0 to 2."""
    data = path.read_bytes()
    major, minor, count, promised, level, low, high = _HEADER.unpack_from(data)
    if major != 0 or minor < 1 or level > 2:
        raise ValueError(f"version {major}.{minor}, level {level}; expected 0.1 or later, and level 0 to 2")
    sh_range = (low, high) if low < high and np.isfinite([low, high]).all() else _SH_RANGE
    start = _HEADER_BYTES + count * _SECTION_BYTES
    if start > len(data):
        raise ValueError(f"{count} sections are promised in {len(data)} bytes: it is truncated")
    sections = [_Section(*_SECTION.unpack_from(data, at)) for at in range(_HEADER_BYTES, start, _SECTION_BYTES)]
    degree, parts = max((s.degree for s in sections if s.size), default=0), list[Gaussians]()
    for section in sections:
        if section.size > section.capacity or section.degree > _MAX_DEGREE:
            raise ValueError(
                f"a section has {section.size} Gaussians of degree {section.degree}; expected at most {section.capacity} "
                f"of degree 0 to {_MAX_DEGREE}"
            )
        part, start = _read_section(data, start, section, level, sh_range, degree)
        parts.append(part)
    size = sum(map(len, parts))
    if size != promised or start != len(data) or not parts:
        raise ValueError(f"expected {promised} Gaussians in {len(data)} bytes, got {size} in {start}")
    return Gaussians.cat(parts)


def _read_section(
    data: bytes, start: int, s: _Section, level: int, sh_range: tuple[float, float], degree: int
) -> tuple[Gaussians, int]:
    """The Gaussians of a section, its harmonics padded to `degree`, and the byte after it."""
    wide, sh_type = {0: ("<f4", "<f4"), 1: ("<f2", "<f2"), 2: ("<f2", "u1")}[level]
    fields = [("means", "<u2" if level else "<f4", 3), ("scales", wide, 3), ("quats", wide, 4), ("rgba", "u1", 4)]
    record = np.dtype([*fields, ("sh", sh_type, 3 * ((s.degree + 1) ** 2 - 1))])
    centres_at = start + 4 * s.partial_buckets
    rows_at = centres_at + s.bucket_bytes * s.buckets
    end = rows_at + s.capacity * record.itemsize
    if end > len(data):
        room = f"{s.capacity} Gaussians, to byte {end} of {len(data)}"
        raise ValueError(f"a section has room for {room}: it is truncated")
    rows = np.frombuffer(data, record, s.size, rows_at)
    means = rows["means"].astype(np.float32)
    if level > 0 and s.size:
        lengths = np.frombuffer(data, "<u4", s.partial_buckets, start)
        if s.bucket_bytes != 12:
            raise ValueError(f"a bucket's centre has {s.bucket_bytes} bytes, not 12")
        centres = np.frombuffer(data, "<f4", 3 * s.buckets, centres_at).reshape(-1, 3)
        quantum = s.quantum or 32767
        with np.errstate(over="ignore", invalid="ignore"):  # overflow is left out
            offsets = (means - quantum) * np.float32(s.block_size / 2 / quantum)
            means = offsets.astype(np.float64) + centres[_buckets(s, lengths)]
    quats, sh = rows["quats"].astype(np.float32), rows["sh"].astype(np.float32)
    if level == 2:
        sh = np.float32(sh_range[0]) + sh * np.float32((sh_range[1] - sh_range[0]) / 255)
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32)) / 255
    rest = np.zeros((s.size, (degree + 1) ** 2 - 1, 3), np.float32)
    for first, last in ((0, 3), (3, 8))[: s.degree if s.size else 0]:  # the degree of an empty section has no meaning
        rest[:, first:last] = sh[:, 3 * first : 3 * last].reshape(s.size, 3, last - first).transpose(0, 2, 1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), np.float32(1e-12))),
        scales=positive_scales(rows["scales"].astype(np.float32)),
        opacities=rgba[:, 3].contiguous(),
        sh=torch.cat([((rgba[:, :3] - 0.5) / SH_C0)[:, None], torch.from_numpy(rest)], 1),
    )
    return gaussians, end


def _buckets(s: _Section, lengths: NDArray[np.uint32]) -> NDArray[np.int64]:  # [size]
    """The bucket of each Gaussian: full ones first, then partly filled ones of the lengths given."""
    full, partial = s.full_buckets * s.bucket_size, int(lengths.sum(dtype=np.int64))
    if s.full_buckets + s.partial_buckets > s.buckets or full + partial < s.size:
        raise ValueError(f"{s.size} Gaussians do not fit into {full} + {partial} places of {s.buckets} buckets")
    row = np.arange(s.size)
    ends = full + np.cumsum(lengths, dtype=np.int64)
    own = s.full_buckets + np.searchsorted(ends, row, side="right")
    return np.where(row < full, row // max(s.bucket_size, 1), own)
