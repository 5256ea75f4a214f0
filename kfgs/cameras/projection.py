"""Convert points between the world, the frame of the camera and its pixels (through the lens); cameras to kornia's and back.

The convention is `Camera`'s. The camera's matrices follow the dtype and device of the points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import PinholeCamera, distort_points_affine, distort_points_kannala_brandt
from kornia.geometry.conversions import convert_points_from_homogeneous
from kornia.geometry.depth import depth_to_3d_v2
from torch import Tensor

from .._check import as_tensor, check_range, check_shapes
from .camera import Camera, Distortion

MAX_SLOPE = 1e4  # |x / z| beyond which a distorted point is clamped (89.99 degrees): r^6 must not overflow float32


def world_to_camera(camera: Camera, points: Tensor) -> Tensor:  # points: [N, 3] -> [N, 3]
    """Express world points in the camera's frame: R X + t.

    Written out because kornia's `transform_points` divides by a homogeneous coordinate that is always 1 here, and takes
    twice as long.
    """
    check_shapes(("points", points := as_tensor("points", points, floating=True), "N 3"))
    return points @ camera.R.to(points).T + camera.t.to(points)


def camera_to_pixel(camera: Camera, points_cam: Tensor) -> Tensor:  # points_cam: [N, 3] -> [N, 2]
    """Project points of the camera's frame to pixels (x, y), through the lens if the camera has one.

    A point behind the camera gives an ordinary-looking pixel, so mask by depth *before* calling (`project_points` does). At
    z = 0 the division is skipped: the result is finite, and means nothing.
    """
    plane = convert_points_from_homogeneous(points_cam)  # finite at z = 0, where project_points_z1 is not
    return plane_to_pixel(plane, camera.K.to(points_cam), camera.distortion)


def plane_to_pixel(
    plane: Tensor,  # [..., 2] points (x / z, y / z)
    K: Tensor,  # [3, 3]
    distortion: Distortion | None = None,
) -> Tensor:  # [..., 2]
    """Map points of the z = 1 plane to pixels: u = fx D(x, y)_x + cx, v = fy D(x, y)_y + cy, with D the lens.

    D is kornia's `distort_points` or `distort_points_kannala_brandt`, which agree with COLMAP's camera models. K decides where
    pixel centres are. With a lens, slopes are clamped at 1e4, so that a point at the camera's side gives a large number
    instead of NaN.
    """
    intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    if distortion is None:
        return distort_points_affine(plane, intrinsics)
    coefficients = torch.tensor(distortion.coefficients, dtype=plane.dtype, device=plane.device)
    plane = plane.clamp(-MAX_SLOPE, MAX_SLOPE)
    if distortion.model == "kannala_brandt":
        return distort_points_kannala_brandt(plane, torch.cat([intrinsics, coefficients]))
    identity = torch.eye(3, dtype=K.dtype, device=K.device)
    return distort_points(plane.reshape(-1, 2), K, coefficients, new_K=identity).reshape(plane.shape)


def fold_radius(distortion: Distortion) -> float:
    """Radius on the z = 1 plane from which the radial polynomial runs backwards (infinity if it never does).

    Beyond it the model maps far off-axis points *into* the picture a second time, so they must not count as visible.
    It is the first positive root of the derivative of the distorted radius,
    r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), or for the fisheye of
    theta (1 + k1 theta^2 + ... + k4 theta^8) with r = tan(theta); tangential terms are ignored.
    """
    if distortion.model == "kannala_brandt":
        k1, k2, k3, k4 = distortion.coefficients
        theta = math.sqrt(_first_positive_root(np.array([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])))
        return math.tan(theta) if theta < math.pi / 2 else math.inf
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion.coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    s = np.polynomial.Polynomial([0, 1])  # r^2
    numerator = np.polynomial.Polynomial([1, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1, k4, k5, k6])
    slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
    return math.sqrt(min(_first_positive_root(slope.coef), _first_positive_root(denominator.coef)))


def _first_positive_root(coefficients: np.ndarray) -> float:
    """Smallest positive real root of a polynomial given from the constant term up; infinity if there is none."""
    roots = np.polynomial.polynomial.polyroots(coefficients)
    real = roots.real[np.abs(roots.imag) < 1e-9]
    return float(min(real[real > 0], default=math.inf))


def project_points(
    camera: Camera,
    points: Tensor,  # [N, 3] world
    *,
    near: float = 1e-6,
) -> tuple[Tensor, Tensor, Tensor]:  # [N, 2], [N], [N] bool
    """Project world points to pixels and decide which of them the camera sees.

    Depth is tested before projecting, so a point behind the camera never counts as visible. With a lens, a point so far
    off-axis that the lens model folds it back into the picture (`fold_radius`) is not visible.

    Args:
        camera: the camera; its distortion is applied.
        points: world coordinates; NaN and infinity count as not visible.
        near: depth that a point must exceed, in world units; `camera.near` is for drawing and is not used here.

    Returns:
        Pixels (x, y), with (0, 0) for points not in front of the camera; depths along the optical axis, in world units; and
        the mask of points in front and inside the picture (0 <= x < width, 0 <= y < height). Occlusion is not considered.

    Example:
        >>> camera = Camera(torch.eye(4), torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]), 64, 48)
        >>> xy, depth, visible = project_points(camera, torch.tensor([[0.2, 0.1, 2.0], [0.2, 0.1, -2.0]]))
        >>> visible.tolist(), xy[0].tolist()
        ([True, False], [42.0, 29.0])
    """
    check_range("near", near, 0)
    points_cam = world_to_camera(camera, points)
    depth = points_cam[:, 2]
    front = ((depth > near) & torch.isfinite(points_cam).all(dim=1)).nonzero()[:, 0]
    seen = points_cam[front]
    pixels = camera_to_pixel(camera, seen)
    inside = (pixels >= 0).all(dim=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    if camera.distortion is not None:
        inside &= seen[:, :2].norm(dim=1) < fold_radius(camera.distortion) * seen[:, 2]
    xy = points_cam.new_zeros(len(points), 2).index_put((front,), pixels)
    visible = torch.zeros_like(depth, dtype=torch.bool).index_put((front,), inside)
    return xy, depth, visible


def unproject_depth(camera: Camera, depth: Tensor) -> Tensor:  # depth: [H, W] -> [H, W, 3] world
    """Lift a depth map (along the optical axis, in world units) to one world point per pixel centre.

    A pixel of depth 0 (often "unknown") gives the centre of the camera: mask it.
    """
    check_shapes(("depth", depth := as_tensor("depth", depth, floating=True), (camera.height, camera.width)))
    refuse_distortion(camera)
    K = camera.intrinsics_at_integer_centers.to(depth)  # kornia's pixel grid counts from 0, not from 0.5
    return (depth_to_3d_v2(depth, K[None])[0] - camera.t.to(depth)) @ camera.R.to(depth)  # R^T (X - t)


def refuse_distortion(camera: Camera) -> None:
    """Raise a ValueError if a camera has a lens."""
    if camera.distortion is not None:
        got = f"{camera.distortion.model} distortion (camera {camera.name!r})"
        advice = "undistort its images first (kfgs.cameras.undistort) and use the camera that returns"
        raise ValueError(f"camera: expected a pinhole camera, got {got}; {advice}")


def to_kornia(cameras: Sequence[Camera]) -> PinholeCamera:
    """Stack cameras into one kornia `PinholeCamera` of batch B = len(cameras).

    **Convention**: both libraries map world to camera with x right, y down, z forward, and both project by K (R X + t):
    K decides where pixel centres are. kfgs's K puts the centre of the first pixel at (0.5, 0.5), so `project` gives the
    pixels of `project_points`. Functions of kornia that make their own pixel grid (`create_meshgrid`, `DepthWarper`,
    `remap`) put that centre at (0, 0): subtract 0.5 from cx and cy for them.

    Returns:
        `intrinsics` and `extrinsics` [B, 4, 4] in the widest dtype, `height` and `width` [B] int64, counted from the origin
        of the first camera. Names, `near` and that origin are lost. `project` does not test for front and border. A
        ValueError if there is no camera, or one has distortion.

    Example:
        >>> camera = Camera(torch.eye(4), torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]), 64, 48)
        >>> to_kornia([camera]).project(torch.tensor([[[0.2, 0.1, 2.0]]]))
        tensor([[[42., 29.]]])
    """
    if not (cameras := getattr(cameras, "cameras", cameras)):
        raise ValueError("cameras: expected at least one Camera, got none; select a view that the scene has")
    cameras = [camera.with_origin(cameras[0].origin) for camera in cameras]
    for camera in cameras:
        refuse_distortion(camera)
    viewmats, Ks = (torch.stack([getattr(camera, name) for camera in cameras]) for name in ("viewmat", "K"))
    dtype = torch.promote_types(viewmats.dtype, Ks.dtype)
    intrinsics = torch.eye(4, dtype=dtype, device=viewmats.device).repeat(len(cameras), 1, 1)
    intrinsics[:, :3, :3] = Ks
    sizes = torch.tensor([camera.size for camera in cameras], device=viewmats.device)
    return PinholeCamera(intrinsics, viewmats.to(dtype), height=sizes[:, 0], width=sizes[:, 1])


def from_kornia(pinhole: PinholeCamera) -> list[Camera]:
    """The cameras of a kornia batch, one by one: the inverse of `to_kornia`.

    Of `intrinsics` only the upper left 3 x 3 is read, as kornia does, and it is not changed. kornia's documentation puts pixel
    centres on integers: add 0.5 to cx and cy of such a K first. A K from COLMAP has them on halves already.
    """
    count = pinhole.batch_size
    check_shapes(*((f"pinhole.{name}", getattr(pinhole, name), (count, 4, 4)) for name in ("intrinsics", "extrinsics")))
    viewmats, Ks = pinhole.extrinsics.clone(), pinhole.camera_matrix.clone()  # kornia's scale_ changes them in place
    rows = zip(viewmats, Ks, pinhole.width.tolist(), pinhole.height.tolist(), strict=True)
    return [Camera(*row) for row in rows]
