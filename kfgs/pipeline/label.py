"""Labels for other programs: a field's Gaussians in the colours of their classes, and any cloud of points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._check import ORIGIN
from .._files import as_path
from .._origin import recounted
from ..cameras import Camera
from ..formats import write_splats
from ..formats.ply import points_from_columns, read_header, read_ply, write_ply
from ..formats.ply_3dgs import label_column
from ..formats.sidecar import write_names
from ..gaussians import Gaussians
from ..labels import Part, Transfer, nearest_labels
from ..splat.sh import rgb_to_sh0
from ..viz import palette
from ..viz.films import Show, show_selection
from ..viz.pictures import check_suffix, picture_sheet, save_picture

WIDTH = 360  # pixels of a picture of a part
MOST = 12  # parts in a sheet


def save_labelled(path: str | Path, gaussians: Gaussians, *, rule: str) -> list[Path]:
    """Write labelled Gaussians as a splat in the colours of their classes, with `class_id` and `score`.

    `rule` says how they were found, in the JSON file with the class names that is written next to it.
    """
    assert gaussians.labels is not None
    colors = torch.from_numpy(palette(gaussians.labels, gaussians.names)).to(gaussians.means) / 255
    painted = gaussians.replace(features=None, sh=rgb_to_sh0(colors)[:, None])
    return list(write_splats(painted, path, facts={"labelled by": rule}).paths)


def label_cloud(
    gaussians: Gaussians, cloud: str | Path, out: str | Path, *, distance: float | None = None
) -> tuple[Transfer, list[Path]]:
    """Carry labels to the points or Gaussians of a PLY file by distance (Sec. 3.4), keeping all their other columns.

    Label colours are added if the cloud has no colours; `class_id` is replaced. A JSON file with the class names is written
    next to `out`. `distance` is lambda, in world units; None: from the clouds' spacing. A ValueError if the file has no x, y,
    z, or holds more than points (faces would be lost).
    """
    assert gaussians.labels is not None
    cloud, out = as_path(cloud), check_suffix(out, ".ply", name="out")
    columns, header = read_ply(cloud), read_header(cloud)
    if others := [element.name for element in header.elements[1:] if element.rows]:  # for instance the faces of a mesh
        raise ValueError(
            f"{cloud}: expected nothing but points, got {', '.join(others)} too, which labelling would lose; save the "
            "vertices as a point cloud"
        )
    local = recounted(points_from_columns(cloud, columns), ORIGIN, gaussians.origin)
    moved = nearest_labels(gaussians.means, gaussians.labels, local, distance)
    added = {"class_id": label_column(moved.labels)}
    if not {"red", "green", "blue"} & set(columns):
        rgb = palette(moved.labels, gaussians.names)
        added |= {name: np.ascontiguousarray(rgb[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    write_ply(out, columns | added, comments=("labels carried by kfgs", *header.comments))
    names = write_names(out, gaussians.names, **{"distance": moved.distance, "distance from": moved.how})
    return moved, [out, names]


def write_parts(
    path: Path, gaussians: Gaussians, parts: Sequence[Part], cameras: Sequence[Camera], under: Show | None, name: str
) -> Path | None:
    """Draw the largest parts, each in its best view with an outline, while the rest fades; None if no view shows one.

    `parts` are from `connected_parts`, with these cameras; `under` draws the picture below, for instance
    `show_photos(scene)`. They are titled name/1, name/2.
    """
    drawn: list[tuple[str, Any]] = []
    for number, part in enumerate(parts[:MOST], start=1):
        if part.best_view is not None:
            camera = cameras[part.best_view.index]
            camera = camera.resized(max(1, round(WIDTH * camera.height / camera.width)), WIDTH)
            mask = torch.zeros(len(gaussians), dtype=torch.bool).index_fill_(0, part.indices.cpu(), True)
            picture = show_selection(gaussians, mask, under)(camera)
            drawn.append((f"{name}/{number}" + (f" in {camera.name}" if camera.name else ""), picture))
    if not drawn:
        return None
    titles, pictures = zip(*drawn, strict=True)
    save_picture(path, picture_sheet(pictures, titles, 3))
    return path
