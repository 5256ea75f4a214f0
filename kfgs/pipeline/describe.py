"""Describe a path: a field, a run, a scene, feature maps, a splat file or a point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor

from .._card import say_coordinate
from .._check import one_line
from .._files import as_path
from .._origin import to_world
from ..fields import SemanticField
from ..fields.store import find_field
from ..formats import find_format, read_splats
from ..formats.ply import read_ply
from ..formats.table import splat_file_of
from ..scenes import FeatureFolder, load_scene
from ..scenes.load import is_scene
from .attach import is_cloud
from .stages import Run


def describe(path: str | Path) -> str:
    """Describe a field, run, scene, folder of feature maps, splat (also the folder of a training program), or PLY of points.

    Raises:
        FileNotFoundError: if the path does not exist.
        ValueError: if it is none of these.
    """
    path = as_path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a field, a run, a scene or a splat file")
    if (field := find_field(path)) is not None:
        return f"{SemanticField.load(field).summary()}\n  one file of {field.stat().st_size / 2**20:.2f} MiB"
    if path.is_file() or (splat_file_of(path) != path and not is_scene(path)):
        if is_cloud(splat_file_of(path)):
            vertices = read_ply(splat_file_of(path))
            count = len(next(iter(vertices.values())))
            return f"{path}: PLY with {count} vertices; columns {', '.join(vertices)}"
        splats = read_splats(path)
        lines = [f"{path}: {splats!r}"]
        if len(splats):
            corners = to_world(torch.stack(splats.means.aminmax(dim=0)), splats.origin)
            ends = [[say_coordinate(value, 4) for value in corner] for corner in corners.tolist()]
            lines += [f"  {axis}: {low} to {high}" for axis, low, high in zip("xyz", *ends, strict=True)]
        lines.append(f"  format: {find_format(path).NAME}")
        return "\n".join([*lines, *([] if splats.labels is None else count_lines(splats.labels, splats.names))])
    if (path / "stages").is_dir():
        lines = [f"  {one_line(stage.name)}: done in {stage.seconds:.1f} s" for stage in Run(path).finished("*")]
        return "\n".join([f"{path}: unfinished run; the same fit again continues", *lines])
    with suppress(FileNotFoundError, ValueError, TypeError):
        if not is_scene(path):
            maps = FeatureFolder(path)
            h, w, D = maps.shape
            about = maps.identity or {"name": "another program"}
            lines = [
                f"{path}: {len(maps)} feature maps by {one_line(about.get('name', 'an unknown teacher'))}",
                f"  {h} x {w} cells, {D} channels",
                f"  {sum(file.stat().st_size for file in maps.files) / 1e6:,.1f} MB",
                *(f"  {one_line(name)}: {one_line(value, 200)}" for name, value in about.items() if name != "name"),
            ]
            return "\n".join(lines)
    scene = load_scene(path)
    sizes = sorted({camera.size for camera in scene.cameras})
    splits = ", ".join(f"{name} {len(views)}" for name, views in scene.splits.items())
    lines = [
        f"{path}: scene of {len(scene.cameras)} posed images, {len(scene.points)} points",
        f"  image sizes (height, width): {', '.join(map(str, sizes))}",
        f"  distorted: {sum(camera.distortion is not None for camera in scene.cameras)}",
        f"  splits: {splits}",
        f"  extent: {scene.extent:.3f} world units",
        *(f"  note: {note}" for note in scene.notes),
    ]
    return "\n".join(lines)


def count_lines(labels: Tensor, names: Sequence[str]) -> list[str]:  # labels: [N]
    """A line with the number of Gaussians of each class, and of those without a class."""
    counts = [(name, int((labels == i).sum())) for i, name in [*enumerate(names), (-1, "(none)")]]
    return [f"  {name:<16s} {count:8d} Gaussians" for name, count in counts]
