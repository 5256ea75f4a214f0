"""Round the tensors of a field to whole steps and compress them: 0.6 MB for 50,000 Gaussians.

A tensor becomes an *entry* (its coding, shape and numbers, as JSON) and a stream of bytes. Means are steps along a Morton curve.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
import zstandard
from scipy.spatial.transform import Rotation
from torch import Tensor

from .._arrays import Array, most_unpacked
from .._check import check_choice, check_range
from ..formats.encodings import morton_cells, morton_codes
from ..formats.values import unit_quats

Entry = dict[str, Any]
LEVEL = 19  # of zstd: the best compression that takes only seconds
LARGEST = 1 << 22  # most steps from zero: they stay exact in float32
CELLS = (1 << 21) - 1  # most steps along an axis: three fill a Morton code
HUGE = 1e37  # largest number that is rounded: a step away from it, float32 does not overflow yet
EDGE = 1e-4  # unpacked opacities keep this distance from 0 and 1, as everywhere in kfgs
TURN = 2.1
"""Radians of a rotation per step of its x, y and z. Half a step of each moves (x, y, z) by sqrt(3) / 2 steps and w, which is at
least 0.85 after `_nearest_turn`, by 0.61 times as much: the quaternion by 1.02 steps, the rotation by twice that."""
QR_MOST = 1 << 31
"""Most rows x columns^2 of a basis that is rounded: its QR decomposition takes a second."""
PER_GAUSSIAN = ("gaussians.", "fused.latents")


@dataclass(frozen=True)
class Rounding:
    """The errors that packing may make. The file states the bound of each attribute in its own units."""

    means: float
    """Of each coordinate, as a share of the median radius of the cloud's Gaussians."""
    scales: float
    """Share of a scale, plus the same share of twice the largest error of a coordinate. Thinner Gaussians look no different."""
    degrees: float
    """Angle between a rotation and its stored one. Axes may change their order: the ellipsoid is the same."""
    opacities: float
    """Of an opacity."""
    latents: float
    """Root mean square error of a fused latent, as a share of the median length. Trained latents get half of it."""
    decoder: float
    """Root mean square error of a row of basis, codebook or text table, as a share of the row. Weights of an
    autoencoder get a quarter: their errors add up from layer to layer."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(name, value, 0, 30 if name == "degrees" else 1, closed=(False, True))


FINE = Rounding(1 / 128, 0.02, 0.5, 1 / 512, 0.02, 0.004)
SMALL = Rounding(1 / 24, 0.08, 3.0, 1 / 40, 0.07, 0.02)
TINY = Rounding(1 / 8, 0.15, 8.0, 1 / 30, 0.2, 0.04)
PRECISIONS = {"fine": FINE, "small": SMALL, "tiny": TINY}
Precision = Literal["fine", "small", "tiny"] | Rounding


def pack(
    tensors: dict[str, Tensor], precision: Precision
) -> tuple[dict[str, Tensor], dict[str, Entry], dict[str, float]]:
    """Round and compress: streams (uint8), their entries, and the largest error of each tensor.

    Gaussians are sorted along a Morton curve. What has no coding (labels, cameras) stays exact. A ValueError names a tensor
    that cannot be rounded: a number is not finite or too large, an opacity lies outside [0, 1], or a scale is negative.
    """
    if isinstance(precision, str):
        check_choice("precision", precision, PRECISIONS)
    chosen = PRECISIONS[precision] if isinstance(precision, str) else precision
    arrays = {name: value.double().numpy() for name, value in tensors.items() if value.is_floating_point()}
    for name, numbers in arrays.items():
        low, high = {"gaussians.opacities": (0, 1), "gaussians.scales": (0, HUGE)}.get(name, (-HUGE, HUGE))
        if not (np.isfinite(numbers) & (numbers >= low) & (numbers <= high)).all():
            raise ValueError(
                f"{name}: expected finite numbers from {low:g} to {high:g} to round, got others; fit it again"
            )
    means, scales = arrays["gaussians.means"], arrays["gaussians.scales"]
    radius = float(np.median(np.sort(scales, axis=1)[:, 1:])) if len(means) else 1.0
    extent = float(np.ptp(means, axis=0).max()) if len(means) else 0.0
    step = max(2 * chosen.means * radius, extent / CELLS) or 1.0
    origin = means.min(0) if len(means) else np.zeros(3)
    cells = np.round((means - origin) / step).astype(np.int64)
    order = np.argsort(morton_codes(cells.astype(np.uint64)), kind="stable")
    cells = cells[order]
    quats = unit_quats(torch.from_numpy(arrays["gaussians.quats"])).numpy()
    arrays["gaussians.quats"], arrays["gaussians.scales"] = _nearest_turn(quats, scales)
    fused = "linear.basis" in tensors
    streams, entries, errors = dict[str, Tensor](), dict[str, Entry](), dict[str, float]()
    for name, value in tensors.items():
        rows = order if name.startswith(PER_GAUSSIAN) else slice(None)
        array = arrays[name][rows] if name in arrays else None
        if array is None or not array.size:
            entry, plain = _exact(value[rows])
        elif name == "gaussians.means":
            codes = morton_codes(cells.astype(np.uint64))
            entry = {"coding": "curve", "step": step, "origin": origin.tolist(), "error": step / 2}
            entry, plain = _planes(entry, np.diff(codes, prepend=np.uint64(0)).astype(np.int64)[:, None])
        else:
            entry, plain = _encode(name, array, chosen, step, fused) or _exact(value[rows])
        packed = zstandard.ZstdCompressor(level=LEVEL).compress(plain)
        shorter = len(packed) < len(plain)
        streams[name] = torch.from_numpy(np.frombuffer(packed if shorter else plain, np.uint8).copy())
        errors |= {name: entry.pop("error")} if "error" in entry else {}
        entries[name] = entry | {"shape": list(value.shape), "compressed": shorter}
    return streams, entries, errors


def unpack(streams: dict[str, Tensor], entries: dict[str, Entry]) -> dict[str, Tensor]:
    """The tensors of `pack`; a ValueError for what is damaged."""
    if set(entries) != set(streams):
        raise ValueError(f"expected a description of {sorted(streams)}, got {sorted(entries)!r:.200}")
    tensors = {name: _decode(entry, streams[name].numpy().tobytes()) for name, entry in entries.items()}
    if entries["gaussians.opacities"]["coding"] != "exact":
        tensors["gaussians.opacities"].clamp_(EDGE, 1 - EDGE)
    scales = entries["gaussians.scales"]
    if scales["coding"] != "exact":
        tensors["gaussians.scales"].clamp_min_(math.expm1(scales["step"] / 2) * scales["least"] / 2)
    return tensors


def _encode(name: str, array: Array, chosen: Rounding, step: float, fused: bool) -> tuple[Entry, bytes] | None:
    """One tensor of real numbers, for Gaussians in the order of the curve; None if it stays exact."""
    match name.split("."):
        case ["gaussians", "quats"]:
            turn = math.radians(chosen.degrees) / TURN
            return _planes({"coding": "turns", "step": turn, "error": chosen.degrees}, np.round(array[:, 1:] / turn))
        case ["gaussians", "scales"]:  # steps of log(1 + x / least): each x within a share of x + least
            size = 2 * math.log1p(chosen.scales)
            entry = {"coding": "logs", "step": size, "least": step, "error": chosen.scales}
            return _planes(entry, np.round(np.log1p(array / step) / size))
        case ["gaussians", "opacities"]:
            size = 2 * chosen.opacities
            return _planes({"coding": "steps", "step": size, "error": size / 2}, np.round(array[:, None] / size))
        case ["gaussians", "features"]:
            return _latents(array, chosen.latents if fused else chosen.latents / 2)
        case ["fused", "latents"]:
            return _latents(array, chosen.latents)
        case ["linear" | "fused", "basis"] if array.size * array.shape[1] <= QR_MOST:
            return _rows(array, chosen.decoder, "basis")
        case ["codebook", "codewords"] | ["classes", _]:
            return _rows(array, chosen.decoder)
        case ["autoencoder", _, _, "weight"]:
            return _rows(array, chosen.decoder / 4)
    return None


def _exact(value: Tensor) -> tuple[Entry, bytes]:
    rows = value.contiguous().reshape(-1)
    planes = rows.view(torch.uint8).reshape(-1, rows.element_size()).T.contiguous() if len(rows) else torch.zeros(0)
    return {"coding": "exact", "dtype": str(value.dtype).removeprefix("torch.")}, planes.numpy().tobytes()


def _planes(entry: Entry, whole: Array) -> tuple[Entry, bytes]:  # [n, c] whole numbers
    """Column by column, and in a column byte by byte, the lowest first."""
    whole = whole.astype(np.int64)
    reach = int(np.abs(whole).max(initial=0))
    width = next(size for size in (1, 2, 4, 8) if reach < 1 << (8 * size - 1))
    columns = np.ascontiguousarray(whole.T).astype(f"<i{width}").view(np.uint8).reshape(whole.shape[1], -1, width)
    return {**entry, "width": width}, columns.transpose(0, 2, 1).tobytes()


def _latents(values: Array, share: float) -> tuple[Entry, bytes]:  # [N, d]
    """Multiples of a step. No row becomes zero that was not."""
    lengths = np.linalg.norm(values, axis=1)
    known = lengths > 0
    typical = float(np.median(lengths[known])) if known.any() else 1.0
    step = max(share * typical * math.sqrt(12 / values.shape[1]), float(np.abs(values).max(initial=0)) / LARGEST)
    whole = np.round(values / step).astype(np.int64)
    lost = np.flatnonzero(known & ~whole.any(1))
    largest = np.abs(values[lost]).argmax(1)
    whole[lost, largest] = np.sign(values[lost, largest])
    return _planes({"coding": "steps", "step": step, "error": step if len(lost) else step / 2}, whole)


def _rows(values: Array, share: float, coding: str = "rows") -> tuple[Entry, bytes]:  # [K, D]
    """Each row has its own step, and holds multiples of it. The coding "basis" treats columns so."""
    values = values.T if coding == "basis" else values
    rms = np.sqrt(np.square(values).mean(1))
    steps = np.maximum(share * math.sqrt(12) * rms, np.abs(values).max(1) / LARGEST).astype("<f4")
    steps = np.where(steps > 0, steps, np.float32(1)).astype("<f4")
    entry, plain = _planes({"coding": coding, "error": share * math.sqrt(3)}, np.round(values / steps[:, None]))
    return entry, steps.tobytes() + plain


def _decode(entry: Entry, plain: bytes) -> Tensor:
    """The tensor of an entry and its stream; a ValueError if that would unpack to more than any packed tensor has."""
    if entry["compressed"]:
        size = zstandard.get_frame_parameters(plain).content_size
        if size > most_unpacked(len(plain)):
            raise ValueError(f"a stream of {len(plain)} bytes would unpack to {size}")
        plain = zstandard.ZstdDecompressor().decompress(plain, max_output_size=size)
    coding, shape = entry["coding"], tuple(entry["shape"])
    if coding == "exact":
        dtype = getattr(torch, entry["dtype"])
        planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
        whole = torch.from_numpy(np.array(planes.T, order="C")).reshape(-1)
        return (whole.view(dtype) if len(whole) else torch.zeros(0, dtype=dtype)).reshape(shape)
    rows, columns = shape[0], math.prod(shape[1:])
    if coding in ("rows", "basis"):
        rows, columns = (columns, rows) if coding == "basis" else (rows, columns)
        steps = np.frombuffer(plain, "<f4", rows)[:, None].astype(np.float64)
        values = _whole(plain[4 * rows :], entry, rows, columns) * steps
        if coding == "basis":  # rounded columns are not quite orthonormal: the nearest such, with their signs
            Q, R = np.linalg.qr(values.T)
            values = Q * np.sign(np.diagonal(R))
    elif coding == "curve":
        codes = np.cumsum(_whole(plain, entry, rows, 1)[:, 0].astype(np.uint64), dtype=np.uint64)
        values = np.array(entry["origin"], np.float64) + morton_cells(codes).astype(np.int64) * float(entry["step"])
    elif coding == "turns":
        small = _whole(plain, entry, rows, 3) * float(entry["step"])
        squares = np.square(small).sum(1, keepdims=True)
        small = small / np.sqrt(np.maximum(squares, 1))
        values = np.concatenate([np.sqrt(np.maximum(0, 1 - squares)), small], axis=1)
    elif coding in ("steps", "logs"):
        steps = _whole(plain, entry, rows, columns) * float(entry["step"])
        values = steps if coding == "steps" else np.expm1(np.clip(steps, 0, 700)) * float(entry["least"])
    else:
        raise ValueError(f"coding: expected one of kfgs, got {coding!r:.40}")
    return torch.from_numpy(np.ascontiguousarray(values.reshape(shape), dtype=np.float32))


def _whole(plain: bytes, entry: Entry, rows: int, columns: int) -> Array:  # [rows, columns] integers
    width = entry["width"]
    planes = np.frombuffer(plain, np.uint8).reshape(columns, width, rows).transpose(0, 2, 1)
    return np.ascontiguousarray(planes).view(f"<i{width}").reshape(columns, rows).T


def _nearest_turn(quats: Array, scales: Array) -> tuple[Array, Array]:  # [N, 4] of length 1, [N, 3]
    """The same ellipsoids with the rotation that is nearest to the identity: w > 0.85, and x, y and z within 0.39.

    R diag(s)^2 R^T does not change if R becomes R C and s is permuted likewise, for any of the 24 rotations C of a cube.
    """
    if not len(quats):
        return quats, scales
    group = Rotation.create_group("O")
    inverses = np.roll(group.inv().as_quat(), 1, axis=1)  # [24, 4] wxyz
    best = np.abs(quats @ inverses.T).argmax(1)  # half of the time of Rotation.reduce
    nearest = (Rotation.from_quat(np.roll(quats, -1, axis=1)) * group[best]).as_quat(canonical=True)
    axes = np.abs(group.as_matrix()).argmax(axis=1)[best]  # [N, 3]: the old axis that becomes axis 0, 1 and 2
    return np.roll(nearest, 1, axis=1), np.take_along_axis(scales, axes, axis=1)
