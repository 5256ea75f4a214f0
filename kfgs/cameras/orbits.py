"""Cameras that go once around a scene, and the direction that is up in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, pi, radians, sin, tan

import torch
from torch import Tensor

from .._check import ORIGIN, as_origin, check_range, check_shapes, check_size, check_whole
from .._typed import typed
from .bounds import robust_bounds
from .camera import UP, Camera, unit_vector

LEVEL = 0.05  # if the pictures' x axes spread less than this in their second direction, they do not determine "up"


@dataclass(frozen=True)
class Orbit:
    """How cameras go around a scene."""

    frames: int = 72
    """Number of cameras; 72 are 5 degrees apart."""
    size: tuple[int, int] = (360, 480)
    """(height, width) in pixels."""
    elevation_degrees: float = 25.0
    """Angle above the horizon, seen from the middle, in (-90, 90)."""
    start_degrees: float = 0.0
    """Direction of the first camera from the middle, counter-clockwise seen from above."""
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
        check_range("start_degrees", self.start_degrees, float("-inf"))
        check_range("fov_degrees", self.fov_degrees, 0, 180, closed=(False, False))
        check_range("zoom", self.zoom, 0, closed=(False, False))
        check_range("cut", self.cut, 0, 1)


@typed
def estimate_up(cameras: Sequence[Camera]) -> Tensor:  # [3] float64, unit
    """Estimate the up direction of the world from the cameras.

    People hold cameras level: the x axes of the pictures are horizontal in whatever direction they look. So up is the
    direction that is most nearly perpendicular to all of them (least eigenvector of sum x x^T), on the side of the upper
    edges. If all cameras look in one direction, the x axes do not determine it, and up is the mean of the pictures' y axes.

    Raises:
        ValueError: if there are no cameras, or their upper edges point in all directions and cancel.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one camera, got none; give up as a vector instead")
    R = torch.stack([camera.viewmat[:3, :3].detach().double().cpu() for camera in cameras])
    right, mean = R[:, 0], -R[:, 1].mean(0)
    if float(mean.norm()) < LEVEL:
        raise ValueError(
            f"cameras: expected pictures that are held upright, got {len(cameras)} whose upper edges cancel; give up as a "
            "vector instead"
        )
    values, vectors = torch.linalg.eigh(right.T @ right / len(right))
    if float(values[1]) < LEVEL:
        return mean / mean.norm()
    up = vectors[:, 0]
    return up * torch.sign(up @ mean)


@typed
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
        up: the world's up. COLMAP's worlds often have no axis that points up: pass `estimate_up(scene.cameras)`.
        origin: that the points are counted from, `gaussians.origin`.

    Raises:
        ValueError: if there are no points, one is not finite, or `up` has no direction.
    """
    check_shapes(("points", points, "N 3"))
    orbit = orbit or Orbit()
    cloud = points.detach().double().cpu()
    if not bool(cloud.isfinite().all()):
        raise ValueError(
            f"points: expected finite positions, got {int((~cloud.isfinite()).any(1).sum())} rows with NaN or infinity; "
            "remove them first"
        )
    bounds = robust_bounds(cloud, coverage=0.96, margin=0.0)
    center, radius = (bounds.low + bounds.high) / 2, float((bounds.high - bounds.low).norm()) / 2
    radius = radius or 1.0  # all in one place
    height, width = orbit.size
    half = min(height, width) / height * tan(radians(orbit.fov_degrees) / 2)  # tangent of half the narrower angle
    distance = radius * hypot(1, half) / half / orbit.zoom  # the sphere touches the nearer edges
    near = max(distance - radius * (1 - orbit.cut), 1e-3 * distance)
    zenith = unit_vector("up", up)
    axis = torch.eye(3, dtype=torch.float64)[int(zenith[0].abs() > 0.9)]  # azimuth 0 is x, or y where x is nearly up
    north = torch.linalg.cross(zenith, axis)
    north /= north.norm()
    east, e = torch.linalg.cross(north, zenith), radians(orbit.elevation_degrees)
    cameras = []
    for number in range(orbit.frames):
        a = radians(orbit.start_degrees) + 2 * pi * number / orbit.frames
        outward = cos(e) * (cos(a) * east + sin(a) * north) + sin(e) * zenith
        view = Camera.look_at(
            center + distance * outward, center, up=zenith, fov_degrees=orbit.fov_degrees,
            width=width, height=height, name=f"orbit_{number:04d}", near=near,
        )  # fmt: skip
        cameras.append(replace(view, origin=as_origin(origin)))
    return cameras
