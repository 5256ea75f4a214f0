"""Convert SPZ's quantised bytes to Gaussians and back.

positions: 24-bit fixed point (float16 in version 1); alphas: 255 steps of opacity; colors: 255 steps of f_dc from -0.5/0.15
to 0.5/0.15; scales: ln(s) = byte / 16 - 10; rotations: the three smaller of x, y, z, w, 9 bits and a sign each (x, y, z as
bytes before version 3); sh: (byte - 128) / 128, coefficient by coefficient, red, green and blue together.

**Convention**: SPZ's own axes are x right, y up, z back (RUB) against x right, y down, z forward (RDF) of the 3DGS PLY.
"""

from __future__ import annotations

from math import exp, floor, log2, sqrt

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..gaussians import Gaussians
from .smallest_three import join_largest, split_largest
from .spz_streams import MAX_FRACTIONAL_BITS, Container
from .values import UP_AND_BACK, Precision, byte_error, flip_axes, unit_quats

Bytes = NDArray[np.uint8]
DC = 0.5 / 0.15  # the degree-0 coefficient of byte 255
LOG_SCALES = (-10.0, 255 / 16 - 10)
_MAX_FIXED = (1 << 23) - 1
_COMMON_BITS, _STEPS = 12, 14  # bits that every writer uses; a small cloud gets 2^14 steps across


def unpack(c: Container, axes: tuple[int, int, int] = UP_AND_BACK) -> Gaussians:
    """The Gaussians of a container, in the axes of the 3DGS PLY; harmonics of degree 4 are left out."""
    means = _unpack_positions(c)
    quats = _unpack_xyz(c.streams["rotations"]) if c.version < 3 else _unpack_smallest_three(c.streams["rotations"])
    kept = (min(c.degree, 3) + 1) ** 2 - 1
    coefficients = c.streams["sh"].reshape(c.count, (c.degree + 1) ** 2 - 1, 3)[:, :kept]
    base = (_floats(c.streams["colors"]) / 255 - 0.5) / 0.15
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        scales=torch.from_numpy(_floats(c.streams["scales"]) / 16 - 10).view(-1, 3).exp(),
        opacities=torch.from_numpy(_floats(c.streams["alphas"]) / 255),
        sh=torch.cat([torch.from_numpy(base).view(-1, 1, 3), (torch.from_numpy(_floats(coefficients)) - 128) / 128], 1),
    )
    return flip_axes(gaussians, axes)


def pack(g: Gaussians, version: int, fractional_bits: int, sh_bits: tuple[int, int]) -> dict[str, Bytes]:
    """The streams of a cloud (float64, axes of the PLY), for version 2, 3 or 4."""
    g = flip_axes(g, UP_AND_BACK)
    assert g.sh is not None
    fixed = (g.means * 2**fractional_bits).round().to(torch.int32).numpy()
    low, high = LOG_SCALES
    quats = unit_quats(g.quats).numpy()
    rest = g.sh[:, 1:] * 128 + 128
    for part, bits in ((rest[:, :3], sh_bits[0]), (rest[:, 3:], sh_bits[1])):
        bucket = 2 ** (8 - bits)  # steps of a byte that become one
        part.copy_((part / bucket + 0.5).floor().mul(bucket).clamp(0, 256 - bucket))
    return {
        "positions": np.ascontiguousarray(fixed.astype("<i4")[..., None].view(np.uint8)[..., :3]).reshape(-1),
        "alphas": _bytes(g.opacities * 255),
        "colors": _bytes(g.sh[:, 0] * (0.15 * 255) + 127.5),
        "scales": _bytes((g.scales.log().clamp(low, high) + 10) * 16),
        "rotations": _pack_xyz(quats) if version < 3 else _pack_smallest_three(quats),
        "sh": _bytes(rest),
    }


def choose_fractional_bits(means: Tensor) -> int:  # means: [N, 3]
    """The bits after the point for a cloud's extent: usually 12, fewer beyond 2048 units from the origin, more within 2."""
    reach = means.abs().max().item() if len(means) else 0.0
    if reach == 0.0:
        return _COMMON_BITS
    wanted = min(max(_COMMON_BITS, _STEPS - floor(log2(reach))), 20)
    return min(wanted, most_fractional_bits(means))


def most_fractional_bits(means: Tensor) -> int:  # means: [N, 3]
    """The most bits after the point with which every coordinate fits into 24 bits; negative if none fits."""
    reach = means.abs().max().item() if len(means) else 0.0
    return MAX_FRACTIONAL_BITS if reach == 0.0 else min(floor(log2(_MAX_FIXED / reach)), MAX_FRACTIONAL_BITS)


def precision_of(g: Gaussians, fractional_bits: int) -> Precision:
    """The precision of version 3 and 4 files for a cloud, including values that they cut off."""
    low, high = LOG_SCALES
    logs = g.scales.double().log()
    cut = (logs - logs.clamp(low, high)).abs().max().item() if len(g) else 0.0
    sh = torch.zeros(0, 1, 3) if g.sh is None else g.sh.double()
    return Precision(
        means=0.5 * 2.0**-fractional_bits * (1 + 1e-4) + 1e-6 * (g.means.abs().max().item() if len(g) else 0.0),
        scales=(exp(max(1 / 32, cut)) - 1) * (1 + 1e-5) + 1e-4,  # float32, of what is cut off far too
        rotation=0.005,  # 2 x sqrt(3 + 3^2) half steps of sqrt(0.5) / 511: the largest component makes up for the others
        opacities=0.5 / 255 + 1e-6,
        sh0=byte_error(sh[:, :1], -DC, DC),
        sh_rest=byte_error(sh[:, 1:], -1.0, 127 / 128) + 1e-5,
    )


def _floats(values: Bytes) -> NDArray[np.float32]:
    return values.astype(np.float32)


def _bytes(values: Tensor) -> Bytes:
    return values.round().clamp(0, 255).to(torch.uint8).numpy().reshape(-1)


def _unpack_positions(c: Container) -> NDArray[np.float32]:  # [N, 3]
    stream = c.streams["positions"]
    if c.version == 1:
        return stream.view("<f2").astype(np.float32).reshape(-1, 3)
    wide = np.zeros((c.count, 3, 4), np.uint8)
    wide[..., 1:] = stream.reshape(c.count, 3, 3)  # the upper three bytes of an int32: the shift back keeps the sign
    fixed = (wide.view("<i4")[..., 0] >> 8).astype(np.float32)
    return fixed * np.float32(2.0**-c.fractional_bits)


def _unpack_xyz(stream: Bytes) -> NDArray[np.float32]:  # [N, 4] wxyz
    xyz = _floats(stream).reshape(-1, 3) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1)


def _pack_xyz(quats: NDArray[np.float64]) -> Bytes:  # quats: [N, 4] wxyz, unit
    xyz = np.where(quats[:, :1] < 0, -quats[:, 1:], quats[:, 1:])
    return np.clip(np.round(xyz * 127.5 + 127.5), 0, 255).astype(np.uint8).reshape(-1)


def _unpack_smallest_three(stream: Bytes) -> NDArray[np.float32]:  # [N, 4] wxyz
    """Bits 30-31 name the largest of x, y, z, w; the other three follow in order, the last one in the lowest 10 bits."""
    word = stream.view("<u4").astype(np.uint32)
    largest = (word >> 30).astype(np.int64)
    values = np.stack([(word >> shift) & 0x3FF for shift in (20, 10, 0)], 1)  # [N, 3]
    small = (values & 0x1FF).astype(np.float32) * np.float32(sqrt(0.5) / 511)
    small = np.where(values & 0x200, -small, small)
    return join_largest(largest, small)[:, [3, 0, 1, 2]]


def _pack_smallest_three(quats: NDArray[np.float64]) -> Bytes:  # quats: [N, 4] wxyz, unit
    largest, small = split_largest(quats[:, [1, 2, 3, 0]])
    sizes = np.minimum(np.round(np.abs(small) * (511 / sqrt(0.5))), 511).astype(np.uint32)
    values = sizes | np.where(small < 0, 0x200, 0).astype(np.uint32)
    word = (largest.astype(np.uint32) << 30) | (values[:, 0] << 20) | (values[:, 1] << 10) | values[:, 2]
    return word.astype("<u4").view(np.uint8)
