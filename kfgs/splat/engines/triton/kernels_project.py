"""The Triton kernels of the projection: `project`'s equations for one Gaussian per lane, and their gradient.

With torch's and kornia's functions a frame launches a hundred kernels and its gradient two hundred, each of which takes a
processor longer to launch than a GPU to run. Here the numbers of a Gaussian stay in registers, and the gradient computes
them again.

The camera is read on the GPU: `viewmat` [4, 4], `K` [3, 3]. Where a helper has an AXIS, 0 is x and 1 is y of the picture.
"""

# mypy: disable-error-code="no-untyped-def"

import triton
import triton.language as tl

from ...project import FIELD_OF_VIEW_MARGIN
from ..contract import ALPHA_MIN

MARGIN = tl.constexpr(FIELD_OF_VIEW_MARGIN)
LEAST = tl.constexpr(ALPHA_MIN)
LARGEST = tl.constexpr(3.4028234663852886e38)  # finite number of float32
ROUNDING = tl.constexpr(4 * 2.0**-23)  # relative, of a box's edges; as `pixel_box` has it
QUAT_FLOOR = tl.constexpr(1e-12)  # a quaternion is divided by its norm, or by this: kornia's choice

NUMBERS = ["count", "width", "height"]
"""Arguments whose change needs no new compilation."""


@triton.jit
def load(base, at, there):
    """Numbers of an array, 0 where there is none; without an array, zeros."""
    if base is None:
        return tl.zeros(there.shape, tl.float32)
    else:  # Triton takes one of the branches while it compiles
        return tl.load(base + at, mask=there, other=0.0)


@triton.jit
def load_3(base, row, there):
    """Three numbers of a row of an array [N, 3]."""
    return load(base, 3 * row, there), load(base, 3 * row + 1, there), load(base, 3 * row + 2, there)


@triton.jit
def store_3(base, row, there, x, y, z):
    """Three numbers of a row of an array [N, 3]."""
    tl.store(base + 3 * row, x, mask=there)
    tl.store(base + 3 * row + 1, y, mask=there)
    tl.store(base + 3 * row + 2, z, mask=there)


@triton.jit
def dot(a, b, c, x, y, z):
    """(a, b, c) · (x, y, z)."""
    return a * x + b * y + c * z


@triton.jit
def cross(a, b, c, x, y, z):
    """(a, b, c) x (x, y, z)."""
    return b * z - c * y, c * x - a * z, a * y - b * x


@triton.jit
def turn(viewmat, x, y, z, AXIS: tl.constexpr, BACK: tl.constexpr = False):
    """Row AXIS of the camera's rotation times a vector; with BACK, column AXIS."""
    STEP: tl.constexpr = 4 if BACK else 1
    first = viewmat + (4 // STEP) * AXIS
    return dot(tl.load(first), tl.load(first + STEP), tl.load(first + 2 * STEP), x, y, z)


@triton.jit
def place(viewmat, means, row, there):
    """The means in the camera's frame: x / z, y / z, z."""
    X, Y, Z = load_3(means, row, there)
    z = turn(viewmat, X, Y, Z, 2) + tl.load(viewmat + 11)
    x = turn(viewmat, X, Y, Z, 0) + tl.load(viewmat + 3)
    return x / z, (turn(viewmat, X, Y, Z, 1) + tl.load(viewmat + 7)) / z, z


@triton.jit
def load_axes(quats, row, there):
    """The normalised quaternion, its norm before, and its rotation matrix row by row."""
    w, x = load(quats, 4 * row, there), load(quats, 4 * row + 1, there)
    y, z = load(quats, 4 * row + 2, there), load(quats, 4 * row + 3, there)
    norm = tl.sqrt(w * w + x * x + y * y + z * z)
    scale = 1.0 / tl.maximum(norm, QUAT_FLOOR)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    R0, R1, R2 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    R3, R4, R5 = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    R6, R7, R8 = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)
    return w, x, y, z, norm, R0, R1, R2, R3, R4, R5, R6, R7, R8


@triton.jit
def limit(K, size, tangent, AXIS: tl.constexpr):
    """The focal length, and the tangent within the limits of the linearisation."""
    focal = tl.load(K + 4 * AXIS)
    middle, half = (size / 2 - tl.load(K + 3 * AXIS + 2)) / focal, MARGIN * size / 2 / focal
    return focal, tl.minimum(tl.maximum(tangent, middle - half), middle + half)


@triton.jit
def linearize(viewmat, K, size, tangent, z, R0, R1, R2, R3, R4, R5, R6, R7, R8, AXIS: tl.constexpr):
    """Row AXIS of J W, and of J W R: J's entries are focal / z, and minus that times the tangent within its limits."""
    focal, at = limit(K, size, tangent, AXIS)
    j = focal / z
    t0 = j * tl.load(viewmat + 4 * AXIS) - j * at * tl.load(viewmat + 8)
    t1 = j * tl.load(viewmat + 4 * AXIS + 1) - j * at * tl.load(viewmat + 9)
    t2 = j * tl.load(viewmat + 4 * AXIS + 2) - j * at * tl.load(viewmat + 10)
    return t0, t1, t2, dot(t0, t1, t2, R0, R3, R6), dot(t0, t1, t2, R1, R4, R7), dot(t0, t1, t2, R2, R5, R8)


@triton.jit
def covers_center(mean, extent, size):
    """Whether a pixel of 0 to size - 1 has its centre within `extent` of `mean`."""
    slack = ROUNDING * (tl.abs(mean) + extent)
    first, last = tl.ceil(mean - extent - 0.5 - slack), tl.floor(mean + extent - 0.5 + slack)
    return (first <= last) & (last >= 0) & (first < size)


@triton.jit(do_not_specialize=NUMBERS)
def project_kernel(
    means, quats, scales, opacities, viewmat, K, kept, ends,
    means2d, conics, depths, out_opacities, extents, index,
    count, width, height, near, low_pass, BLOCK: tl.constexpr,
):  # fmt: skip
    """Without `ends`, say which of the `count` Gaussians are visible; with their running sum, write those that are."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = row < count
    tan_x, tan_y, z = place(viewmat, means, row, there)
    _, _, _, _, norm, R0, R1, R2, R3, R4, R5, R6, R7, R8 = load_axes(quats, row, there)
    sx, sy, sz = load_3(scales, row, there)
    opacity = load(opacities, row, there)
    p0, p1, p2, a0, a1, a2 = linearize(viewmat, K, width, tan_x, z, R0, R1, R2, R3, R4, R5, R6, R7, R8, 0)
    q0, q1, q2, b0, b1, b2 = linearize(viewmat, K, height, tan_y, z, R0, R1, R2, R3, R4, R5, R6, R7, R8, 1)
    u0, u1, u2, v0, v1, v2 = a0 * sx, a1 * sy, a2 * sz, b0 * sx, b1 * sy, b2 * sz
    var_x, var_y = dot(u0, u1, u2, u0, u1, u2) + low_pass, dot(v0, v1, v2, v0, v1, v2) + low_pass
    mean_x = tl.load(K) * tan_x + tl.load(K + 2)
    mean_y = tl.load(K + 4) * tan_y + tl.load(K + 5)
    reach = 2.0 * tl.log(opacity / LEAST)
    extent_x, extent_y = tl.sqrt(reach * var_x), tl.sqrt(reach * var_y)
    if ends is None:
        # A ball around the Gaussian bounds its footprint; where that overflows or is NaN, gradients would be NaN.
        most = tl.maximum(tl.maximum(sx, sy), sz)
        ball_x = dot(p0, p1, p2, p0, p1, p2) * most * most + low_pass
        ball_y = dot(q0, q1, q2, q0, q1, q2) * most * most + low_pass
        seen = there & (z > near) & (z <= LARGEST) & (reach > 0) & (norm <= LARGEST) & (tl.abs(sx + sy + sz) <= LARGEST)
        seen &= (tl.abs(mean_x) <= LARGEST) & (tl.abs(mean_y) <= LARGEST)
        seen &= (reach * ball_x <= LARGEST) & (reach * ball_y <= LARGEST) & (ball_x * ball_y <= LARGEST)
        seen &= covers_center(mean_x, extent_x, width) & covers_center(mean_y, extent_y, height)
        tl.store(kept + row, seen.to(tl.int32), mask=there)
    else:
        there &= tl.load(kept + row, mask=there, other=0) > 0
        at = tl.load(ends + row, mask=there, other=1).to(tl.int64) - 1
        # |u|^2 |v|^2 - (u.v)^2 = |u x v|^2 (Lagrange): the difference cancels for needles, the cross product does not.
        n0, n1, n2 = cross(u0, u1, u2, v0, v1, v2)
        det = dot(n0, n1, n2, n0, n1, n2) + low_pass * (var_x + var_y - low_pass)
        tl.store(means2d + 2 * at, mean_x, mask=there)
        tl.store(means2d + 2 * at + 1, mean_y, mask=there)
        store_3(conics, at, there, var_y / det, -dot(u0, u1, u2, v0, v1, v2) / det, var_x / det)
        tl.store(depths + at, z, mask=there)
        tl.store(out_opacities + at, opacity, mask=there)
        tl.store(extents + 2 * at, extent_x, mask=there)
        tl.store(extents + 2 * at + 1, extent_y, mask=there)
        tl.store(index + at, row, mask=there)


@triton.jit
def slope_of_point(viewmat, K, size, tangent, z, g0, g1, g2, g_mean, AXIS: tl.constexpr):
    """The slopes in x (or y) and in z of the camera's frame, given those in row AXIS of J W and in the projected mean."""
    focal, at = limit(K, size, tangent, AXIS)
    j = focal / z
    g_j, g_jz = turn(viewmat, g0, g1, g2, AXIS), turn(viewmat, g0, g1, g2, 2)
    g_tangent = focal * g_mean - tl.where(at == tangent, j * g_jz, 0.0)  # beyond the limits J does not move
    return g_tangent / z, -(j * (g_j - at * g_jz) + g_tangent * tangent) / z


@triton.jit
def slope_of_quat(w, x, y, z, p0, p1, p2, q0, q1, q2, gu0, gu1, gu2, gv0, gv1, gv2):
    """The slopes in a quaternion: sums and differences across the diagonal of those in its matrix, p_i gu_k + q_i gv_k."""
    g0, g4, g8 = p0 * gu0 + q0 * gv0, p1 * gu1 + q1 * gv1, p2 * gu2 + q2 * gv2
    g1, g3 = p0 * gu1 + q0 * gv1, p1 * gu0 + q1 * gv0
    g2, g6 = p0 * gu2 + q0 * gv2, p2 * gu0 + q2 * gv0
    g5, g7 = p1 * gu2 + q1 * gv2, p2 * gu1 + q2 * gv1
    g_w = 2.0 * (x * (g7 - g5) + y * (g2 - g6) + z * (g3 - g1))
    g_x = 2.0 * (w * (g7 - g5) + y * (g3 + g1) + z * (g2 + g6) - 2.0 * x * (g4 + g8))
    g_y = 2.0 * (w * (g2 - g6) + x * (g3 + g1) + z * (g7 + g5) - 2.0 * y * (g0 + g8))
    return g_w, g_x, g_y, 2.0 * (w * (g3 - g1) + x * (g2 + g6) + y * (g7 + g5) - 2.0 * z * (g0 + g4))


@triton.jit(do_not_specialize=NUMBERS)
def differentiate_projection_kernel(
    means, quats, scales, viewmat, K, kept, ends,
    grad_means2d, grad_conics, grad_depths, grad_opacities,
    out_means, out_quats, out_scales, out_opacities,
    count, width, height, low_pass, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the gradients of all `count` Gaussians: zero for those that are not visible."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    there = inside & (tl.load(kept + row, mask=inside, other=0) > 0)
    at = tl.load(ends + row, mask=there, other=1).to(tl.int64) - 1
    tan_x, tan_y, z = place(viewmat, means, row, there)
    tan_x, tan_y, z = tl.where(there, tan_x, 0.0), tl.where(there, tan_y, 0.0), tl.where(there, z, 1.0)
    w, x, y, qz, norm, R0, R1, R2, R3, R4, R5, R6, R7, R8 = load_axes(quats, row, there)
    sx, sy, sz = load_3(scales, row, there)
    p0, p1, p2, a0, a1, a2 = linearize(viewmat, K, width, tan_x, z, R0, R1, R2, R3, R4, R5, R6, R7, R8, 0)
    q0, q1, q2, b0, b1, b2 = linearize(viewmat, K, height, tan_y, z, R0, R1, R2, R3, R4, R5, R6, R7, R8, 1)
    u0, u1, u2, v0, v1, v2 = a0 * sx, a1 * sy, a2 * sz, b0 * sx, b1 * sy, b2 * sz

    # of the conic (|v|^2 + l, -u.v, |u|^2 + l) / D, D = |u x v|^2 + l (|u|^2 + |v|^2) + l^2; dD/du = 2 v x (u x v) + 2 l u
    var_x, var_y = dot(u0, u1, u2, u0, u1, u2) + low_pass, dot(v0, v1, v2, v0, v1, v2) + low_pass
    n0, n1, n2 = cross(u0, u1, u2, v0, v1, v2)
    det = dot(n0, n1, n2, n0, n1, n2) + low_pass * (var_x + var_y - low_pass)
    det = tl.where(there, det, 1.0)
    g_vv, g_uv, g_uu = load_3(grad_conics, at, there)
    g_vv, g_uv, g_uu = g_vv / det, -g_uv / det, g_uu / det
    g_det = -(g_vv * var_y + g_uv * dot(u0, u1, u2, v0, v1, v2) + g_uu * var_x) / det
    along_u, along_v, g_det2 = 2.0 * (g_uu + g_det * low_pass), 2.0 * (g_vv + g_det * low_pass), 2.0 * g_det
    c0, c1, c2 = cross(v0, v1, v2, n0, n1, n2)
    d0, d1, d2 = cross(n0, n1, n2, u0, u1, u2)
    gu0, gv0 = along_u * u0 + g_uv * v0 + g_det2 * c0, along_v * v0 + g_uv * u0 + g_det2 * d0
    gu1, gv1 = along_u * u1 + g_uv * v1 + g_det2 * c1, along_v * v1 + g_uv * u1 + g_det2 * d1
    gu2, gv2 = along_u * u2 + g_uv * v2 + g_det2 * c2, along_v * v2 + g_uv * u2 + g_det2 * d2
    store_3(out_scales, row, inside, gu0 * a0 + gv0 * b0, gu1 * a1 + gv1 * b1, gu2 * a2 + gv2 * b2)
    gu0, gu1, gu2, gv0, gv1, gv2 = gu0 * sx, gu1 * sy, gu2 * sz, gv0 * sx, gv1 * sy, gv2 * sz

    # of the rotation
    g_w, g_x, g_y, g_z = slope_of_quat(w, x, y, qz, p0, p1, p2, q0, q1, q2, gu0, gu1, gu2, gv0, gv1, gv2)
    # A quaternion of unit norm cannot grow; one that is divided by the floor can.
    radial = tl.where(norm >= QUAT_FLOOR, g_w * w + g_x * x + g_y * y + g_z * qz, 0.0)
    norm = tl.maximum(norm, QUAT_FLOOR)
    tl.store(out_quats + 4 * row, (g_w - radial * w) / norm, mask=inside)
    tl.store(out_quats + 4 * row + 1, (g_x - radial * x) / norm, mask=inside)
    tl.store(out_quats + 4 * row + 2, (g_y - radial * y) / norm, mask=inside)
    tl.store(out_quats + 4 * row + 3, (g_z - radial * qz) / norm, mask=inside)

    # of J W, and with the projected mean of the mean
    h0, h1, h2 = dot(gu0, gu1, gu2, R0, R1, R2), dot(gu0, gu1, gu2, R3, R4, R5), dot(gu0, gu1, gu2, R6, R7, R8)
    k0, k1, k2 = dot(gv0, gv1, gv2, R0, R1, R2), dot(gv0, gv1, gv2, R3, R4, R5), dot(gv0, gv1, gv2, R6, R7, R8)
    g_mean_x, g_mean_y = load(grad_means2d, 2 * at, there), load(grad_means2d, 2 * at + 1, there)
    cam_x, z_of_x = slope_of_point(viewmat, K, width, tan_x, z, h0, h1, h2, g_mean_x, 0)
    cam_y, z_of_y = slope_of_point(viewmat, K, height, tan_y, z, k0, k1, k2, g_mean_y, 1)
    cam_z = z_of_x + z_of_y + load(grad_depths, at, there)
    store_3(
        out_means, row, inside,
        turn(viewmat, cam_x, cam_y, cam_z, 0, BACK=True),
        turn(viewmat, cam_x, cam_y, cam_z, 1, BACK=True),
        turn(viewmat, cam_x, cam_y, cam_z, 2, BACK=True),
    )  # fmt: skip
    tl.store(out_opacities + row, load(grad_opacities, at, there), mask=inside)
