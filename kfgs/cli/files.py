"""Open what commands read, and check what they write before the work begins."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .._files import check_output, real_path

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.

OUTPUTS = ("out", "target")  # parameters that name what a command writes


def check_outputs(given: Mapping[str, Any], made: str | None = None) -> None:
    """Raise a ValueError if a command would replace what it reads, or write among the parts of a scene.

    `given` are its arguments by parameter; it may write to the part `made`.
    """
    from ..fields.store import find_field
    from ..scenes.load import SCENE_PARTS, is_scene, scene_root

    read = [value for name, value in given.items() if isinstance(value, Path) and name not in OUTPUTS]
    for name, target in ((name, given[name]) for name in OUTPUTS if given.get(name) is not None):
        for file in (find_field(path) or path for path in read):
            if file.is_file() and target.is_file() and target.samefile(file):
                raise ValueError(f"{name}: expected another place than {file}, which is read; give another name")
        place = real_path(target)
        for scene in (path for path in (*read, *place.parents) if is_scene(path)):
            for part in (scene_root(scene) / part for part in SCENE_PARTS if part != made):
                if real_path(part) in (place, *place.parents):
                    raise ValueError(
                        f"{name}: expected a place apart from {part}, a part of a scene, got {target}; give another"
                    )


def check_target(name: str, target: Path) -> None:
    """Raise a ValueError unless `target` can become a splat file."""
    from ..formats.table import formats

    endings = tuple(ending for kind in formats().values() if hasattr(kind, "write") for ending in kind.SUFFIXES)
    if not target.name.lower().endswith(endings):
        raise ValueError(
            f"{name}: expected a file whose name ends in one of {', '.join(endings)}, got {target}; the ending chooses the format"
        )
    check_output(name, target, "a file")


def is_field(path: Path) -> bool:
    """Whether a path is a field, or a run folder with one in it."""
    from ..fields.store import find_field

    return find_field(path) is not None


def open_field(name: str, path: Path) -> Any:
    """Load a semantic field, of a run folder its `field.kfgs`. Raises a ValueError if the path is not a field."""
    from ..fields import SemanticField
    from ..fields.store import find_field

    field = find_field(path)
    if field is None:
        what = "a file" if path.is_file() else "a folder without one" if path.is_dir() else "no such file"
        raise ValueError(
            f"{name}: expected a field (RUN/field.kfgs, or RUN), got {path}, {what}; make one with `kfgs fit`"
        )
    return SemanticField.load(field)


def open_splats(name: str, path: Path, *, labelled: bool = False, named: bool = False) -> Any:
    """Read a splat file. A ValueError if it has no classes and `labelled` asks for them, or no names and `named` does."""
    from ..formats import read_splats
    from ..formats.sidecar import NAMES, beside

    if is_field(path):
        raise ValueError(f"{name}: expected a splat file, got {path}, a semantic field; pass what `kfgs color` writes")
    splats = read_splats(path)
    if (labelled or named) and splats.labels is None:
        raise ValueError(
            f"{name}: expected a splat with classes, got {path} without; run `kfgs attach FIELD {path} --out labelled.ply`"
        )
    if named and not splats.names:
        raise ValueError(
            f"{name}: expected the names of its classes in {beside(path, NAMES)}, got no such file; copy it from where the "
            "splat was, or run `kfgs attach` again"
        )
    return splats
