"""What lies at a path, in words: a field, a run, a scene, a PLY file."""

from __future__ import annotations

from pathlib import Path

from .._files import read_json
from ..fields import SemanticField
from ..formats.ply import read_ply
from ..scenes import load_scene


def describe(path: str | Path) -> str:
    """Describe a field folder, a run folder, a scene folder or a PLY file.

    Raises:
        FileNotFoundError: if there is nothing there.
        ValueError: if it is none of these.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a field, a run, a scene or a PLY file")
    if path.is_file():
        columns = read_ply(path)
        count = len(next(iter(columns.values())))
        return f"{path}: PLY with {count} vertices; columns {', '.join(columns)}"
    if (path / "field.json").is_file():
        return SemanticField.load(path).summary()
    if (path / "field" / "field.json").is_file():
        return SemanticField.load(path / "field").summary()
    if (path / "stages").is_dir():
        done = [read_json(file) for file in sorted((path / "stages").glob("[!.]*/stage.json"))]
        lines = [f"  {about['name']}: done in {about['seconds']:.1f} s" for about in done]
        return "\n".join([f"{path}: unfinished run; start `kfgs fit` again to go on", *lines])
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
