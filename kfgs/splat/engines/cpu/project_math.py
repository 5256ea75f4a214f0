"""What the compiled projection and its gradient share: the lens as numbers, planes of scratch memory, the footprint.

Gaussians are gathered into planes, BATCH at a time: entry i of plane p is `state[p + i]`. The inner loop over a batch has no
branches, a constant length, and planes at constant distances. So LLVM computes 8 or 16 Gaussians per instruction, and
results do not depend on a Gaussian's neighbours.

Arrays are passed flat, so that the compiler knows all distances; `max(row, 0)` tells it that an index does not wrap around.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ...project import FIELD_OF_VIEW_MARGIN
from ..contract import Pinhole

BATCH = 64
MEAN, QUAT, SCALE = 0, 3 * BATCH, 7 * BATCH
"""First planes of the Gaussian's means [3], quaternions [4] and scales [3]."""
OTHER = 10 * BATCH
"""First plane that a kernel uses as it likes."""

QUAT_FLOOR = 1e-12
"""A quaternion is divided by its norm or by this, whichever is larger: kornia's choice, by which zero is no rotation."""

PLAIN = {"contract", "nsz", "arcp"}  # NaN and infinity keep their meaning: they are what culls broken Gaussians
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class Lens(NamedTuple):
    """The camera and the options of `project` as numbers of the Gaussians' dtype."""

    turn: tuple[Any, ...]  # row-major rotation, world to camera, [9]
    shift: tuple[Any, ...]  # [3]
    focal: tuple[Any, Any]
    principal: tuple[Any, Any]
    least: tuple[Any, Any]  # tangents where the linearisation ends
    most: tuple[Any, Any]
    size: tuple[Any, Any]  # width, height
    near: Any
    low_pass: Any
    largest: Any  # finite number
    rounding: Any  # relative, of a pixel box's edges


def make_lens(pinhole: Pinhole) -> Lens:
    """Take the camera apart; the tangents' limits are those of `project`."""
    viewmat, K = (value.detach().numpy() for value in pinhole[:2])
    _, _, width, height, near, low_pass = pinhole
    kind = K.dtype.type
    focal, principal = (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2])
    size = kind(width), kind(height)
    middle = [(s / kind(2) - c) / f for s, c, f in zip(size, principal, focal, strict=True)]
    half = [kind(FIELD_OF_VIEW_MARGIN) * s / kind(2) / f for s, f in zip(size, focal, strict=True)]
    least = tuple(m - h for m, h in zip(middle, half, strict=True))
    most = tuple(m + h for m, h in zip(middle, half, strict=True))
    turn, shift = tuple(viewmat[:3, :3].ravel()), tuple(viewmat[:3, 3])
    limits = np.finfo(kind)
    options = kind(near), kind(low_pass), limits.max, 4 * limits.eps
    return Lens(turn, shift, focal, principal, least, most, size, *options)  # type: ignore[arg-type]


@njit(fastmath=PLAIN, **OPTIONS)
def gather(state: Any, slot: int, row: int, means: Any, quats: Any, scales: Any) -> None:
    """Copy one Gaussian into place `slot` of the planes; the arrays are flat."""
    slot, row = max(slot, 0), max(row, 0)
    for k in range(3):
        state[MEAN + k * BATCH + slot] = means[3 * row + k]
        state[SCALE + k * BATCH + slot] = scales[3 * row + k]
    for k in range(4):
        state[QUAT + k * BATCH + slot] = quats[4 * row + k]


@njit(fastmath=PLAIN, **OPTIONS)
def to_camera(state: Any, i: int, lens: Lens) -> tuple[Any, Any, Any]:
    """R X + t of the batch's Gaussian i."""
    r, t = lens.turn, lens.shift
    X, Y, Z = state[MEAN + i], state[MEAN + BATCH + i], state[MEAN + 2 * BATCH + i]
    x = r[0] * X + r[1] * Y + r[2] * Z + t[0]
    y = r[3] * X + r[4] * Y + r[5] * Z + t[1]
    z = r[6] * X + r[7] * Y + r[8] * Z + t[2]
    return x, y, z


@njit(fastmath=PLAIN, **OPTIONS)
def normalize(state: Any, i: int) -> tuple[Any, Any, Any, Any, Any]:
    """Quaternion (w, x, y, z) of the batch's Gaussian i divided by its norm, and the norm."""
    w, x = state[QUAT + i], state[QUAT + BATCH + i]
    y, z = state[QUAT + 2 * BATCH + i], state[QUAT + 3 * BATCH + i]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    scale = state.dtype.type(1) / max(norm, state.dtype.type(QUAT_FLOOR))
    return w * scale, x * scale, y * scale, z * scale, norm


@njit(fastmath=PLAIN, **OPTIONS)
def rotation(w: Any, x: Any, y: Any, z: Any, one: Any) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any]:
    """Row-major rotation matrix of a quaternion."""
    x2, y2, z2 = x + x, y + y, z + z
    return (
        one - (y2 * y + z2 * z),
        x2 * y - z2 * w,
        x2 * z + y2 * w,
        x2 * y + z2 * w,
        one - (x2 * x + z2 * z),
        y2 * z - x2 * w,
        x2 * z - y2 * w,
        y2 * z + x2 * w,
        one - (x2 * x + y2 * y),
    )


@njit(fastmath=PLAIN, **OPTIONS)
def linearize(lens: Lens, tan_x: Any, tan_y: Any, per_z: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Rows x and y of J W, [2, 3]: J's entries are focal / z, and minus that times the tangent within its limits."""
    r = lens.turn
    j_x, j_y = lens.focal[0] * per_z, lens.focal[1] * per_z
    j_xz = -j_x * min(max(tan_x, lens.least[0]), lens.most[0])
    j_yz = -j_y * min(max(tan_y, lens.least[1]), lens.most[1])
    return (
        j_x * r[0] + j_xz * r[6],
        j_x * r[1] + j_xz * r[7],
        j_x * r[2] + j_xz * r[8],
        j_y * r[3] + j_yz * r[6],
        j_y * r[4] + j_yz * r[7],
        j_y * r[5] + j_yz * r[8],
    )


@njit(fastmath=PLAIN, **OPTIONS)
def turn_row(row: tuple[Any, Any, Any], R: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Row R."""
    a, b, c = row
    return (a * R[0] + b * R[3] + c * R[6], a * R[1] + b * R[4] + c * R[7], a * R[2] + b * R[5] + c * R[8])


@njit(fastmath=PLAIN, **OPTIONS)
def dot(u: tuple[Any, Any, Any], v: tuple[Any, Any, Any]) -> Any:
    """U . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(fastmath=PLAIN, **OPTIONS)
def cross(u: tuple[Any, Any, Any], v: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """U x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
