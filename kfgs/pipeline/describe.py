"""Describe a path: a field, a run, a scene, feature maps, a splat file or a point cloud."""

from __future__ import annotations

from pathlib import Path

from .._check import one_line
from .._files import as_path, bytes_in_words
from ..features import FeatureFolder
from ..features.manifest import MANIFEST, read_manifest
from ..fields import SemanticField
from ..fields.store import find_field
from ..formats import SplatFile, find_format, read_splats
from ..formats.folders import splat_file_of
from ..formats.ply import read_ply
from ..scenes import SceneError, is_scene, load_scene
from .stages import read_stage


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
        size = [f"  one file of {path.stat().st_size / 2**20:.2f} MiB"] if field.is_file() else []
        return "\n".join([SemanticField.load(field).summary(), *size])
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
    except SceneError:
        maps = FeatureFolder(path)
        if not maps.files:
            raise
        h, w, D = maps.shape
        return f"{path}: {len(maps)} feature maps of another program\n  {h} x {w} cells, {D} channels"
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


def _describe_maps(path: Path) -> str:
    manifest = read_manifest(path)
    assert manifest is not None
    records = manifest.maps.values()
    shapes = sorted({record.shape for record in records})
    there = sum((path / record.file).is_file() for record in records)
    lines = [
        f"{path}: {len(records)} feature maps by {one_line(manifest.teacher.get('name', 'an unknown teacher'))}",
        *(f"  {h} x {w} cells, {D} channels" for h, w, D in shapes),
        f"  {bytes_in_words(sum(record.bytes for record in records))} in half precision"
        + (f", {there} of {len(records)} maps still there" if there < len(records) else ""),
        f"  teacher's time: {sum(record.seconds for record in records):.0f} s",
        *(f"  {one_line(name)}: {one_line(value, 200)}" for name, value in manifest.teacher.items() if name != "name"),
    ]
    return "\n".join(lines)


def _describe_splats(path: Path, splats: SplatFile) -> str:
    lines = [f"{path}: {splats!r}"]
    if len(splats):
        low, high = (values.tolist() for values in splats.gaussians.means.aminmax(dim=0))
        lines += [f"  {axis}: {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True)]
    lines += [f"  {name}: {value}" for name, value in splats.info.items() if not isinstance(value, dict | list)]
    labels = splats.gaussians.labels
    if labels is not None:
        for i, name in enumerate(splats.classes):
            lines.append(f"  {name:<16s} {int((labels == i).sum()):8d} Gaussians")
        lines.append(f"  {'(none)':<16s} {int((labels < 0).sum()):8d} Gaussians")
    return "\n".join(lines)
