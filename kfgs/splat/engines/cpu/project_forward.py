"""The compiled projection of one band of Gaussians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from .cache import cached_njit
from .project_math import (
    BATCH,
    MEAN,
    OPTIONS,
    OTHER,
    PLAIN,
    SCALE,
    Lens,
    cross,
    dot,
    gather,
    linearize,
    normalize,
    rotation,
    to_camera,
    turn_row,
)

_REACH, _MEAN2D, _CONIC, _EXTENT, _KEPT = (OTHER + k * BATCH for k in (0, 1, 3, 6, 8))
_STATE = OTHER + 9 * BATCH


@cached_njit(fastmath=PLAIN, **OPTIONS)
def project_band(
    band: int,
    bands: int,
    lens: Lens,
    gaussians: tuple[Any, Any, Any, Any],
    reach: Any,
    out: tuple[Any, Any, Any, Any, Any, Any],
    counts: Any,
) -> None:
    """Project one of `bands` equal shares of the N Gaussians; write the visible ones from the share's beginning on.

    Args:
        band: which share.
        bands: how many.
        lens: the camera and the options.
        gaussians: means [3 N], quats [4 N], scales [3 N], opacities [N].
        reach: [N], 2 ln(opacity / ALPHA_MIN).
        out: means2d [2 N], conics [3 N], depths [N], opacities [N], extents [2 N], index [N] int64, written.
        counts: [B] int64, written: how many are visible.
    """
    means, first, last = gaussians[0], len(reach) * band // bands, len(reach) * (band + 1) // bands
    state, depths = np.zeros(_STATE, means.dtype), np.empty(BATCH, means.dtype)
    waiting = np.empty(2 * BATCH, np.int64)
    count, end = 0, first
    for begin in range(first, last, BATCH):
        count = _append_candidates(waiting, count, begin, min(begin + BATCH, last), lens, means, reach, depths)
        if count >= BATCH:
            end = _project_waiting(waiting, BATCH, lens, gaussians, reach, state, out, end)
            count -= BATCH
            for k in range(count):
                waiting[k] = waiting[BATCH + k]
    counts[band] = _project_waiting(waiting, count, lens, gaussians, reach, state, out, end) - first


@njit(fastmath=PLAIN, **OPTIONS)
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


@njit(fastmath=PLAIN, **OPTIONS)
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


@njit(fastmath=PLAIN, **OPTIONS)
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


@njit(fastmath=PLAIN, **OPTIONS)
def _covers_center(mean: Any, extent: Any, size: Any, half: Any, rounding: Any) -> bool:
    """Whether a pixel of 0 to size - 1 has its centre within `extent` of `mean`, as `pixel_box` has it."""
    slack = rounding * (abs(mean) + extent)
    first, last = np.ceil(mean - extent - half - slack), np.floor(mean + extent - half + slack)
    return (first <= last) & (last >= 0) & (first < size)
