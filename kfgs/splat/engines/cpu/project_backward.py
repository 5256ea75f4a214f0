"""The gradient of the compiled projection over one band of Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np

from .cache import cached_njit, inner_njit
from .project_forward import (
    BATCH,
    MEAN,
    OTHER,
    PLAIN,
    QUAT,
    QUAT_FLOOR,
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

_GRAD_MEAN2D, _GRAD_CONIC, _GRAD_DEPTH = (OTHER + k * BATCH for k in (0, 2, 5))
_STATE = OTHER + 6 * BATCH


@cached_njit(fastmath=PLAIN)
def differentiate_band(
    band: int,
    bands: int,
    lens: Lens,
    gaussians: tuple[Any, Any, Any],  # means [3 N], quats [4 N], scales [3 N]
    index: Any,  # [M] int64: the visible Gaussians
    grads: tuple[Any, Any, Any, Any],  # of the loss in means2d [2 M], conics [3 M], depths [M] and opacities [M]
    out: tuple[Any, Any, Any, Any],  # gradients in means [3 N], quats [4 N], scales [3 N] and opacities [N], written
) -> None:
    """Write the rows of the gradients of one of `bands` equal shares of the visible Gaussians."""
    means, quats, scales = gaussians
    grad_means2d, grad_conics, grad_depths, grad_opacities = grads
    out_means, out_quats, out_scales, out_opacities = out
    begin, end = len(index) * band // bands, len(index) * (band + 1) // bands
    state = np.zeros(_STATE, means.dtype)
    while begin < end:
        count = min(BATCH, end - begin)
        for k in range(count):
            m = max(begin, 0) + k
            gather(state, k, index[m], means, quats, scales)
            for j in range(2):
                state[_GRAD_MEAN2D + j * BATCH + k] = grad_means2d[2 * m + j]
            for j in range(3):
                state[_GRAD_CONIC + j * BATCH + k] = grad_conics[3 * m + j]
            state[_GRAD_DEPTH + k] = grad_depths[m]
        _differentiate_batch(state, lens)
        for k in range(count):
            at = max(index[begin + k], 0)  # the gradients replaced the values in the planes
            for j in range(3):
                out_means[3 * at + j] = state[MEAN + j * BATCH + k]
                out_scales[3 * at + j] = state[SCALE + j * BATCH + k]
            for j in range(4):
                out_quats[4 * at + j] = state[QUAT + j * BATCH + k]
            out_opacities[at] = grad_opacities[begin + k]
        begin += count


@inner_njit(inline="always", fastmath=PLAIN)
def _conic_to_axes(
    u: tuple[Any, Any, Any], v: tuple[Any, Any, Any], low_pass: Any, grad: tuple[Any, Any, Any], one: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """The slopes in u and v of the conic (|v|^2 + l, -u.v, |u|^2 + l) / D, D = |u x v|^2 + l (|u|^2 + |v|^2) + l^2.

    D stays a cross product here, too: dD/du = 2 v x (u x v) + 2 l u does not cancel for needles, whereas
    -C (dL/dC) C, which is the same, does.
    """
    uu, vv, area = dot(u, u), dot(v, v), cross(u, v)
    uv = dot(u, v)
    per_det = one / (dot(area, area) + low_pass * (uu + vv) + low_pass * low_pass)
    g_vv, g_uv, g_uu = grad[0] * per_det, -grad[1] * per_det, grad[2] * per_det
    g_det = -(g_vv * (vv + low_pass) + g_uv * uv + g_uu * (uu + low_pass)) * per_det
    u_turned, v_turned = cross(v, area), cross(area, u)
    along_u, along_v, det2 = g_uu + g_det * low_pass, g_vv + g_det * low_pass, g_det + g_det
    along_u, along_v = along_u + along_u, along_v + along_v
    return (
        along_u * u[0] + g_uv * v[0] + det2 * u_turned[0],
        along_u * u[1] + g_uv * v[1] + det2 * u_turned[1],
        along_u * u[2] + g_uv * v[2] + det2 * u_turned[2],
        along_v * v[0] + g_uv * u[0] + det2 * v_turned[0],
        along_v * v[1] + g_uv * u[1] + det2 * v_turned[1],
        along_v * v[2] + g_uv * u[2] + det2 * v_turned[2],
    )


@inner_njit(fastmath=PLAIN)
def _rotation_to_quat(
    w: Any, x: Any, y: Any, z: Any, g: tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any]
) -> tuple[Any, Any, Any, Any]:
    """The slopes in a quaternion, given those in the entries of `rotation`."""
    # sums and differences of the entries mirrored at the diagonal
    yz, zx, xy = g[7] + g[5], g[2] + g[6], g[3] + g[1]
    wx, wy, wz = g[7] - g[5], g[2] - g[6], g[3] - g[1]
    g_w = x * wx + y * wy + z * wz
    g_x = w * wx + y * xy + z * zx - (x + x) * (g[4] + g[8])
    g_y = w * wy + x * xy + z * yz - (y + y) * (g[0] + g[8])
    g_z = w * wz + x * zx + y * yz - (z + z) * (g[0] + g[4])
    return g_w + g_w, g_x + g_x, g_y + g_y, g_z + g_z


@inner_njit(fastmath=PLAIN)
def _differentiate_batch(state: Any, lens: Lens) -> None:
    """Replace the planes of means, quaternions and scales by the loss's slopes in them."""
    one, none, floor = state.dtype.type(1), state.dtype.type(0), state.dtype.type(QUAT_FLOOR)
    r = lens.turn
    for i in range(BATCH):
        x, y, z = to_camera(state, i, lens)
        w, qx, qy, qz, norm = normalize(state, i)
        R = rotation(w, qx, qy, qz, one)
        sx, sy, sz = state[SCALE + i], state[SCALE + BATCH + i], state[SCALE + 2 * BATCH + i]
        g_mean_x, g_mean_y = state[_GRAD_MEAN2D + i], state[_GRAD_MEAN2D + BATCH + i]
        g_conic = state[_GRAD_CONIC + i], state[_GRAD_CONIC + BATCH + i], state[_GRAD_CONIC + 2 * BATCH + i]
        per_z = one / z
        tan_x, tan_y = x * per_z, y * per_z
        t = linearize(lens, tan_x, tan_y, per_z)
        a, b = turn_row((t[0], t[1], t[2]), R), turn_row((t[3], t[4], t[5]), R)  # rows of J W R
        u, v = (a[0] * sx, a[1] * sy, a[2] * sz), (b[0] * sx, b[1] * sy, b[2] * sz)
        g = _conic_to_axes(u, v, lens.low_pass, g_conic, one)
        g_sx, g_sy, g_sz = g[0] * a[0] + g[3] * b[0], g[1] * a[1] + g[4] * b[1], g[2] * a[2] + g[5] * b[2]
        g_a, g_b = (g[0] * sx, g[1] * sy, g[2] * sz), (g[3] * sx, g[4] * sy, g[5] * sz)
        g_R = (
            t[0] * g_a[0] + t[3] * g_b[0],
            t[0] * g_a[1] + t[3] * g_b[1],
            t[0] * g_a[2] + t[3] * g_b[2],
            t[1] * g_a[0] + t[4] * g_b[0],
            t[1] * g_a[1] + t[4] * g_b[1],
            t[1] * g_a[2] + t[4] * g_b[2],
            t[2] * g_a[0] + t[5] * g_b[0],
            t[2] * g_a[1] + t[5] * g_b[1],
            t[2] * g_a[2] + t[5] * g_b[2],
        )
        g_w, g_x, g_y, g_z = _rotation_to_quat(w, qx, qy, qz, g_R)
        # A quaternion of unit norm cannot grow; one that is divided by the floor can.
        radial = g_w * w + g_x * qx + g_y * qy + g_z * qz if norm >= floor else none
        per_norm = one / max(norm, floor)
        g_tx = dot(g_a, (R[0], R[1], R[2])), dot(g_a, (R[3], R[4], R[5])), dot(g_a, (R[6], R[7], R[8]))
        g_ty = dot(g_b, (R[0], R[1], R[2])), dot(g_b, (R[3], R[4], R[5])), dot(g_b, (R[6], R[7], R[8]))
        g_cam = _jacobian_to_point(lens, (tan_x, tan_y, per_z), g_tx, g_ty, (g_mean_x, g_mean_y))
        g_cam_z = g_cam[2] + state[_GRAD_DEPTH + i]
        state[MEAN + i] = r[0] * g_cam[0] + r[3] * g_cam[1] + r[6] * g_cam_z
        state[MEAN + BATCH + i] = r[1] * g_cam[0] + r[4] * g_cam[1] + r[7] * g_cam_z
        state[MEAN + 2 * BATCH + i] = r[2] * g_cam[0] + r[5] * g_cam[1] + r[8] * g_cam_z
        state[QUAT + i], state[QUAT + BATCH + i] = (g_w - radial * w) * per_norm, (g_x - radial * qx) * per_norm
        state[QUAT + 2 * BATCH + i] = (g_y - radial * qy) * per_norm
        state[QUAT + 3 * BATCH + i] = (g_z - radial * qz) * per_norm
        state[SCALE + i], state[SCALE + BATCH + i], state[SCALE + 2 * BATCH + i] = g_sx, g_sy, g_sz


@inner_njit(fastmath=PLAIN)
def _jacobian_to_point(
    lens: Lens,
    point: tuple[Any, Any, Any],
    g_tx: tuple[Any, Any, Any],
    g_ty: tuple[Any, Any, Any],
    g_mean: tuple[Any, Any],
) -> tuple[Any, Any, Any]:
    """The slopes in a point (x, y, z) of the camera's frame, given (x / z, y / z, 1 / z) and those in J W and the mean."""
    tan_x, tan_y, per_z = point
    r = lens.turn
    none = per_z - per_z
    j_x, j_y = lens.focal[0] * per_z, lens.focal[1] * per_z
    at_x, at_y = min(max(tan_x, lens.least[0]), lens.most[0]), min(max(tan_y, lens.least[1]), lens.most[1])
    g_x, g_y = dot(g_tx, (r[0], r[1], r[2])), dot(g_ty, (r[3], r[4], r[5]))  # in focal / z
    g_xz, g_yz = dot(g_tx, (r[6], r[7], r[8])), dot(g_ty, (r[6], r[7], r[8]))  # in -focal tangent / z
    inside_x = (tan_x >= lens.least[0]) & (tan_x <= lens.most[0])
    inside_y = (tan_y >= lens.least[1]) & (tan_y <= lens.most[1])
    g_tan_x = lens.focal[0] * g_mean[0] - (j_x * g_xz if inside_x else none)
    g_tan_y = lens.focal[1] * g_mean[1] - (j_y * g_yz if inside_y else none)
    g_z = j_x * (g_x - at_x * g_xz) + j_y * (g_y - at_y * g_yz) + g_tan_x * tan_x + g_tan_y * tan_y
    return g_tan_x * per_z, g_tan_y * per_z, -g_z * per_z
