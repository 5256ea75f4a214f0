"""Turn one tensor of a field into bytes that compress well, and back: whole numbers of a step, split into planes of bytes.

A tensor becomes an *entry* (its coding, shape and numbers, as JSON) and its plain bytes. Means are steps along a Morton curve;
latents are differences to the nearest of the Gaussians that come shortly before on this curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._card import short_repr
from ..formats.order import morton_cells, morton_codes

Array = NDArray[Any]
Entry = dict[str, Any]
DTYPES = {
    str(one).removeprefix("torch."): one
    for one in (
        *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
        *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
    )
}
"""What a file can hold."""
LARGEST = 1 << 22
"""Most steps from zero: they stay exact in float32."""
CELLS = (1 << 21) - 1
"""Most steps along an axis: three fill a Morton code."""
WINDOW = 16
"""Predecessors on the curve that a latent is predicted from. 32 save 1 % more and take twice the time (measured on room_0)."""
TURN = 2.1
"""Radians of a rotation per step of its x, y and z. Half a step of each moves (x, y, z) by sqrt(3) / 2 steps and w, which is at
least 0.85 after `nearest_turn`, by 0.61 times as much: the quaternion by 1.02 steps, the rotation by twice that."""


QR_MOST = 1 << 31
"""Most rows x columns^2 of a basis that is rounded: its QR decomposition takes a second. 4,096 channels may have 724 latents."""


class Coded(NamedTuple):
    """A tensor for the file."""

    entry: Entry
    plain: bytes


class Place(NamedTuple):
    """Where the Gaussians are on the grid of the means; what is predicted from neighbours needs it."""

    cells: Array  # [N, 3] int64
    before: Array  # [N] int64: the row that each one is predicted from; N for none

    def __repr__(self) -> str:
        return short_repr(self)


def encode_exact(value: Tensor) -> Coded:
    """Bit for bit."""
    rows = value.detach().cpu().contiguous().reshape(-1)
    size = rows.element_size()
    plain = rows.view(torch.uint8).reshape(-1, size).T.contiguous().numpy().tobytes() if len(rows) else b""
    return Coded({"coding": "exact", "dtype": str(value.dtype).removeprefix("torch."), "error": 0.0}, plain)


def encode_means(means: Array, step: float) -> tuple[Coded, Place]:  # [N, 3], sorted by their Morton codes
    """The steps between Morton codes: after sorting, they hold little more than the set of positions."""
    origin = means.min(0) if len(means) else np.zeros(3)
    cells = np.round((means - origin) / step).astype(np.int64)
    codes = morton_codes(cells.astype(np.uint64))
    entry = {"coding": "curve", "step": step, "origin": origin.tolist(), "error": step / 2}
    return _planes(entry, np.diff(codes, prepend=np.uint64(0)).astype(np.int64)[:, None]), find_before(cells)


def encode_steps(values: Array, step: float) -> Coded:  # [N] or [N, d]
    """Multiples of a step; zero stays zero."""
    step = max(step, float(np.abs(values).max(initial=0)) / LARGEST)
    entry = {"coding": "steps", "step": step, "error": step / 2}
    return _planes(entry, np.round(values.reshape(len(values), -1) / step).astype(np.int64))


def encode_logs(values: Array, share: float, least: float) -> Coded:  # [N] or [N, 3], >= 0
    """Steps of log(1 + x / least): each x within a share of x + least."""
    step = 2 * math.log1p(share)
    whole = np.round(np.log1p(np.maximum(values.reshape(len(values), -1), 0) / least) / step).astype(np.int64)
    return _planes({"coding": "logs", "step": step, "least": least, "error": share}, whole)


def encode_turns(quats: Array, degrees: float) -> Coded:  # [N, 4], after `nearest_turn`
    """x, y and z of unit quaternions whose w is positive and the largest."""
    step = math.radians(degrees) / TURN
    return _planes({"coding": "turns", "step": step, "error": degrees}, np.round(quats[:, 1:] / step).astype(np.int64))


def encode_near(values: Array, share: float, place: Place) -> Coded:  # [N, d]
    """Multiples of a step, as differences to the row before. No row becomes zero that was not."""
    lengths = np.linalg.norm(values, axis=1)
    known = lengths > 0
    typical = float(np.median(lengths[known])) if known.any() else 1.0
    step = max(share * typical * math.sqrt(12 / values.shape[1]), float(np.abs(values).max(initial=0)) / LARGEST)
    whole = np.round(values / step).astype(np.int64)
    lost = np.flatnonzero(known & ~whole.any(1))
    largest = np.abs(values[lost]).argmax(1)
    whole[lost, largest] = np.sign(values[lost, largest])
    entry = {"coding": "near", "step": step, "error": step if len(lost) else step / 2}
    return _planes(entry, whole - np.concatenate([whole, np.zeros_like(whole[:1])])[place.before])


def encode_rows(values: Array, share: float, coding: str = "rows") -> Coded:  # [K, D]
    """Each row has its own step, and holds multiples of it. The coding "basis" treats columns so."""
    values = values.T if coding == "basis" else values
    rms = np.sqrt(np.square(values).mean(1)) if values.size else np.zeros(len(values))
    steps = np.maximum(share * math.sqrt(12) * rms, np.abs(values).max(1, initial=0) / LARGEST).astype("<f4")
    steps = np.where(steps > 0, steps, np.float32(1)).astype("<f4")
    coded = _planes(
        {"coding": coding, "error": share * math.sqrt(3)}, np.round(values / steps[:, None]).astype(np.int64)
    )
    return Coded(coded.entry, steps.tobytes() + coded.plain)


def qr_work(shape: Sequence[int]) -> int:
    """What a QR decomposition costs: rows x columns^2."""
    return shape[0] * shape[1] ** 2


def plain_size(entry: Entry, shape: tuple[int, ...]) -> int:
    """The bytes that a coded tensor must have; a ValueError if the entry makes no sense. No memory is taken."""
    coding, numbers = entry["coding"], math.prod(shape)
    if coding == "exact":
        return numbers * DTYPES[entry["dtype"]].itemsize
    if coding not in _DECODERS:
        raise ValueError(f"coding: expected one of exact, {', '.join(_DECODERS)}, got {coding!r:.40}")
    if entry["width"] not in (1, 2, 4, 8):
        raise ValueError(f"width: expected 1, 2, 4 or 8 bytes, got {entry['width']!r:.40}")
    columns = {"curve": 3, "turns": 4}.get(coding)
    if columns is not None and (len(shape) != 2 or shape[1] != columns):
        raise ValueError(f"shape: expected [N, {columns}] for {coding}, got {shape}")
    if not 1 <= len(shape) <= 2 or (coding in ("rows", "basis", "near") and len(shape) != 2):
        raise ValueError(f"shape: expected that of rows for {coding}, got {shape}")
    if coding == "basis" and qr_work(shape) > QR_MOST:
        raise ValueError(f"shape: expected a basis that is quickly made orthonormal, got {shape}")
    stored = {"curve": numbers // 3, "turns": numbers // 4 * 3}.get(coding, numbers)
    steps = {"rows": shape[0], "basis": shape[-1]}.get(coding, 0)
    return stored * int(entry["width"]) + 4 * steps


def decode(entry: Entry, shape: tuple[int, ...], plain: bytes, place: Place | None) -> tuple[Tensor, Place | None]:
    """The tensor of an entry and its plain bytes, whose number is `plain_size`; and the place, if these are the means."""
    if entry["coding"] == "exact":
        dtype = DTYPES[entry["dtype"]]
        planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
        whole = torch.from_numpy(np.array(planes.T, order="C")).reshape(-1)
        return (whole.view(dtype) if len(whole) else torch.zeros(0, dtype=dtype)).reshape(shape), place
    if entry["coding"] == "curve":
        codes = np.cumsum(_whole(plain, entry, shape[0], 1)[:, 0].astype(np.uint64), dtype=np.uint64)
        place = find_before(morton_cells(codes).astype(np.int64))
        values = np.array(entry["origin"], np.float64).reshape(3) + place.cells * _number(entry, "step")
    else:
        values = _DECODERS[entry["coding"]](entry, shape, plain, place)
    return torch.from_numpy(np.ascontiguousarray(values.reshape(shape), dtype=np.float32)), place


def find_before(cells: Array) -> Place:  # [N, 3] int64
    """The nearest of the `WINDOW` rows before each row; of equally near ones the latest. Exact on every machine."""
    N = len(cells)
    cells, best = np.ascontiguousarray(cells.T), np.full(N, np.iinfo(np.int64).max)
    before = np.full(N, N)
    for back in range(1, min(WINDOW, N - 1) + 1):
        apart = cells[:, back:] - cells[:, :-back]
        distance = (apart * apart).sum(0)
        nearer = distance < best[back:]
        best[back:][nearer] = distance[nearer]
        before[back:][nearer] = np.flatnonzero(nearer)
    return Place(cells.T, before)


def _planes(entry: Entry, whole: Array) -> Coded:  # [n, c] int64
    """Column by column, and in a column byte by byte, the lowest first."""
    reach = int(np.abs(whole).max(initial=0))
    width = next(size for size in (1, 2, 4, 8) if reach < 1 << (8 * size - 1))
    columns = np.ascontiguousarray(whole.T).astype(f"<i{width}").view(np.uint8).reshape(whole.shape[1], -1, width)
    return Coded({**entry, "width": width}, columns.transpose(0, 2, 1).tobytes())


def _whole(plain: bytes, entry: Entry, rows: int, columns: int) -> Array:  # [rows, columns] integers
    width = entry["width"]
    planes = np.frombuffer(plain, np.uint8).reshape(columns, width, rows).transpose(0, 2, 1)
    return np.ascontiguousarray(planes).view(f"<i{width}").reshape(columns, rows).T


def _number(entry: Entry, name: str) -> float:
    """A positive finite number of an entry."""
    value = float(entry[name])
    if not 0 < value < 1e39:
        raise ValueError(f"{name}: expected a positive number, got {value}")
    return value


def _decode_steps(entry: Entry, shape: tuple[int, ...], plain: bytes, _: Place | None) -> Array:
    return _whole(plain, entry, shape[0], math.prod(shape[1:])) * _number(entry, "step")


def _decode_logs(entry: Entry, shape: tuple[int, ...], plain: bytes, _: Place | None) -> Array:
    step, least = _number(entry, "step"), _number(entry, "least")
    whole = _whole(plain, entry, shape[0], math.prod(shape[1:]))
    if whole.size and not 0 <= whole.min() <= whole.max() <= 700 / step:
        raise ValueError(f"logs: expected steps from 0 to {700 / step:.0f}, got {whole.min()} to {whole.max()}")
    return np.expm1(whole * step) * least


def _decode_turns(entry: Entry, shape: tuple[int, ...], plain: bytes, _: Place | None) -> Array:
    small = _whole(plain, entry, shape[0], 3) * _number(entry, "step")
    squares = np.square(small).sum(1, keepdims=True)
    small = small / np.sqrt(np.maximum(squares, 1))
    return np.concatenate([np.sqrt(np.maximum(0, 1 - squares)), small], axis=1)


def _decode_near(entry: Entry, shape: tuple[int, ...], plain: bytes, place: Place | None) -> Array:
    if place is None or len(place.before) != shape[0]:
        raise ValueError(f"near: expected as many rows as there are means, got {shape[0]}")
    rows, columns = shape
    whole = np.zeros((rows + 1, columns), np.int32)  # the last row is before those that have none
    whole[:rows] = _whole(plain, entry, rows, columns)
    up, part = np.append(place.before, rows), np.empty_like(whole)
    while (up < rows).any():  # each round adds twice as many rows before it
        whole += np.take(whole, up, axis=0, out=part)
        up = up[up]
    return whole[:rows] * np.float32(_number(entry, "step"))


def _decode_rows(entry: Entry, shape: tuple[int, ...], plain: bytes, _: Place | None) -> Array:
    rows, columns = shape
    steps = np.frombuffer(plain, "<f4", rows)
    return _whole(plain[4 * rows :], entry, rows, columns) * steps[:, None].astype(np.float64)


def _decode_basis(entry: Entry, shape: tuple[int, ...], plain: bytes, place: Place | None) -> Array:
    """Rounded columns are not quite orthonormal: the nearest such are those of their QR decomposition, with its signs."""
    columns = _decode_rows(entry, shape[::-1], plain, place).T
    if not np.isfinite(columns).all() or shape[0] < shape[1]:
        raise ValueError(f"basis: expected finite columns, at most as many as rows, got {shape}")
    Q, R = np.linalg.qr(columns)
    return np.asarray(Q * np.sign(np.diagonal(R)))


_DECODERS: dict[str, Callable[[Entry, tuple[int, ...], bytes, Place | None], Array]] = {
    "steps": _decode_steps,
    "logs": _decode_logs,
    "turns": _decode_turns,
    "near": _decode_near,
    "rows": _decode_rows,
    "basis": _decode_basis,
    "curve": _decode_steps,  # `decode` does it
}
