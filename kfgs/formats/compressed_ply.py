"""The compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, quantised between the bounds of every 256.

A file has three elements. `chunk` has one row per 256 Gaussians: bounds of their positions, natural logarithms of scale
and base colours. `vertex` has position and log scale in 11, 10 and 11 bits between these bounds; the rotation's three
smaller components in 10 bits each, and 2 bits for the index of the largest (w, x, y, z); colour and opacity in 8 bits
each. Fields begin at the high bit. `sh`, only with higher harmonics, has a byte for each, channel by channel, from -4 to
4 in steps of 1/32. Axes are those of the 3DGS PLY. Files of SuperSplat before version 2 have no colour bounds: their bytes
go from 0 to 1. Viewers check the elements and allow no labels, so labels go to a separate file.

**Why not a library**: gsply 0.4.6 truncates values instead of rounding, which doubles the errors, and reads opacities of 0
and 1 as logits of -10 and 10. The tests use it as an independent reader and writer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._notes import tell
from ..gaussians import Gaussians
from .encodings import pack_smallest_three, unpack_smallest_three
from .ply import Columns, read_comments, read_ply_elements, write_ply_elements
from .render_mode import comments_of_mode, mode_from_comments, with_mode
from .values import NO_DEGREE_4, SH_C0, colours_to_write, describe_coarse, describe_loss, positive_scales

NAME = "compressed_ply"
SUFFIXES = (".compressed.ply",)
MAGIC = b"ply"
HOLDS_LABELS = False
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
_ALL_STEPS = (_STEPS, _STEPS, _COLOR_STEPS)
_ROUGH = 0.02  # error of a base colour that is seen, and reported: 5 of 255
_ROUNDING = 6 * 2.0**-24  # float32: of the bounds, their difference, the product and the sum


_Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]  # lowest and highest values of each chunk, [C, 3]


def matches(head: bytes) -> bool:
    """A PLY file whose header names chunks and packed positions."""
    header = head[: head.find(b"end_header")]
    return head.startswith(MAGIC) and b"element chunk" in header and b"packed_position" in header


def read(path: Path) -> Gaussians:
    """Read a compressed PLY file with harmonics of degree 0 to 4 (4 is dropped); opacities of 0 and 1 stay 0 and 1.

    Raises:
        ValueError: if it is truncated, or elements or columns are missing or disagree.
    """
    elements = read_ply_elements(path)
    chunk, vertex = (elements.get(name, {}) for name in ("chunk", "vertex"))
    _check_columns(path, "vertex", vertex, _PACKED, "uint32")
    n, chunks = len(vertex[_PACKED[0]]), len(next(iter(chunk.values()), ()))
    if chunks != -(-n // CHUNK):
        raise ValueError(
            f"{path}: expected {-(-n // CHUNK)} chunks for {n} Gaussians, {CHUNK} each, got {chunks}; the file is damaged"
        )
    extents, sizes = _read_bounds(path, chunk, _AXES[0]), _read_bounds(path, chunk, _AXES[1])
    has_colours = any(name in chunk for side in _AXES[2] for name in side)  # older files have no bounds of colours
    positions = _between(extents, _unpack_vectors(vertex["packed_position"]))
    log_scales = _between(sizes, _unpack_vectors(vertex["packed_scale"]))
    rgba = (vertex["packed_color"][:, None] >> np.array([24, 16, 8, 0], np.uint32) & 255).astype(
        np.float32
    ) / np.float32(255)
    rgb = _between(_read_bounds(path, chunk, _AXES[2]), rgba[:, :3]) if has_colours else rgba[:, :3]
    sh0 = (rgb - 0.5) / np.float32(SH_C0)
    sh = np.concatenate([sh0[:, None], _read_rest(path, elements.get("sh"), n)], 1)
    with np.errstate(over="ignore"):  # left out
        scales = np.exp(log_scales)
    gaussians = Gaussians(
        means=torch.from_numpy(positions),
        quats=_unpack_rotations(vertex["packed_rotation"]),
        scales=positive_scales(path, scales),
        opacities=torch.from_numpy(rgba[:, 3].copy()),
        sh=torch.from_numpy(sh[:, :16]),
    )
    if sh.shape[1] > 16:
        tell(f"{path.name}: {NO_DEGREE_4}")
    return with_mode(path, gaussians, mode_from_comments(read_comments(path)))


def write(path: Path, gaussians: Gaussians) -> tuple[str, ...]:
    """Write a compressed PLY file in the given order; precision is best if each 256 Gaussians lie close together.

    Raises:
        ValueError: if the cloud has no colours.
    """
    g = colours_to_write(gaussians, ".compressed.ply")
    assert g.sh is not None
    values = _quantities(g)
    bounds = [_chunk_bounds(value) for value in values]
    chunk = {
        name: column
        for axes, bound in zip(_AXES, bounds, strict=True)
        for names, table in zip(axes, bound, strict=True)
        for name, column in zip(names, np.ascontiguousarray(table.T), strict=True)
    }
    steps = [
        np.round(_position_between(bound, value) * count).astype(np.uint32)
        for bound, value, count in zip(bounds, values, _ALL_STEPS, strict=True)
    ]
    opacity = np.round(np.clip(g.opacities.numpy(), 0, 1) * 255)
    rgba = np.concatenate([steps[2], opacity[:, None].astype(np.uint32)], 1)
    rotations = np.concatenate(pack_smallest_three(g.quats, 1023), 1).astype(np.uint32)
    vertex = {
        "packed_position": _pack(steps[0], _FIELDS),
        "packed_rotation": _pack(rotations, (2, 10, 10, 10)),
        "packed_scale": _pack(steps[1], _FIELDS),
        "packed_color": _pack(rgba, (8, 8, 8, 8)),
    }
    elements = {"chunk": chunk, "vertex": vertex}
    if g.sh.shape[1] > 1:
        rest = g.sh[:, 1:].transpose(1, 2).flatten(1).numpy()  # channel by channel
        steps_of_rest = np.clip(np.floor((rest / (2 * SH_LIMIT) + 0.5) * 256), 0, 255).astype(np.uint8)
        elements["sh"] = {f"f_rest_{i}": np.ascontiguousarray(column) for i, column in enumerate(steps_of_rest.T)}
    write_ply_elements(path, elements, comments=("written by kfgs", *comments_of_mode(gaussians)))
    return (
        describe_loss(gaussians, ".compressed.ply", 3)
        + describe_coarse(g, half_steps(values[0], _STEPS), ".compressed.ply")
        + _words_of_clipping(g, half_steps(values[2], _COLOR_STEPS))
    )


def _quantities(g: Gaussians) -> tuple[NDArray[np.float64], ...]:  # 3 x [N, 3]
    """The values stored between bounds: positions, logarithms of scales, base colours."""
    assert g.sh is not None
    log_scales = g.scales.log().clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    return g.means.numpy(), log_scales.numpy(), (g.sh[:, 0] * SH_C0 + 0.5).numpy()


def _chunk_bounds(values: NDArray[np.float64]) -> _Bounds:  # [N, 3]
    """Minimum and maximum of each 256 values as float32 (rounded, so a value may lie half a bit outside)."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    least, largest = (extreme.reduceat(values, starts, axis=0) for extreme in (np.minimum, np.maximum))
    return least.astype(np.float32), largest.astype(np.float32)


def _position_between(bounds: _Bounds, values: NDArray[np.float64]) -> NDArray[np.float64]:  # [N, 3] in [0, 1]
    chunk = np.arange(len(values)) // CHUNK
    low, high = (bound.astype(np.float64) for bound in bounds)
    size = np.where(high > low, high - low, 1.0)
    return np.clip((values - low[chunk]) / size[chunk], 0, 1)


def _between(bounds: _Bounds, fraction: NDArray[np.float32]) -> NDArray[np.float32]:  # [N, 3]
    chunk = np.arange(len(fraction)) // CHUNK
    with np.errstate(over="ignore", invalid="ignore"):  # left out
        return bounds[0][chunk] + fraction * (bounds[1] - bounds[0])[chunk]


def half_steps(values: NDArray[np.float64], steps: NDArray[np.float32]) -> NDArray[np.float64]:  # [N, 3]
    """The largest error of each value in even `steps` between the bounds of its chunk."""
    low, high = _chunk_bounds(values)
    chunk = np.arange(len(values)) // CHUNK
    largest = np.maximum(np.abs(low), np.abs(high)).astype(np.float64)
    half = (high.astype(np.float64) - low) / steps / 2
    return (half + largest * _ROUNDING)[chunk]


def _pack(fields: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.uint32]:  # [N, F] -> [N]
    """Put whole numbers side by side, the first at the high end."""
    packed = np.zeros(len(fields), np.uint32)
    for i, width in enumerate(bits):
        packed = packed << np.uint32(width) | fields[:, i]
    return packed


def _unpack_vectors(packed: NDArray[np.uint32]) -> NDArray[np.float32]:  # [N] -> [N, 3]
    """Fractions of the way from the least value to the largest."""
    whole = packed[:, None] >> np.array([21, 11, 0], np.uint32) & _STEPS.astype(np.uint32)
    return whole.astype(np.float32) / _STEPS


def _unpack_rotations(packed: NDArray[np.uint32]) -> Tensor:  # [N] -> [N, 4] wxyz
    small = (packed[:, None] >> np.array([20, 10, 0], np.uint32) & 1023).astype(np.float32)
    return unpack_smallest_three((packed >> np.uint32(30)).astype(np.int64), small, 1023)


def _read_rest(path: Path, columns: Columns | None, n: int) -> NDArray[np.float32]:  # [N, K - 1, 3]
    """The higher harmonics; the outermost bytes mean the ends of the range, the others the middles of their steps."""
    if columns is None:
        return np.zeros((n, 0, 3), np.float32)
    names = [f"f_rest_{i}" for i in range(len(columns))]
    kinds = {(column.dtype.name, len(column)) for column in columns.values()}
    if len(names) not in (9, 24, 45, 72) or set(names) != set(columns) or kinds != {("uint8", n)}:
        raise ValueError(
            f"{path}: expected 'sh' of 9, 24, 45 or 72 columns f_rest_0, f_rest_1, ... of {n} bytes each, got {len(names)} "
            f"columns of {kinds!r:.80}; write the file again"
        )
    table = (((np.arange(256) + 0.5) / 256 - 0.5) * 2 * SH_LIMIT).astype(np.float32)
    table[0], table[255] = -SH_LIMIT, SH_LIMIT
    return np.stack([table[columns[name]] for name in names], 1).reshape(n, 3, len(names) // 3).transpose(0, 2, 1)


def _read_bounds(path: Path, chunk: Columns, axes: tuple[tuple[str, ...], tuple[str, ...]]) -> _Bounds:
    _check_columns(path, "chunk", chunk, (*axes[0], *axes[1]), "float32")
    low, high = (np.stack([chunk[name] for name in side], 1) for side in axes)
    return low, high


def _check_columns(path: Path, element: str, columns: Columns, names: tuple[str, ...], kind: str) -> None:
    wrong = [name for name in names if name not in columns or columns[name].dtype.name != kind]
    if wrong:
        raise ValueError(
            f"{path}: expected {element!r} with {kind} {', '.join(names)}, {', '.join(wrong)} missing; write the file again"
        )


def _words_of_clipping(
    g: Gaussians, shades: NDArray[np.float64]
) -> tuple[str, ...]:  # shades: [N, 3], errors of colours
    """Describe the values that the fixed ranges cut off, and colours rounded because others of their chunk are far off."""
    assert g.sh is not None
    lost = []
    small = int((g.scales.log().abs() > LOG_SCALE_LIMIT).any(1).sum())
    if small:
        lost.append(f"scales of {small} Gaussians: .compressed.ply holds e^-20 to e^20")
    large = int((g.sh[:, 1:].abs() > SH_LIMIT).any(2).any(1).sum())
    if large:
        lost.append(f"strong higher harmonics of {large} Gaussians: .compressed.ply holds -4 to 4")
    rough = (shades > _ROUGH).any(1)
    if rough.any():
        lost.append(
            f"base colours of {int(rough.sum()):,} Gaussians, by up to {shades.max():.3g} (1 is white): others near them have "
            "colours far outside 0 to 1"
        )
    return tuple(lost)
