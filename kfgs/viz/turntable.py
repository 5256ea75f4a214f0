"""A turntable: the scene seen from a circle of cameras around its middle, as if it turned before the eye."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, pi, radians, sin, tan
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._check import check_range, check_shapes, check_whole
from ..cameras import Camera
from ..gaussians import Gaussians
from ..scenes.points import robust_bounds
from .animation import Progress, check_size, save_animation
from .film_frames import Show

Array = np.ndarray[Any, Any]
LEVEL = 0.05  # of all: less spread of the pictures' x axes than this, in their second direction, leaves "up" open
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Orbit:
    """How the cameras of a turntable go round."""

    frames: int = 72
    """Pictures of one round: every 5 degrees."""
    size: tuple[int, int] = (360, 480)
    """(height, width) in pixels."""
    elevation_degrees: float = 25.0
    """Above the horizon through the middle, in (-90, 90)."""
    start_degrees: float = 0.0
    """Where the first camera stands, counter-clockwise seen from above."""
    fov_degrees: float = 40.0
    """Vertical field of view."""
    zoom: float = 1.0
    """At 1 the sphere around the scene's robust box fits the picture; 2 halves the distance."""
    cut: float = 0.0
    """Share of the way from the sphere's front to its middle that is not drawn: opens a room whose walls hide it.
    A lid is better left out of the cloud: `gaussians.select(gaussians.labels != ceiling)`."""

    def __post_init__(self) -> None:
        check_whole("frames", self.frames, 1)
        check_size(self.size)
        check_range("elevation_degrees", self.elevation_degrees, -90, 90, closed=(False, False))
        check_range("start_degrees", self.start_degrees, float("-inf"))
        check_range("fov_degrees", self.fov_degrees, 0, 180, closed=(False, False))
        check_range("zoom", self.zoom, 0, closed=(False, False))
        check_range("cut", self.cut, 0, 1)


def estimate_up(cameras: Sequence[Camera]) -> Tensor:  # [3] float64, unit
    """Estimate the up direction of the world from the cameras.

    People hold cameras level: the pictures' x axes are horizontal, wherever they look and however far down, so up is the
    direction least along any of them (least eigenvector of sum x x^T), on the side of the pictures' upper edges. Where
    all look the same way, the x axes leave it open, and up is the mean of the pictures' own.

    Raises:
        ValueError: if there are no cameras, or their upper edges point everywhere and cancel.
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


def orbit_cameras(
    points: Tensor,  # [N, 3]
    orbit: Orbit | None = None,
    *,
    up: Tensor | Sequence[float] | None = None,  # [3]
) -> list[Camera]:
    """Cameras on a circle of constant elevation around a cloud, all looking at its middle.

    The middle is that of the box of the central 96 % of the points (`robust_bounds`): a few points far outside do not
    move it. Seen from above, the cameras go counter-clockwise.

    Args:
        points: the cloud, usually `gaussians.means`.
        orbit: how they go round.
        up: the world's up (`estimate_up`); None: +z. COLMAP's worlds often have none of their axes upward.

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
    focal = height / 2 / tan(radians(orbit.fov_degrees) / 2)
    half = min(height, width) / 2
    distance = radius * hypot(focal, half) / half / orbit.zoom  # the sphere touches the nearer edges
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    near = max(distance - radius * (1 - orbit.cut), 1e-3 * distance)
    east, north, zenith = _frame(up)
    e = radians(orbit.elevation_degrees)
    cameras = []
    for number in range(orbit.frames):
        a = radians(orbit.start_degrees) + 2 * pi * number / orbit.frames
        outward = cos(e) * (cos(a) * east + sin(a) * north) + sin(e) * zenith
        right = -sin(a) * east + cos(a) * north
        R = torch.stack([right, torch.linalg.cross(-outward, right), -outward])  # x right, y down, z forward
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ (center + distance * outward)
        cameras.append(Camera(viewmat, K, width, height, name=f"orbit_{number:04d}", near=near))
    return cameras


def _frame(up: Tensor | Sequence[float] | None) -> tuple[Tensor, Tensor, Tensor]:
    """Right-handed horizontal axes and the vertical one; azimuth 0 is x where x is horizontal."""
    vector = torch.as_tensor(UP if up is None else up).detach().double().cpu()
    check_shapes(("up", vector, "3"))
    length = float(vector.norm())
    if not 0 < length < float("inf"):
        raise ValueError(f"up: expected a vector with a direction, got {vector.tolist()}; for instance (0, 0, 1)")
    zenith = vector / length
    axis = torch.zeros(3, dtype=torch.float64)
    axis[int(zenith[0].abs() > 0.9)] = 1.0  # x, or y where x is nearly up
    east = axis - (axis @ zenith) * zenith
    east = east / east.norm()
    return east, torch.linalg.cross(zenith, east), zenith


def save_turntable(
    path: str | Path,
    shows: Gaussians | Mapping[str, Gaussians | Show],
    *,
    orbit: Orbit | None = None,
    up: Tensor | Sequence[float] | None = None,  # [3]
    cameras: Sequence[Camera] | None = None,
    fps: float = 15.0,
    names: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one round about a scene as a GIF or MP4 that can be played for ever.

    A GIF takes about 60 kB a frame of 360x480 of textured colours, and 40 kB of labels: `orbit` bounds both.

    Args:
        path: a name that ends in .gif or .mp4.
        shows: Gaussians, or several things by title, side by side (`save_animation`). The cameras go round the first
            Gaussians among them.
        orbit: how they go round.
        up: the world's up.
        cameras: the scene's own cameras, which tell where up is when `up` is None.
        fps: frames per second.
        names: class names for a legend below.
        progress: called after each frame with (done, all).

    Returns:
        `path`.

    Raises:
        ValueError: if nothing can be shown, or there are no Gaussians to go round (pass `orbit_cameras` to
            `save_animation` then).
        ImportError: for .mp4, where imageio-ffmpeg is not installed.
    """
    things = shows.values() if isinstance(shows, Mapping) else [shows]
    cloud = next((thing for thing in things if isinstance(thing, Gaussians)), None)
    if cloud is None:
        raise ValueError(
            "shows: expected Gaussians to go round, got only functions; pass orbit_cameras(points) to save_animation"
        )
    if up is None and cameras:
        up = estimate_up(cameras)
    return save_animation(
        path, shows, orbit_cameras(cloud.means, orbit, up=up), fps=fps, names=names, progress=progress
    )
