"""Each part of a selection in the view that shows it best."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels.parts import Part
from ..viz import save_picture
from ..viz.films import Show, show_selection
from ..viz.pictures import picture_grid

WIDTH = 360  # pixels of a picture
MOST = 12  # parts in one sheet


def write_parts(
    path: Path, gaussians: Gaussians, parts: Sequence[Part], cameras: Sequence[Camera], under: Show | None, name: str
) -> Path | None:
    """Draw the largest parts, each in its best view with an outline, while the rest fades; None if no view shows one.

    Args:
        path: the PNG file.
        gaussians: the cloud that was selected in.
        parts: from `connected_parts`, with these cameras.
        cameras: the views.
        under: draws the picture below, for instance `show_photos(scene)`.
        name: of the selection; parts are named name/1, name/2.
    """
    pictures, titles = [], []
    for number, part in enumerate(parts[:MOST], start=1):
        if part.best_view is None:
            continue
        camera = cameras[part.best_view.index]
        camera = camera.resized(max(1, round(WIDTH * camera.height / camera.width)), WIDTH)
        mask = part.selection(len(gaussians)).mask
        pictures.append(show_selection(gaussians, mask, under)(camera))
        titles.append(f"{name}/{number} in {camera.name}" if camera.name else f"{name}/{number}")
    if not pictures:
        return None
    columns = min(3, len(pictures))
    titles += [""] * (-len(pictures) % columns)
    pictures += [np.full((1, WIDTH, 3), 255, np.uint8)] * (-len(pictures) % columns)
    rows = [
        picture_grid([pictures[i : i + columns]], titles[i : i + columns]) for i in range(0, len(pictures), columns)
    ]
    save_picture(path, np.concatenate(rows))
    return path
