"""Open what commands read, and check what they write before the work begins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from .._files import as_path, check_output, real_path

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.

OUTPUTS = ("out", "target")
"""Parameters that name what a command writes."""


def check_outputs(given: Mapping[str, Any], made: str | None = None) -> None:
    """Check that a command replaces nothing that it reads, and writes nothing among the parts of a scene.

    Args:
        given: its arguments by parameter.
        made: the folder of a scene that this command makes, "features".

    Raises:
        ValueError: if the output is at such a place.
    """
    read = [value for name, value in given.items() if isinstance(value, Path) and name not in OUTPUTS]
    for name in OUTPUTS:
        if given.get(name) is None:
            continue
        target = as_path(given[name])
        spots = {real_path(target), real_path(target.parent) / target.name}  # where a link leads, and the link itself
        above = {folder for spot in spots for folder in spot.parents}
        for file in _files_of(read):
            if real_path(file) in spots:
                raise ValueError(f"{name}: expected another place than {file}, which is read; give another name")
        for part in _parts({*read, *above}):
            if real_path(part) in spots | above and part.name != made:
                raise ValueError(
                    f"{name}: expected a place apart from {part}, a part of a scene, got {target}; give another"
                )


def _files_of(paths: list[Path]) -> Iterator[Path]:
    """The files that are read of some paths; the field of a run."""
    from ..fields.store import find_field

    for path in paths:
        file = find_field(path) or path
        if file.is_file():
            yield file


def _parts(folders: set[Path]) -> Iterator[Path]:
    """The folders with pictures, maps, cameras and labels of those folders that are scenes."""
    from ..scenes.load import is_scene

    for scene in folders:
        if is_scene(scene):
            root = scene if scene.is_dir() else scene.parent
            yield from (root / name for name in ("images", "features", "sparse", "labels", "labels_scored"))


def check_target(name: str, target: Path) -> None:
    """Raise a ValueError unless `target` can become a splat file; see `check_output`."""
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
            f"{name}: expected a field (RUN/field.kfgs, or the run folder), got {path}, {what}; make one with `kfgs fit`"
        )
    return SemanticField.load(field)


def open_splats(name: str, path: Path, *, labelled: bool = False, named: bool = False) -> Any:
    """Read a splat file.

    Raises:
        ValueError: if the path is a semantic field, or the splat has no classes and `labelled` asks for them, or no names of
            its classes and `named` asks for them.
    """
    from ..formats import read_splats
    from ..formats.sidecar import names_path

    if is_field(path):
        raise ValueError(
            f"{name}: expected a splat file, got {path}, a semantic field; pass a colour splat, for example what "
            "`kfgs color` writes"
        )
    splats = read_splats(path)
    if labelled and splats.labels is None:
        raise ValueError(
            f"{name}: expected a splat with classes, got {path} without; run `kfgs attach FIELD {path} --out labelled.ply`"
        )
    if named and splats.labels is not None and not splats.names:
        raise ValueError(
            f"{name}: expected the names of its classes in {names_path(path)}, got no such file; copy it from where the "
            "splat was, or run `kfgs attach` again"
        )
    return splats
