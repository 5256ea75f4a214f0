"""Films of a scene: a turn around it, or a flight along its cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor

from ..cameras import Camera, Orbit, estimate_up, orbit_cameras, path_cameras
from ..cameras.camera import UP
from ..gaussians import Gaussians
from .animation import Progress, save_animation
from .film_frames import Show

KEYS = 40  # cameras of a long walk that become keys: enough to follow it, few enough to smooth out a shaking hand


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
    """Write a turn around a scene as a GIF or MP4 that can repeat without a jump.

    A GIF takes about 60 kB per frame of 360x480 with textured colours, and 40 kB with labels. `orbit` sets the number and
    the size of frames.

    Args:
        path: a name that ends in .gif or .mp4.
        shows: Gaussians, or several things by title, side by side (`save_animation`). The cameras turn around the first
            Gaussians among them.
        orbit: number of cameras, size, elevation, ...; None: the defaults of `kfgs.cameras.Orbit`.
        up: the world's up; None: from `cameras`, else +z.
        cameras: the scene's cameras, to estimate `up`.
        fps: frames per second.
        names: class names for a legend below.
        progress: called after each frame with (done, all).

    Returns:
        `path`.

    Raises:
        ValueError: if nothing can be shown, or there are no Gaussians to turn around (then pass `orbit_cameras` to
            `save_animation`).
        ImportError: for .mp4, if imageio-ffmpeg is not installed.
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
        path,
        shows,
        orbit_cameras(cloud.means, orbit, up=UP if up is None else up, origin=cloud.origin),
        fps=fps,
        names=names,
        progress=progress,
    )


def save_flythrough(
    path: str | Path,
    shows: Gaussians | Show | Mapping[str, Gaussians | Show],
    cameras: Sequence[Camera],
    *,
    frames: int = 150,
    size: tuple[int, int] | None = None,
    fps: float = 15.0,
    names: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a flight along posed cameras as a GIF or MP4.

    For other keys or a closed walk pass `path_cameras(...)` to `save_animation`.

    Args:
        path: a name that ends in .gif or .mp4.
        shows: Gaussians, a function camera -> picture, or several by title, side by side (`save_animation`).
        cameras: the scene's cameras in the order of the walk; at most about 40 of them become keys, evenly chosen.
        frames: number of frames.
        size: (height, width) in pixels of each picture; None: the first camera's.
        fps: frames per second.
        names: class names for a legend below.
        progress: called after each frame with (done, all).

    Returns:
        `path`.

    Raises:
        ValueError: if nothing can be shown, or there are fewer than two different views.
        ImportError: for .mp4, if imageio-ffmpeg is not installed.
    """
    every = max(1, round(len(cameras) / KEYS))
    walk = path_cameras(cameras, frames, every=every, size=size)
    return save_animation(path, shows, walk, fps=fps, names=names, progress=progress)
