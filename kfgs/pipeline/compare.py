"""A colour scene before and after an edit: which viewpoints show the change, and pictures from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .._check import check_whole
from ..cameras import Camera
from ..gaussians import Gaussians
from ..splat import rasterize
from ..viz import save_picture
from ..viz.pairs import picture_grid

PREVIEW = 96  # pixels: width of the renderings that choose the viewpoints
VISIBLE = 8 / 255  # a pixel has changed when some channel did by more than this
MOST = 0.5  # a picture of which more has changed is taken from inside the change: it comes after all others
APART = 30.0  # degrees between the viewing directions of chosen viewpoints, where there are such


def render_color(gaussians: Gaussians, camera: Camera) -> Tensor:  # [H, W, 3] in [0, 1]
    """What a camera sees of a colour field, on black."""
    with torch.no_grad():
        return rasterize(gaussians.replace(features=None), camera).map.clamp(0, 1)


def changed_share(before: Gaussians, after: Gaussians, camera: Camera) -> float:
    """The share of a (small) picture in which an edit shows."""
    small = camera.resized(max(1, round(PREVIEW * camera.height / camera.width)), PREVIEW)
    difference = (render_color(before, small) - render_color(after, small)).abs().amax(-1)
    return float((difference > VISIBLE).float().mean())


def views_of_change(before: Gaussians, after: Gaussians, cameras: Sequence[Camera], count: int = 2) -> list[int]:
    """The viewpoints that show an edit best, each looking another way than those before it where possible.

    Args:
        before: the scene.
        after: the edited scene.
        cameras: viewpoints to choose from.
        count: how many to choose at most; those in which nothing changes are never chosen, those of which more than half
            changes only when there are too few others.
    """
    check_whole("count", count, 0)
    if count == 0:
        return []
    shares = [changed_share(before, after, camera) for camera in cameras]
    order = sorted(range(len(cameras)), key=lambda i: (shares[i] > MOST, -shares[i]))
    ranked = [i for i in order if shares[i] > 0]
    forward = {i: cameras[i].viewmat[2, :3].double() for i in ranked}
    chosen: list[int] = []
    limit = torch.cos(torch.deg2rad(torch.tensor(APART, dtype=torch.float64)))
    for apart in (True, False):
        for i in ranked:
            far = all(float(forward[i] @ forward[j]) < float(limit) for j in chosen)
            if len(chosen) < count and i not in chosen and (far or not apart):
                chosen.append(i)
    return chosen


def write_comparison(
    path: str | Path, before: Gaussians, after: Gaussians, cameras: Sequence[Camera], *, titles: tuple[str, str]
) -> Path:
    """Draw the scene before and after from each viewpoint, one row each, into one PNG file.

    Pictures smaller than the largest get a white border.
    """
    height, width = (max(camera.size[i] for camera in cameras) for i in (0, 1))
    rows = [[_padded(render_color(cloud, camera), height, width) for cloud in (before, after)] for camera in cameras]
    path = Path(path)
    save_picture(path, picture_grid(rows, titles))
    return path


def _padded(picture: Tensor, height: int, width: int) -> Tensor:  # [h, w, 3] -> [H, W, 3]
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    sheet = picture.new_ones(height, width, 3)
    sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


class PhotoPictures:
    """What `score_views` calls for each view: some of the renderings are drawn beside their photographs."""

    def __init__(self, folder: Path, stems: Sequence[str], count: int) -> None:
        """Draw `count` of the views, evenly spread, into `folder/<stem>.png`."""
        self.folder, self.written = folder, list[Path]()
        places = np.linspace(0, len(stems) - 1, min(count, len(stems))).round().astype(int)
        self._chosen = {stems[i] for i in places}

    def __call__(self, stem: str, rendered: Tensor, taken: Tensor) -> None:
        """Draw the view if it was chosen."""
        if stem in self._chosen:
            path = self.folder / f"{stem}.png"
            save_picture(path, picture_grid([[taken, rendered]], ("photograph", "colour field")))
            self.written.append(path)
