"""Compare a colour scene before and after an edit: choose viewpoints that show the change, and draw pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from ..cameras import Camera, as_cameras
from ..gaussians import Gaussians
from ..splat.rasterize import render_color
from .pictures import picture_grid, save_picture

PREVIEW = 96  # pixels: width of the renderings that choose the viewpoints
VISIBLE = 8 / 255  # a pixel has changed if a channel changed by more than this
MOST = 0.5  # if more of a picture changed, its camera is inside the change: such views come last
SHOWN = 0.5  # a view shows an edit if it shows this share of what the best view shows
APART = 30.0  # degrees between the viewing directions of chosen viewpoints, if enough viewpoints are that far apart


def views_of_change(
    before: Gaussians, after: Gaussians, cameras: Sequence[Camera], count: int = 2, *, between: Sequence[Gaussians] = ()
) -> list[int]:
    """The viewpoints that show an edit best. Each looks in a different direction than those before it, if possible.

    At most `count` are chosen: views without a change never, views of which more than half changes only if there are too few
    others. `between` is the scene after each of several edits: then each edit gets its best view first, unless a chosen view
    shows it half as well, or it is undone later.
    """
    cameras = as_cameras(cameras)
    small = [camera.resized(max(1, round(PREVIEW * camera.height / camera.width)), PREVIEW) for camera in cameras]
    drawn = [[render_color(state, camera) for camera in small] for state in (before, *between, after)]
    total = _shares(drawn[0], drawn[-1])
    chosen: list[int] = []
    for share in map(_shares, drawn[:-1], drawn[1:]):
        best = next((i for i in _ranked(share) if total[i] > 0), None)
        if best is not None and max((share[i] for i in chosen), default=0.0) < SHOWN * share[best]:
            chosen.append(best)
    forward = [camera.viewmat[2, :3].double() for camera in cameras]
    for apart in (math.cos(math.radians(APART)), math.inf):  # first those with another direction, then any
        for i in _ranked(total):
            if len(chosen) < count and i not in chosen and all(float(forward[i] @ forward[k]) < apart for k in chosen):
                chosen.append(i)
    return chosen[:count]


def _shares(before: Sequence[Tensor], after: Sequence[Tensor]) -> list[float]:  # C pictures [H, W, 3] each
    """The share of each picture's pixels that changed."""
    pairs = zip(before, after, strict=True)
    return [float(((old - new).abs().amax(-1) > VISIBLE).float().mean()) for old, new in pairs]


def _ranked(shares: Sequence[float]) -> list[int]:
    """The viewpoints in which something changes, the best first."""
    return sorted((i for i, share in enumerate(shares) if share > 0), key=lambda i: (shares[i] > MOST, -shares[i]))


def write_comparison(path: Path, before: Gaussians, after: Gaussians, cameras: Sequence[Camera]) -> Path:
    """Draw the scene before and after from each viewpoint, one row each, into one PNG file."""
    rows = [[render_color(cloud, camera) for cloud in (before, after)] for camera in cameras]
    save_picture(path, picture_grid(rows, ("before", "after")))
    return path
