"""Cameras on a small spiral around one view, looking at what it shows."""

from __future__ import annotations

from dataclasses import replace
from math import atan, cos, degrees, pi, sin

from torch import Tensor

from .._check import check_range, check_shapes, check_size, check_whole
from .._typed import typed
from .camera import Camera
from .projection import project_points


@typed
def spiral_cameras(
    camera: Camera,
    points: Tensor,  # [N, 3]
    frames: int = 72,
    *,
    size: tuple[int, int] | None = None,
    turns: int = 2,
    radius: float = 0.15,
) -> list[Camera]:
    """Cameras on a closed spiral around a view: they sway, come nearer and go back, and look at the same place.

    The place lies straight ahead, at the median depth of the points in the picture.

    Args:
        camera: the view.
        points: the cloud, usually `gaussians.means`, counted from the origin of the view.
        frames: how many cameras.
        size: (height, width) in pixels of the new cameras; None: that of the view.
        turns: how often they go around.
        radius: of the spiral, as a share of the distance to the place.

    Raises:
        ValueError: if no point is in the picture, or a number is out of range.
    """
    check_shapes(("points", points, "N 3"))
    check_whole("frames", frames, 1)
    check_whole("turns", turns, 1)
    check_range("radius", radius, 0, 1, closed=(False, False))
    height, width = size or camera.size
    check_size((height, width))
    _, depths, inside = project_points(camera, points.detach().double().cpu(), near=camera.near)
    if not bool(inside.any()):
        raise ValueError(
            f"points: expected some in the picture of {camera.name or 'the camera'}, got none; pass its scene's"
        )
    depth = float(depths[inside].median())
    R, t = camera.viewmat[:3, :3].double().cpu(), camera.viewmat[:3, 3].double().cpu()
    center, (right, down, forward) = -R.T @ t, R
    target, r = center + depth * forward, radius * depth
    fov = degrees(2 * atan(camera.height / 2 / float(camera.K[1, 1])))
    cameras = []
    for number in range(frames):
        part = 2 * pi * number / frames
        a = turns * part
        eye = center + r * (cos(a) * right + 0.6 * sin(a) * down + sin(part) * forward)
        name = f"spiral_{number:04d}"
        view = Camera.look_at(
            eye, target, up=-down, fov_degrees=fov, width=width, height=height, name=name, near=camera.near
        )
        cameras.append(replace(view, origin=camera.origin))
    return cameras
