"""Cameras along a smooth path through given cameras, or once around a scene: its size, and the direction that is up in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import cos, hypot, pi, radians, sin, tan
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.conversions import Rt_to_matrix4x4
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from .._arrays import Array
from .._card import short_repr
from .._check import ORIGIN, as_array, as_origin, as_tensor, check_range, check_shapes, check_size, check_whole
from .._rows import check_finite
from .camera import UP, Camera, unit_vector
from .projection import as_cameras
from .resample import fits_aspect

SAME = 1e-9  # successive views closer than this, in position and direction, are the same view
STANDING = 1e-6  # of the coordinates: cameras on one tripod differ by the rounding of float32
LEVEL = 0.05  # if the pictures' x axes spread less than this in their second direction, they do not determine "up"


def path_cameras(
    cameras: Sequence[Camera], frames: int = 150, *, every: int = 1, size: tuple[int, int] | None = None
) -> list[Camera]:
    """Cameras along a smooth path through given cameras (the keys), in the order given.

    Centres lie on a cubic spline and rotations on a cubic rotation spline (scipy's `RotationSpline`; kornia's
    `Quaternion.slerp` would jerk at every key). Both pass through every key. The pace is even: the time between two keys is
    hypot(distance / extent, angle / pi).

    Args:
        cameras: at least two different ones, in the order of the path (pictures of a video by name).
        frames: the number of cameras to return. The first and last stand at the first and last key.
        every: take only every N-th camera as a key, and the last one. A hand-held video of 200 pictures trembles less with 10.
        size: (height, width) in pixels; None: that of the first camera. A key of another shape stays complete, in the middle.

    Returns:
        Pinhole cameras, `path_0000` and so on, with the smallest `near` of all. Focal lengths and principal points change
        linearly between the keys. A ValueError if there are fewer than two different views.
    """
    from scipy.interpolate import CubicSpline  # takes a third of a second, which every command would wait

    check_whole("frames", frames, 2)
    check_whole("every", every, 1)
    views = as_cameras(cameras, advice := "pass the cameras of the scene in the order of the path")
    views = [view.with_origin(views[0].origin).to(torch.float64) for view in views]
    keys = [*views[::every], *([views[-1]] if (len(views) - 1) % every else [])]
    centers, turns = (np.stack([as_array(getattr(key, name)) for key in keys]) for name in ("center", "R"))
    rotations = Rotation.from_matrix(turns)
    new = np.array([True, *(_durations(centers, rotations) > SAME)])
    keys, centers, rotations = list(compress(keys, new)), centers[new], rotations[new]
    if len(keys) < 2:
        got = f"{len(keys)} (of {len(views)}, every {every}); {advice}"
        raise ValueError(f"cameras: expected at least two different views, got {got}")
    first = views[0].size
    check_size(size := size or first)
    keys = [(key if fits_aspect(key.size, first) else key.letterboxed(*first)).resized(*size) for key in keys]
    key_times = np.concatenate([[0.0], np.cumsum(_durations(centers, rotations))])
    times = np.linspace(0, key_times[-1], frames)
    R = RotationSpline(key_times, rotations)(times).as_matrix()  # [frames, 3, 3] world to camera
    t = -R @ CubicSpline(key_times, centers)(times)[..., None]  # t = -R c
    viewmats = Rt_to_matrix4x4(torch.from_numpy(R), torch.from_numpy(t))
    key_Ks = np.stack([as_array(key.K).reshape(9) for key in keys], axis=1)  # [9, k]
    Ks = np.stack([np.interp(times, key_times, row) for row in key_Ks], axis=1).reshape(-1, 3, 3)
    near, origin = min(view.near for view in views), views[0].origin
    pairs = enumerate(zip(viewmats, torch.from_numpy(Ks), strict=True))
    return [Camera(*pair, size[1], size[0], f"path_{i:04d}", near=near, origin=origin) for i, pair in pairs]


def _durations(centers: Array, rotations: Rotation) -> Array:  # [k - 1]
    """Time from each key to the next: hypot(distance / extent, angle / pi)."""
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    extent = extent if extent > STANDING * np.abs(centers).max() else 1.0
    angles = (rotations[1:] * rotations[:-1].inv()).magnitude()
    return np.hypot(np.linalg.norm(np.diff(centers, axis=0), axis=1) / extent, angles / np.pi)


@dataclass(frozen=True)
class Orbit:
    """How cameras go around a scene."""

    frames: int = 72
    """Number of cameras; 72 are 5 degrees apart."""
    size: tuple[int, int] = (360, 480)
    """(height, width) in pixels."""
    elevation_degrees: float = 25.0
    """Angle above the horizon, seen from the middle, in (-90, 90)."""
    fov_degrees: float = 40.0
    """Vertical field of view."""
    zoom: float = 1.0
    """With 1 the sphere around the robust box of the scene fits the picture; 2 halves the distance."""
    cut: float = 0.0
    """Share of the way from the front of the sphere to its middle that is not drawn, so that walls do not hide a room.
    To look in from above, leave the ceiling out of the cloud: `gaussians.select(gaussians.labels != ceiling)`."""

    def __post_init__(self) -> None:
        check_whole("frames", self.frames, 1)
        check_size(self.size)
        check_range("elevation_degrees", self.elevation_degrees, -90, 90, closed=(False, False))
        check_range("zoom", self.zoom, 0, closed=(False, False))
        check_range("cut", self.cut, 0, 1)


class Bounds(NamedTuple):
    """The box of most points of a cloud, in world units."""

    low: Tensor  # [3] lower corner
    high: Tensor  # [3] upper corner
    inside: Tensor  # [P] bool, which points lie in the box

    def __repr__(self) -> str:
        return short_repr(self)


def robust_bounds(points: Tensor, *, coverage: float = 0.98, margin: float = 0.1) -> Bounds:  # [P, 3]
    """The axis-aligned box of the central `coverage` of the points along each axis, widened by `margin` of its size.

    SfM clouds have points far behind every wall (in Replica's room_0, a room of about 8 m, one is 139 m away), so the
    minimum and maximum are useless. A ValueError if there are no points.
    """
    check_shapes(("points", points := as_tensor("points", points), "P 3"))
    check_range("coverage", coverage, 0, 1, closed=(False, True))
    check_range("margin", margin, 0)
    if len(points) == 0:
        raise ValueError("points: expected at least one point, got none; give the scene a point cloud first")
    ordered = points.detach().sort(0).values  # torch.quantile refuses more than 16 million values
    last = len(points) - 1
    left_out = int(last * (1 - coverage) / 2)
    low, high = ordered[left_out], ordered[last - left_out]
    pad = (high - low) * margin
    low, high = low - pad, high + pad
    inside = ((points.detach() >= low) & (points.detach() <= high)).all(-1)
    return Bounds(low, high, inside)


def camera_extent(cameras: Sequence[Camera], points: Tensor) -> float:  # [P, 3]
    """1.1 times the largest distance of a camera from the cameras' mean, in world units: the size of a scene in 3DGS.

    If all cameras stand in one place, it is the median distance to the points, or 1 without points.
    """
    views = as_cameras(cameras, "the extent of an empty scene is unknown")
    centers = torch.stack([view.center.detach().double().cpu() for view in views])
    mean = centers.mean(0)
    radius = 1.1 * float((centers - mean).norm(dim=-1).max())
    if radius > 1e-6 * (1 + float(mean.norm())):
        return radius
    return float((points.detach().double().cpu() - mean).norm(dim=-1).median()) if len(points) else 1.0


def estimate_up(cameras: Sequence[Camera]) -> Tensor:  # [3] float64, unit
    """Estimate the up direction of the world from the cameras.

    People hold cameras level: the x axes of the pictures are horizontal in whatever direction they look. So up is the
    direction that is most nearly perpendicular to all of them (least eigenvector of sum x x^T), on the side of the upper
    edges. If all cameras look in one direction, up is the mean direction from the lower to the upper edges. A ValueError if there
    are no cameras, or their upper edges cancel.
    """
    views = as_cameras(cameras, advice := "give up as a vector instead")
    R = torch.stack([camera.viewmat[:3, :3].detach().double().cpu() for camera in views])
    right, mean_up = R[:, 0], -R[:, 1].mean(0)
    if float(mean_up.norm()) < LEVEL:
        got = f"{len(views)} whose upper edges cancel; {advice}"
        raise ValueError(f"cameras: expected pictures that are held upright, got {got}")
    values, vectors = torch.linalg.eigh(right.T @ right / len(right))
    if float(values[1]) < LEVEL:
        return mean_up / mean_up.norm()
    up = vectors[:, 0]
    return up * torch.sign(up @ mean_up)


def orbit_cameras(
    points: Tensor,  # [N, 3]
    orbit: Orbit | None = None,
    *,
    up: Tensor | Sequence[float] = UP,  # [3]
    origin: Sequence[float] = ORIGIN,  # [3]
) -> list[Camera]:
    """Cameras on a circle of constant elevation around a cloud, all looking at its middle.

    The middle is that of the box of the central 96 % of the points (`robust_bounds`), which a few points far outside do
    not change. Seen from above, the cameras go counter-clockwise.

    Args:
        points: the cloud, usually `gaussians.means`.
        orbit: number of cameras, size, elevation, ...; None: the defaults of `Orbit`.
        up: the world's up, see `Camera.look_at`.
        origin: that the points are counted from, `gaussians.origin`.
    """
    orbit = orbit or Orbit()
    cloud = as_tensor("points", points).detach().double().cpu()
    check_finite("points", cloud)
    low, high, _ = robust_bounds(cloud, coverage=0.96, margin=0.0)
    center, radius = (low + high) / 2, float((high - low).norm()) / 2 or 1.0  # 1 if all are in one place
    height, width = orbit.size
    half = min(height, width) / height * tan(radians(orbit.fov_degrees) / 2)  # tangent of half the narrower angle
    distance = radius * hypot(1, half) / half / orbit.zoom  # the sphere touches the nearer edges
    near = max(distance - radius * (1 - orbit.cut), 1e-3 * distance)
    zenith = unit_vector("up", up)
    axis = torch.eye(3, dtype=torch.float64)[int(zenith[0].abs() > 0.9)]  # azimuth 0 is x, or y where x is nearly up
    north = unit_vector("north", torch.linalg.cross(zenith, axis))
    east, e = torch.linalg.cross(north, zenith), radians(orbit.elevation_degrees)
    cameras = []
    for number, a in enumerate(np.linspace(0, 2 * pi, orbit.frames, endpoint=False)):
        outward = cos(e) * (cos(a) * east + sin(a) * north) + sin(e) * zenith
        view = Camera.look_at(
            center + distance * outward, center, up=zenith, fov_degrees=orbit.fov_degrees,
            width=width, height=height, name=f"orbit_{number:04d}", near=near,
        )  # fmt: skip
        cameras.append(replace(view, origin=as_origin(origin)))
    return cameras
