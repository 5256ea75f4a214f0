"""The compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, quantised between the bounds of every 256.

A file has three elements. `chunk` has one row per 256 Gaussians: bounds of their positions, natural logarithms of scale
and base colours. `vertex` has position and log scale in 11, 10 and 11 bits between these bounds; the rotation's three
smaller components in 10 bits each, and 2 bits for the index of the largest (w, x, y, z); colour and opacity in 8 bits
each. Fields begin at the high bit. `sh`, only with higher harmonics, has a byte for each, channel by channel, from -4 to
4 in steps of 1/32. Axes are those of the 3DGS PLY. Files of SuperSplat before version 2 have no colour bounds: their bytes
go from 0 to 1. Viewers check the elements and allow no labels, so labels go to a separate file.

**Why not a library**: gsply 0.4.6 truncates values instead of rounding, which doubles the errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..gaussians import Gaussians
from .encodings import pack_smallest_three, unpack_smallest_three
from .ply import Columns, read_header, read_ply_elements, write_ply_elements
from .render_mode import comments_of_mode, mode_from_comments, with_mode
from .values import SH_C0, describe_coarse, describe_cut, positive_scales, up_to_degree_3

NAME = "compressed_ply"
SUFFIXES = (".compressed.ply",)
MAGIC = b"ply"
HOLDS = frozenset({"harmonics", "antialiased"})
SORTS = True
CHUNK = 256  # Gaussians between shared bounds
LOG_SCALE_LIMIT = 20.0  # scales from e^-20 to e^20 world units, as other writers keep them
SH_LIMIT = 4.0  # largest higher coefficient
_AXES = (  # (columns of the minimum, of the maximum) of positions, log scales and colours
    (("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")),
    (("min_scale_x", "min_scale_y", "min_scale_z"), ("max_scale_x", "max_scale_y", "max_scale_z")),
    (("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")),
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_FIELDS = (11, 10, 11)  # bits of x, y and z
_STEPS = np.array([2047, 1023, 2047], np.float32)  # between the bounds of positions and log scales
_COLOR_STEPS = np.array([255, 255, 255], np.float32)
_ROUGH = 0.02  # error of a base colour that is seen, and reported: 5 of 255
_ROUNDING = 6 * 2.0**-24  # float32: of the bounds, their difference, the product and the sum

_Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]  # lowest and highest values of each chunk, [C, 3]


def matches(head: bytes) -> bool:
    """A PLY file whose header names chunks and packed positions."""
    header = head[: head.find(b"end_header")]
    return head.startswith(MAGIC) and b"element chunk" in header and b"packed_position" in header


def read(path: Path) -> Gaussians:
    """Read a compressed PLY file; opacities of 0 and 1 stay 0 and 1."""
    elements = read_ply_elements(path)
    chunk, vertex = (elements.get(name, {}) for name in ("chunk", "vertex"))
    position, rotation, scale, color = _columns("vertex", vertex, _PACKED, "uint32")
    n, chunks = len(position), len(next(iter(chunk.values()), ()))
    if chunks != -(-n // CHUNK):
        raise ValueError(f"expected {-(-n // CHUNK)} chunks for {n} Gaussians, {CHUNK} each, got {chunks}")
    rgba = _unpack(color, (8, 8, 8, 8)) / np.float32(255)
    has_colours = any(name in chunk for side in _AXES[2] for name in side)  # older files have no bounds of colours
    rgb = _between(_read_bounds(chunk, 2), rgba[:, :3]) if has_colours else rgba[:, :3]
    sh = np.concatenate([((rgb - 0.5) / np.float32(SH_C0))[:, None], _read_rest(elements.get("sh", {}), n)], 1)
    largest, *small = _unpack(rotation, (2, 10, 10, 10)).T
    with np.errstate(over="ignore"):  # left out
        scales = np.exp(_between(_read_bounds(chunk, 1), _unpack(scale, _FIELDS) / _STEPS))
    gaussians = Gaussians(
        means=torch.from_numpy(_between(_read_bounds(chunk, 0), _unpack(position, _FIELDS) / _STEPS)),
        quats=unpack_smallest_three(largest.astype(np.int64), np.stack(small, 1), 1023),
        scales=positive_scales(scales),
        opacities=torch.from_numpy(rgba[:, 3].copy()),
        sh=up_to_degree_3(path, torch.from_numpy(sh)),
    )
    return with_mode(path, gaussians, mode_from_comments(read_header(path).comments))


def write(path: Path, g: Gaussians) -> list[str]:
    """Write a compressed PLY file in the given order; precision is best if each 256 Gaussians lie close together."""
    assert g.sh is not None
    log_scales = g.scales.log().clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).numpy()
    means, rgb = g.means.numpy(), (g.sh[:, 0] * SH_C0 + 0.5).numpy()
    chunk: Columns = {}
    steps = []
    for axes, values, count in zip(_AXES, (means, log_scales, rgb), (_STEPS, _STEPS, _COLOR_STEPS), strict=True):
        bounds = _chunk_bounds(values)
        steps.append(np.round(_place_between(bounds, values) * count).astype(np.uint32))
        for names, bound in zip(axes, bounds, strict=True):
            chunk |= {name: np.ascontiguousarray(bound[:, i]) for i, name in enumerate(names)}
    opacity = np.round(np.clip(g.opacities.numpy(), 0, 1) * 255).astype(np.uint32)
    rotations = np.concatenate(pack_smallest_three(g.quats, 1023), 1).astype(np.uint32)
    vertex = {
        "packed_position": _pack(steps[0], _FIELDS),
        "packed_rotation": _pack(rotations, (2, 10, 10, 10)),
        "packed_scale": _pack(steps[1], _FIELDS),
        "packed_color": _pack(np.concatenate([steps[2], opacity[:, None]], 1), (8, 8, 8, 8)),
    }
    elements = {"chunk": chunk, "vertex": vertex}
    if g.sh.shape[1] > 1:
        rest = g.sh[:, 1:].transpose(1, 2).flatten(1).numpy()  # channel by channel
        steps_of_rest = np.clip(np.floor((rest / (2 * SH_LIMIT) + 0.5) * 256), 0, 255).astype(np.uint8)
        elements["sh"] = {f"f_rest_{i}": np.ascontiguousarray(column) for i, column in enumerate(steps_of_rest.T)}
    write_ply_elements(path, elements, comments=("written by kfgs", *comments_of_mode(g)))
    lost = describe_coarse(g, half_steps(means, _STEPS), ".compressed.ply")
    lost += describe_cut(g.scales.log(), -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT, "scales", ".compressed.ply")
    lost += describe_cut(g.sh[:, 1:], -SH_LIMIT, SH_LIMIT, "higher harmonics", ".compressed.ply")
    errors = half_steps(rgb, _COLOR_STEPS)
    if rough := int((errors > _ROUGH).any(1).sum()):
        lost.append(
            f"base colours of {rough:,} Gaussians, by up to {errors.max():.3g} (1 is white): others near them have colours "
            "far outside 0 to 1"
        )
    return lost


def half_steps(values: NDArray[np.float64], steps: NDArray[np.float32]) -> NDArray[np.float64]:  # [N, 3]
    """The largest error of each value in even `steps` between the bounds of its chunk."""
    low, high = _chunk_bounds(values)
    largest = np.maximum(np.abs(low), np.abs(high)).astype(np.float64)
    half = (high.astype(np.float64) - low) / steps / 2
    return (half + largest * _ROUNDING)[np.arange(len(values)) // CHUNK]


def _chunk_bounds(values: NDArray[np.float64]) -> _Bounds:  # [N, 3]
    """Minimum and maximum of each 256 values as float32 (rounded, so a value may lie half a bit outside)."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    least, largest = (extreme.reduceat(values, starts, axis=0) for extreme in (np.minimum, np.maximum))
    return least.astype(np.float32), largest.astype(np.float32)


def _place_between(bounds: _Bounds, values: NDArray[np.float64]) -> NDArray[np.float64]:  # [N, 3] in [0, 1]
    chunk = np.arange(len(values)) // CHUNK
    low, high = (bound.astype(np.float64) for bound in bounds)
    size = np.where(high > low, high - low, 1.0)
    return np.clip((values - low[chunk]) / size[chunk], 0, 1)


def _between(bounds: _Bounds, fraction: NDArray[np.float32]) -> NDArray[np.float32]:  # [N, 3]
    """The inverse of `_place_between`."""
    chunk = np.arange(len(fraction)) // CHUNK
    with np.errstate(over="ignore", invalid="ignore"):  # left out
        return bounds[0][chunk] + fraction * (bounds[1] - bounds[0])[chunk]


def _pack(fields: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.uint32]:  # [N, F] -> [N]
    """Put whole numbers next to each other, the first at the high end."""
    packed = np.zeros(len(fields), np.uint32)
    for i, width in enumerate(bits):
        packed = packed << np.uint32(width) | fields[:, i]
    return packed


def _unpack(packed: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float32]:  # [N] -> [N, F]
    """The inverse of `_pack`."""
    shifts = [sum(bits[i + 1 :]) for i in range(len(bits))]
    fields = [packed >> np.uint32(shift) & np.uint32(2**width - 1) for shift, width in zip(shifts, bits, strict=True)]
    return np.stack(fields, 1).astype(np.float32)


def _read_rest(columns: Columns, n: int) -> NDArray[np.float32]:  # [n, K - 1, 3]
    """The higher harmonics; the outermost bytes mean the ends of the range, the others the middles of their steps."""
    if not columns:
        return np.zeros((n, 0, 3), np.float32)
    values = np.stack(_columns("sh", columns, [f"f_rest_{i}" for i in range(len(columns))], "uint8"), 1)
    if values.shape not in [(n, width) for width in (9, 24, 45, 72)]:
        raise ValueError(f"expected 9, 24, 45 or 72 columns of {n} rows in 'sh', got {values.shape[::-1]}")
    table = (((np.arange(256) + 0.5) / 256 - 0.5) * 2 * SH_LIMIT).astype(np.float32)
    table[0], table[255] = -SH_LIMIT, SH_LIMIT
    return table[values].reshape(n, 3, len(columns) // 3).transpose(0, 2, 1)


def _read_bounds(chunk: Columns, group: int) -> _Bounds:
    low, high = (np.stack(_columns("chunk", chunk, names, "float32"), 1) for names in _AXES[group])
    return low, high


def _columns(element: str, columns: Columns, names: Sequence[str], kind: str) -> list[NDArray[Any]]:
    wrong = [name for name in names if name not in columns or columns[name].dtype.name != kind]
    if wrong:
        raise ValueError(f"expected {kind} {', '.join(wrong)} in {element!r}, got {', '.join(columns)!r:.80}")
    return [columns[name] for name in names]
