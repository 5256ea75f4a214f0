"""Describe a path: a field, a run, a scene, feature maps, a splat file or a point cloud."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import torch

from .._card import say_coordinate
from .._check import one_line
from .._files import as_path, bytes_in_words
from .._origin import to_world
from ..fields import SemanticField
from ..fields.store import find_field
from ..formats import find_format, read_splats
from ..formats.folders import splat_file_of
from ..formats.ply import read_ply
from ..gaussians import Gaussians
from ..scenes import FeatureFolder, SceneError, is_scene, list_images, load_scene
from ..scenes.extract import MANIFEST
from ..scenes.files import IMAGE_SUFFIXES, natural_key, some
from .stages import read_stage

MOST = 1000  # folders that are looked into


def describe(path: str | Path) -> str:
    """Describe a field, run or scene folder, a folder of feature maps that kfgs made, a splat, or a PLY of points.

    A splat is a file, or the output folder of a training program.

    Raises:
        FileNotFoundError: if the path does not exist.
        ValueError: if it is none of these.
    """
    path = as_path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a field, a run, a scene or a splat file")
    field = find_field(path)
    if field is not None:
        return f"{SemanticField.load(field).summary()}\n  one file of {field.stat().st_size / 2**20:.2f} MiB"
    if path.is_file() or (splat_file_of(path) != path and not is_scene(path)):
        if find_format(path).NAME == "ply":
            columns = read_ply(splat_file_of(path))
            if "scale_0" not in columns:
                count = len(next(iter(columns.values())))
                return f"{path}: PLY with {count} vertices; columns {', '.join(columns)}"
        return _describe_splats(path, read_splats(path))
    if (path / MANIFEST).is_file():
        return _describe_maps(path)
    if (path / "stages").is_dir():
        done = [read_stage(file) for file in sorted((path / "stages").glob("[!.]*/stage.json"))]
        lines = [f"  {one_line(about['name'])}: done in {about['seconds']:.1f} s" for about in done]
        return "\n".join([f"{path}: unfinished run; start `kfgs fit` again to go on", *lines])
    try:
        scene = load_scene(path)
    except SceneError as error:
        if is_scene(path):
            raise
        return _describe_others(path, error)
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


def _describe_others(path: Path, error: SceneError) -> str:
    """A folder that is no scene: photos without poses, a folder of scenes, photos or runs, or maps of another program."""
    photos = _photos_in(path)
    if photos == path:
        with suppress(TypeError, ValueError):  # there may be pictures among maps
            return _describe_other_maps(path, error)
    if photos is not None:
        out = "SCENE" if photos == path else path
        count = len(list_images(photos))
        return (
            f"{path}: {count} photos without camera poses\nnext: kfgs sfm {photos} --out {out}, which finds the cameras"
        )
    folders = sorted((one for one in path.iterdir() if one.is_dir()), key=lambda one: natural_key(one.name))[:MOST]
    scenes = [one for one in folders if is_scene(one)]
    photos_only = [one for one in folders if one not in scenes and _photos_in(one) is not None]
    fields = [one for one in folders if one not in scenes and find_field(one) is not None]
    kinds = {"scenes": scenes, "photos without camera poses": photos_only, "runs or fields": fields}
    found = {kind: inside for kind, inside in kinds.items() if inside}
    if not found:
        return _describe_other_maps(path, error)
    lines = [f"  {len(inside)} {kind}: {some([one.name for one in inside])}" for kind, inside in found.items()]
    first = next(iter(found.values()))[0]
    return "\n".join([f"{path}: a folder of folders", *lines, f"next: give one of them: kfgs info {first}"])


def _describe_other_maps(path: Path, error: SceneError) -> str:
    try:
        return _describe_maps(path)
    except (FileNotFoundError, ValueError):
        raise error from None


def _photos_in(path: Path) -> Path | None:
    """The folder with the photos: images/ in a folder, or the folder itself; None if there are none."""
    if (path / "images").is_dir() and list_images(path / "images"):
        return path / "images"
    return path if any(one.suffix.lower() in IMAGE_SUFFIXES for one in path.iterdir()) else None


def _describe_maps(path: Path) -> str:
    maps = FeatureFolder(path)
    h, w, D = maps.shape
    about = maps.identity or {"name": "another program"}
    lines = [
        f"{path}: {len(maps)} feature maps by {one_line(about.get('name', 'an unknown teacher'))}",
        f"  {h} x {w} cells, {D} channels",
        f"  {bytes_in_words(sum(file.stat().st_size for file in maps.files))}",
        *(f"  {one_line(name)}: {one_line(value, 200)}" for name, value in about.items() if name != "name"),
        *(f"  {note}" for note in maps.check(values=False).notes),
    ]
    return "\n".join(lines)


def _describe_splats(path: Path, splats: Gaussians) -> str:
    lines = [f"{path}: {splats!r}"]
    if len(splats):
        corners = to_world(torch.stack(splats.means.aminmax(dim=0)), splats.origin)
        ends = [[say_coordinate(value, 4) for value in corner] for corner in corners.tolist()]
        lines += [f"  {axis}: {low} to {high}" for axis, low, high in zip("xyz", *ends, strict=True)]
    lines.append(f"  format: {find_format(path).NAME}")
    labels = splats.labels
    if labels is not None:
        for i, name in enumerate(splats.names):
            lines.append(f"  {name:<16s} {int((labels == i).sum()):8d} Gaussians")
        lines.append(f"  {'(none)':<16s} {int((labels < 0).sum()):8d} Gaussians")
    return "\n".join(lines)
