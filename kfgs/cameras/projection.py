"""Convert points between the world, the frame of the camera and its pixels (through the lens); cameras to kornia's and back.

The convention is `Camera`'s. The camera's matrices follow the dtype and device of the points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import Rt_to_matrix4x4, convert_points_from_homogeneous
from kornia.geometry.depth import depth_to_3d_v2
from kornia.geometry.vector import Vector2
from kornia.sensors.camera import CameraModel
from kornia.sensors.camera.projection_model import Z1Projection
from torch import Tensor

from .._check import as_tensor, check_range, check_shapes
from .camera import Camera, Distortion, DistortionModel, as_matrix, check_camera, kornia_model

Cameras: TypeAlias = Camera | Sequence[Camera | PinholeCamera] | PinholeCamera  # a Scene, a field: their `cameras`
MAX_SLOPE = 1e4  # |x / z| beyond which a distorted point is clamped (89.99 degrees): r^6 must not overflow float32


def world_to_camera(camera: Camera, points: Tensor) -> Tensor:  # points: [N, 3] -> [N, 3]
    """Express world points in the camera's frame: R X + t. kornia's `transform_points` divides by 1, and takes twice as long."""
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

    D is that of kornia's `CameraModel`, which agrees with COLMAP's camera models. K decides where pixel centres are. With a lens,
    slopes are clamped at 1e4, so that a point at the camera's side gives a large number instead of NaN.
    """
    model = kornia_model(K, distortion, (1, 1))
    plane = plane if distortion is None else plane.clamp(-MAX_SLOPE, MAX_SLOPE)
    return model.distortion.distort(model.params, Vector2(plane.reshape(-1, 2))).data.reshape(plane.shape)


def fold_radius(distortion: Distortion) -> float:
    """Radius on the z = 1 plane from which the radial polynomial runs backwards (infinity if it never does).

    Beyond it the model maps far off-axis points *into* the picture a second time, so they must not count as visible.
    It is the first positive root of the derivative of the distorted radius,
    r (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), or for the fisheye of
    theta (1 + k1 theta^2 + ... + k4 theta^8) with r = tan(theta); tangential terms are ignored.
    """
    (k1, k2, *rest), fisheye = distortion.coefficients, distortion.model == "kannala_brandt"
    s = np.polynomial.Polynomial([0, 1])  # r^2, theta^2
    P = np.polynomial.Polynomial([1, k1, k2, *(rest if fisheye else rest[2:3])])
    Q = np.polynomial.Polynomial([1, *([] if fisheye else rest[3:])])
    slope = (P + 2 * s * P.deriv()) * Q - 2 * s * P * Q.deriv()
    roots = np.concatenate([slope.roots(), Q.roots()])
    radius = math.sqrt(min((root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0), default=math.inf))
    if fisheye:
        return math.tan(radius) if radius < math.pi / 2 else math.inf
    return radius


def project_points(
    camera: Cameras,
    points: Tensor,  # [N, 3] world
    *,
    near: float = 1e-6,
) -> tuple[Tensor, Tensor, Tensor]:  # [N, 2], [N], [N] bool
    """Project world points to pixels and decide which of them the camera sees.

    Depth is tested before projecting, so a point behind the camera never counts as visible. With a lens, a point so far
    off-axis that the lens model folds it back into the picture (`fold_radius`) is not visible.

    Args:
        camera: the camera; its distortion is applied. Of several (a list, kornia's `PinholeCamera`) the results are stacked.
        points: world coordinates; NaN and infinity count as not visible. [B, N, 3]: other points for each of B cameras.
        near: depth that a point must exceed, in world units; `camera.near` is for drawing and is not used here.

    Returns:
        Pixels (x, y), with (0, 0) for points not in front of the camera; depths along the optical axis, in world units; and
        the mask of points in front and inside the picture (0 <= x < width, 0 <= y < height). Occlusion is not considered.
    """
    check_range("near", near, 0)
    if not isinstance(camera, Camera):
        views, clouds = as_cameras(camera, "project to at least one"), as_tensor("points", points)
        clouds = clouds if clouds.ndim == 3 else clouds.expand(len(views), *clouds.shape)
        check_shapes((f"points (of {len(views)} cameras)", clouds, (len(views), "N", 3)))
        columns = zip(*(project_points(*pair, near=near) for pair in zip(views, clouds, strict=True)), strict=True)
        return tuple(map(torch.stack, columns))  # type: ignore[return-value]
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
    refuse_distortion(camera)
    check_shapes(("depth", depth := as_tensor("depth", depth, floating=True), (camera.height, camera.width)))
    K = camera.intrinsics_at_integer_centers.to(depth)  # kornia's pixel grid counts from 0, not from 0.5
    return (depth_to_3d_v2(depth, K[None])[0] - camera.t.to(depth)) @ camera.R.to(depth)  # R^T (X - t)


def refuse_distortion(camera: Camera) -> None:
    """Raise a ValueError if a camera has a lens, a TypeError if it is none."""
    check_camera(camera)
    if camera.distortion is not None:
        got = f"{camera.distortion.model} distortion (camera {camera.name!r})"
        advice = "undistort its images first (kfgs.cameras.undistort) and use the camera that returns"
        raise ValueError(f"camera: expected a pinhole camera, got {got}; {advice}")


def as_cameras(cameras: Any, advice: str = "", *, one_size: bool = False) -> list[Camera]:
    """The views that a public function was given, as a list, or a TypeError.

    With `advice`, a ValueError that ends with it if there are none; with `one_size`, one if their maps could not be stacked.
    """
    given = getattr(cameras, "cameras", [cameras] if isinstance(cameras, Camera | PinholeCamera) else cameras)
    given = given if isinstance(given, Iterable) else [given]
    views = [view for part in given for view in (from_kornia(part) if isinstance(part, PinholeCamera) else [part])]
    if wrong := [view for view in views if not isinstance(view, Camera)]:
        got = f"{type(wrong[0]).__name__}; take some of scene.cameras, or convert kornia's with from_kornia"
        raise TypeError(f"cameras: expected a Camera, a list of them, a Scene or kornia's PinholeCamera, got {got}")
    if advice and not views:
        raise ValueError(f"cameras: expected at least one camera, got none; {advice}")
    if one_size and len(sizes := {view.size for view in views}) != 1:
        raise ValueError(f"cameras: expected one size, to stack what they see, got {sizes}; use camera.resized()")
    return views


def to_kornia(cameras: Cameras) -> PinholeCamera:
    """Stack cameras into one kornia `PinholeCamera` of batch B = len(cameras). `Camera.model` is kornia's camera with a lens.

    **Convention**: both libraries map world to camera with x right, y down, z forward, and project by K (R X + t), so
    `project` gives the pixels of `project_points`, without its tests for front and border. kornia's own pixel grids
    (`create_meshgrid`, `DepthWarper`, `remap`) put the centre of the first pixel at (0, 0): subtract 0.5 from cx and cy.

    Returns:
        `intrinsics` and `extrinsics` [B, 4, 4] in the widest dtype, `height` and `width` [B] int64, counted from the origin
        of the first camera. Names, `near` and that origin are lost. A ValueError if there is no camera, or one has distortion.
    """
    views = as_cameras(cameras, "select a view that the scene has")
    views = [view.with_origin(views[0].origin) for view in views]
    for view in views:
        refuse_distortion(view)
    viewmats, Ks = (torch.stack([getattr(view, name) for view in views]) for name in ("viewmat", "K"))
    dtype = torch.promote_types(viewmats.dtype, Ks.dtype)
    height, width = torch.tensor([view.size for view in views], device=viewmats.device).T
    intrinsics = Rt_to_matrix4x4(Ks, torch.zeros_like(Ks[..., :1]))  # [B, 4, 4]
    return PinholeCamera(intrinsics.to(dtype), viewmats.to(dtype), height, width)


def from_kornia(pinhole: PinholeCamera | CameraModel, pose: Any = None) -> list[Camera]:
    """The cameras of a kornia batch, one by one: the inverse of `to_kornia`, and of `Camera.model` and `Camera.pose`.

    Of `intrinsics` only the upper left 3 x 3 is read, as kornia does, and it is not changed. kornia's documentation puts pixel
    centres on integers: add 0.5 to cx and cy of such a K first. A K from COLMAP has them on halves already.

    Args:
        pinhole: a `PinholeCamera`, or a `CameraModel` (not the orthographic one), whose lens becomes numbers without gradient.
        pose: of a `CameraModel`, from world to camera: an `Se3`, a `NamedPose` or a matrix [4, 4]; None: the identity. B models
            may share a pose, and B poses (an `Se3` of batch B, a tensor [B, 4, 4]) a model.
    """
    if not isinstance(pinhole, PinholeCamera):
        if not isinstance(getattr(pinhole, "projection", None), Z1Projection):
            raise TypeError(f"pinhole: expected a PinholeCamera or a perspective CameraModel, got {pinhole!r:.120}")
        rows = pinhole.params.reshape(-1, pinhole.params.shape[-1])  # [B, 4 + coefficients], first fx, fy, cx, cy
        poses = torch.eye(4).to(rows) if pose is None else as_tensor("pose", as_matrix(pose, source="world"))
        poses = poses.expand(len(rows), 4, 4) if poses.shape in ((4, 4), (1, 4, 4)) else poses
        rows = rows.expand(len(poses), -1) if len(rows) == 1 else rows
        check_shapes(("pose", poses, (len(rows), 4, 4)))
        kind: DistortionModel = "brown_conrady" if rows.shape[1] == 12 else "kannala_brandt"
        lenses = [Distortion(kind, tuple(row[4:].tolist())) if len(row) > 4 else None for row in rows]
        Ks = torch.eye(3).to(rows).repeat(len(rows), 1, 1)
        Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]] = rows[:, :4]
        size, parts = (int(pinhole.width), int(pinhole.height)), zip(poses, Ks, lenses, strict=True)
        return [Camera(E, K, *size, distortion=lens) for E, K, lens in parts]
    if pose is not None:
        raise ValueError("pose: expected None with a PinholeCamera, got another; it has poses already, its extrinsics")
    shape = pinhole.batch_size, 4, 4
    check_shapes(*((f"pinhole.{name}", getattr(pinhole, name), shape) for name in ("intrinsics", "extrinsics")))
    viewmats, Ks = pinhole.extrinsics.clone(), pinhole.camera_matrix.clone()  # kornia's scale_ changes them in place
    return list(map(Camera, viewmats, Ks, pinhole.width.tolist(), pinhole.height.tolist()))
