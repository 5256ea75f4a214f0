"""Keep the output of a command apart from what it reads and from the parts of a scene."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .._files import as_path, real_path

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.

OUTPUTS = ("out", "target", "json", "csv")
"""Parameters that name what a command writes."""
WORDS = ("weights", "with_file", "set")
"""Parameters whose words may name files: `demo_e200.ckpt`, `before=labelled.ply`."""
READ_WHOLE = ("features", "labels", "truth", "weights")
"""Parameters for folders of which every file may be read."""
MADE = {"features": "features", "text": "text.safetensors"}
"""What a command makes in the folder of a scene."""
SCENE_FILES = (
    *("split.json", "classes.json", "text.npy", "text.safetensors"),
    *("transforms.json", "transforms_train.json", "cameras.json", "poses_bounds.npy", "traj.txt", "traj_w_c.txt"),
    *(f"{name}.{kind}" for name in ("cameras", "images", "points3D", "rigs", "frames") for kind in ("bin", "txt")),
)
"""Files that lie in the folder of a scene itself."""
LATE = ("view",)
"""The page of `kfgs view` is shown before anything heavy is imported; the command calls `check_apart` after that."""


class Kept(NamedTuple):
    """A place at which nothing may be written."""

    place: Path
    about: str
    whole: bool = False
    """Whether nothing may be written below it, either."""


def checked(command: Callable[..., None]) -> Callable[..., None]:
    """The command, with `check_apart` before its work."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> None:
        if command.__name__ not in LATE:
            check_apart(command.__name__, inspect.signature(command).bind(*arguments, **options).arguments)
        command(*arguments, **options)

    return run


def check_apart(command: str, given: dict[str, Any]) -> None:
    """Check that a command replaces nothing that it reads, and writes nothing among the parts of a scene.

    These scenes are known: those that the command is given, those that its fields remember, and those in whose folders its
    output lies.

    Args:
        command: its name.
        given: its arguments by parameter.

    Raises:
        ValueError: if the output is at such a place.
    """
    named = given | {
        name: one for group in given.values() if dataclasses.is_dataclass(group) for name, one in vars(group).items()
    }
    for name in OUTPUTS:
        out = given.get(name)
        if out is None or "://" in str(out):
            continue
        target = as_path(out)
        spots = {real_path(target), real_path(target.parent) / target.name}  # where a link leads, and the link itself
        above = {folder for spot in spots for folder in spot.parents}
        for kept in _kept(command, named, sorted(above)):
            place = real_path(kept.place)
            if place in spots and not kept.whole:
                raise ValueError(
                    f"{name}: expected another place than {kept.place}, {kept.about}, got the same; give another name"
                )
            if kept.whole and place in spots | above:
                raise ValueError(
                    f"{name}: expected a place apart from {kept.about} in {kept.place}, got {out}; give another"
                )


def _kept(command: str, named: Mapping[str, Any], above: list[Path]) -> Iterator[Kept]:
    """What a command reads, and the parts of scenes; `above` are the folders in which its output lies."""
    from ..scenes.load import is_scene

    images = named.get("images")
    inputs = list(_inputs(named))
    for name, path in inputs:
        if path.is_file():
            yield Kept(path, "which is read")
        if name in READ_WHOLE and path.is_dir():
            others = {real_path(other) for _, other in inputs} - {real_path(path)}
            around = is_scene(path) or any(other.is_relative_to(real_path(path)) for other in others)
            if not around and any(one.is_file() for one in path.iterdir()):  # else it is a folder around such folders
                yield Kept(path, "what is read", whole=True)
        if is_scene(path) or name == "scene":
            yield from _parts(command, path, images)
        yield from _of_field(command, path, images)
    for folder in filter(is_scene, above):
        yield from _parts(command, folder)


def _inputs(named: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """The files and folders that a command is given, each with its parameter; some may not exist."""
    for name, value in named.items():
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, Path) and name not in OUTPUTS:
                yield name, one
            elif name in WORDS and one:
                yield from ((name, as_path(word)) for word in (one, one.partition("=")[2]) if word)


def _parts(command: str, scene: Path, images: Path | None = None) -> Iterator[Kept]:
    """The parts of a scene (a folder, or its transforms.json), but for what the command makes for it."""
    from ..scenes.load import picture_folders
    from ..scenes.sub_models import find_model

    root = scene if scene.is_dir() else scene.parent
    model = find_model(root)
    for folder in (root / "features", *picture_folders(scene, images)):
        if folder != root / MADE.get(command, ""):
            yield Kept(folder, "the pictures and feature maps", whole=True)
    for name in ("labels", "labels_scored"):
        yield Kept(root / name, "the true labels", whole=True)
    if model is not None and real_path(model) != real_path(root):
        yield Kept(model, "the cameras", whole=True)
    yield from (Kept(root / name, "a file of the scene") for name in SCENE_FILES if name != MADE.get(command))


def _of_field(command: str, path: Path, images: Path | None) -> Iterator[Kept]:
    """The files of a field or run, and the parts of the scene that it remembers; the splat of another program's folder."""
    from ..fields import recall_scene
    from ..fields.store import find_field, read_description
    from ..formats.table import newest_splat

    field, splat = find_field(path), newest_splat(path)
    if splat is not None:
        yield Kept(splat, "which is read")
    if field is None:
        return
    yield Kept(field, "the field that is read")
    if field != path:
        yield Kept(path / "color.ply", "the colours of the run")
        yield Kept(path / "stages", "the stages of the run", whole=True)
    try:
        info = read_description(field)["info"]
        scene = recall_scene({"scene": os.path.normpath(field.parent / info["scene"])})
    except (OSError, ValueError, LookupError, AttributeError):  # the command says what is wrong with the field
        return
    yield from _parts(command, scene, images)
