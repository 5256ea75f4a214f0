"""The compiled projection of one band of Gaussians, and what its gradient shares with it: the lens, the footprint.

Gaussians are gathered into planes, BATCH at a time: entry i of plane p is `state[p + i]`. The inner loop over a batch has no
branches, a constant length, and planes at constant distances. So LLVM computes 8 or 16 Gaussians per instruction, and
results do not depend on a Gaussian's neighbours.

Arrays are passed flat, so that the compiler knows all distances; `max(row, 0)` tells it that an index does not wrap around.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...project import FIELD_OF_VIEW_MARGIN
from ..contract import Pinhole
from .cache import cached_njit, inner_njit

BATCH = 64
MEAN, QUAT, SCALE = 0, 3 * BATCH, 7 * BATCH
"""First planes of the Gaussian's means [3], quaternions [4] and scales [3]."""
OTHER = 10 * BATCH
"""First plane that a kernel uses as it likes."""

QUAT_FLOOR = 1e-12
"""A quaternion is divided by its norm or by this, whichever is larger: kornia's choice, by which zero is no rotation."""

_REACH, _MEAN2D, _CONIC, _EXTENT, _KEPT = (OTHER + k * BATCH for k in (0, 1, 3, 6, 8))
_STATE = OTHER + 9 * BATCH

PLAIN = {"contract", "nsz", "arcp"}  # NaN and infinity keep their meaning: they are what culls broken Gaussians


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


@inner_njit(fastmath=PLAIN)
def gather(state: Any, slot: int, row: int, means: Any, quats: Any, scales: Any) -> None:
    """Copy one Gaussian into place `slot` of the planes; the arrays are flat."""
    slot, row = max(slot, 0), max(row, 0)
    for k in range(3):
        state[MEAN + k * BATCH + slot] = means[3 * row + k]
        state[SCALE + k * BATCH + slot] = scales[3 * row + k]
    for k in range(4):
        state[QUAT + k * BATCH + slot] = quats[4 * row + k]


@inner_njit(fastmath=PLAIN)
def to_camera(state: Any, i: int, lens: Lens) -> tuple[Any, Any, Any]:
    """R X + t of the batch's Gaussian i."""
    r, t = lens.turn, lens.shift
    X, Y, Z = state[MEAN + i], state[MEAN + BATCH + i], state[MEAN + 2 * BATCH + i]
    x = r[0] * X + r[1] * Y + r[2] * Z + t[0]
    y = r[3] * X + r[4] * Y + r[5] * Z + t[1]
    z = r[6] * X + r[7] * Y + r[8] * Z + t[2]
    return x, y, z


@inner_njit(fastmath=PLAIN)
def normalize(state: Any, i: int) -> tuple[Any, Any, Any, Any, Any]:
    """Quaternion (w, x, y, z) of the batch's Gaussian i divided by its norm, and the norm."""
    w, x = state[QUAT + i], state[QUAT + BATCH + i]
    y, z = state[QUAT + 2 * BATCH + i], state[QUAT + 3 * BATCH + i]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    scale = state.dtype.type(1) / max(norm, state.dtype.type(QUAT_FLOOR))
    return w * scale, x * scale, y * scale, z * scale, norm


@inner_njit(fastmath=PLAIN)
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


@inner_njit(fastmath=PLAIN)
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


@inner_njit(fastmath=PLAIN)
def turn_row(row: tuple[Any, Any, Any], R: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Row R."""
    a, b, c = row
    return (a * R[0] + b * R[3] + c * R[6], a * R[1] + b * R[4] + c * R[7], a * R[2] + b * R[5] + c * R[8])


@inner_njit(fastmath=PLAIN)
def dot(u: tuple[Any, Any, Any], v: tuple[Any, Any, Any]) -> Any:
    """U . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@inner_njit(fastmath=PLAIN)
def cross(u: tuple[Any, Any, Any], v: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """U x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@cached_njit(fastmath=PLAIN)
def project_band(
    band: int,
    bands: int,
    lens: Lens,
    gaussians: tuple[Any, Any, Any, Any],  # means [3 N], quats [4 N], scales [3 N], opacities [N]
    reach: Any,  # [N], 2 ln(opacity / ALPHA_MIN)
    out: tuple[Any, ...],  # means2d [2 N], conics [3 N], depths, opacities, extents [2 N], index int64 [N], written
    counts: Any,  # [B] int64, written: how many are visible
) -> None:
    """Project one of `bands` equal shares of the N Gaussians; write the visible ones from the share's beginning on."""
    means, first, last = gaussians[0], len(reach) * band // bands, len(reach) * (band + 1) // bands
    state, depths = np.zeros(_STATE, means.dtype), np.empty(BATCH, means.dtype)
    waiting = np.empty(2 * BATCH, np.int64)
    count, end, most = np.int64(0), first, np.int64(BATCH)  # numba compiles again for each plain number
    for begin in range(first, last, BATCH):
        count = _append_candidates(waiting, count, begin, min(begin + BATCH, last), lens, means, reach, depths)
        if count >= BATCH:
            end = _project_waiting(waiting, most, lens, gaussians, reach, state, out, end)
            count -= BATCH
            for k in range(count):
                waiting[k] = waiting[BATCH + k]
    counts[band] = _project_waiting(waiting, count, lens, gaussians, reach, state, out, end) - first


@inner_njit(fastmath=PLAIN)
def _append_candidates(
    waiting: Any, count: int, begin: int, end: int, lens: Lens, means: Any, reach: Any, depths: Any
) -> int:
    """Append to `waiting` which of the Gaussians lie beyond `near` and are not too transparent; returns its length."""
    r, shift = lens.turn, lens.shift[2]
    begin, count = max(begin, 0), max(count, 0)
    for i in range(end - begin):
        at = 3 * (begin + i)
        depths[i] = r[6] * means[at] + r[7] * means[at + 1] + r[8] * means[at + 2] + shift
    for i in range(end - begin):
        waiting[count] = begin + i
        count += (depths[i] > lens.near) & (depths[i] <= lens.largest) & (reach[begin + i] > 0)
    return count


@inner_njit(fastmath=PLAIN)
def _project_waiting(
    waiting: Any, count: int, lens: Lens, gaussians: Any, reach: Any, state: Any, out: Any, end: int
) -> int:
    """Project the first `count` of `waiting` and append to `out`, at `end`, those that touch a pixel."""
    means, quats, scales, opacities = gaussians
    means2d, conics, depths, out_opacities, extents, index = out
    for k in range(count):
        row = max(waiting[k], 0)
        gather(state, k, row, means, quats, scales)
        state[_REACH + k] = reach[row]
    _project_batch(state, lens)
    for k in range(count):
        row, at = max(waiting[k], 0), max(end, 0)
        for j in range(2):
            means2d[2 * at + j] = state[_MEAN2D + j * BATCH + k]
            extents[2 * at + j] = state[_EXTENT + j * BATCH + k]
        for j in range(3):
            conics[3 * at + j] = state[_CONIC + j * BATCH + k]
        depths[at] = state[MEAN + 2 * BATCH + k]
        out_opacities[at] = opacities[row]
        index[at] = row
        end += state[_KEPT + k] > 0
    return end


@inner_njit(fastmath=PLAIN)
def _project_batch(state: Any, lens: Lens) -> None:
    """Fill the planes that follow _REACH; the third of the means becomes the depths."""
    one, none = state.dtype.type(1), state.dtype.type(0)
    half, most, low_pass = state.dtype.type(0.5), lens.largest, lens.low_pass
    for i in range(BATCH):
        x, y, z = to_camera(state, i, lens)
        w, qx, qy, qz, norm = normalize(state, i)
        R = rotation(w, qx, qy, qz, one)
        sx, sy, sz = state[SCALE + i], state[SCALE + BATCH + i], state[SCALE + 2 * BATCH + i]
        reach = state[_REACH + i]
        per_z = one / z
        tan_x, tan_y = x * per_z, y * per_z
        t = linearize(lens, tan_x, tan_y, per_z)
        tx, ty = (t[0], t[1], t[2]), (t[3], t[4], t[5])
        u, v = turn_row(tx, R), turn_row(ty, R)
        u, v = (u[0] * sx, u[1] * sy, u[2] * sz), (v[0] * sx, v[1] * sy, v[2] * sz)
        uu, vv, area = dot(u, u), dot(v, v), cross(u, v)
        # |u|^2 |v|^2 - (u.v)^2 = |u x v|^2 (Lagrange): the difference cancels for needles, the cross product does not.
        det = dot(area, area) + low_pass * (uu + vv) + low_pass * low_pass
        per_det = one / det
        var_x, var_y = uu + low_pass, vv + low_pass
        mean_x, mean_y = lens.focal[0] * tan_x + lens.principal[0], lens.focal[1] * tan_y + lens.principal[1]
        extent_x, extent_y = math.sqrt(reach * var_x), math.sqrt(reach * var_y)
        # A ball around the Gaussian bounds its footprint; where that overflows or is NaN, gradients would be NaN.
        largest = max(max(sx, sy), sz)
        ball_x, ball_y = dot(tx, tx) * largest * largest + low_pass, dot(ty, ty) * largest * largest + low_pass
        finite = (abs(mean_x) <= most) & (abs(mean_y) <= most) & (norm <= most) & (abs(sx + sy + sz) <= most)
        finite &= (reach * ball_x <= most) & (reach * ball_y <= most) & (ball_x * ball_y <= most)
        touches = _covers_center(mean_x, extent_x, lens.size[0], half, lens.rounding)
        touches &= _covers_center(mean_y, extent_y, lens.size[1], half, lens.rounding)
        state[_MEAN2D + i], state[_MEAN2D + BATCH + i] = mean_x, mean_y
        state[_CONIC + i] = var_y * per_det
        state[_CONIC + BATCH + i] = -dot(u, v) * per_det
        state[_CONIC + 2 * BATCH + i] = var_x * per_det
        state[_EXTENT + i], state[_EXTENT + BATCH + i] = extent_x, extent_y
        state[_KEPT + i] = one if finite & touches else none
        state[MEAN + 2 * BATCH + i] = z


@inner_njit(fastmath=PLAIN)
def _covers_center(mean: Any, extent: Any, size: Any, half: Any, rounding: Any) -> bool:
    """Whether a pixel of 0 to size - 1 has its centre within `extent` of `mean`, as `pixel_box` has it."""
    slack = rounding * (abs(mean) + extent)
    first, last = np.ceil(mean - extent - half - slack), np.floor(mean + extent - half + slack)
    return (first <= last) & (last >= 0) & (first < size)
