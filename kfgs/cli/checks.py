"""What is asked of paths and options before a command begins its work: nothing is found out after minutes."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.


def check_target(name: str, target: Path, *sources: Path) -> None:
    """Raise a ValueError unless `target` can become a splat file that overwrites none of the sources."""
    from ..formats import formats

    endings = tuple(ending for one in formats().values() if hasattr(one, "write") for ending in one.SUFFIXES)
    if not target.name.lower().endswith(endings):
        raise ValueError(
            f"{name}: expected a file whose name ends in one of {', '.join(endings)}, got {target}; "
            "the ending chooses the format"
        )
    _check_place(name, target, "a file")
    for source in sources:
        if target.resolve() == source.resolve():
            raise ValueError(f"{name}: expected another file than {source}, got the same; give another name")


def edits_beside(out: Path, replay: Path | None) -> Path:
    """Where the edits behind a splat file are saved.

    Raises:
        ValueError: if the edits to replay would be overwritten, or no file can be there.
    """
    saved = out.with_suffix(".edits.json")
    _check_place("out", saved, "a file")
    if replay is not None and replay.resolve() == saved.resolve():
        raise ValueError(
            f"replay: expected another file than {saved}, where the edits behind {out} are saved, got the same; give --out "
            "another name"
        )
    return saved


def check_folder(name: str, target: Path) -> None:
    """Raise a ValueError unless `target` is a folder or can become one."""
    _check_place(name, target, "a folder")


def check_file(name: str, target: Path) -> None:
    """Raise a ValueError unless `target` is a file or can become one."""
    _check_place(name, target, "a file")


def open_field(field: Path) -> Any:
    """Load a semantic field.

    Raises:
        ValueError: if the path is something else; a run folder and a splat are told apart.
    """
    from ..fields import SemanticField

    if not (field / "field.json").is_file():
        inside = field / "field"
        hint = f"pass {inside}" if (inside / "field.json").is_file() else "fit one with `kfgs fit`"
        what = "a file" if field.is_file() else "a folder without one" if field.is_dir() else "no such folder"
        raise ValueError(
            f"field: expected the folder that `kfgs fit` wrote (RUN/field, with field.json), got {field}, {what}; {hint}"
        )
    return SemanticField.load(field)


def open_splats(name: str, path: Path, *, labelled: bool = False) -> Any:
    """Read a splat file.

    Raises:
        ValueError: if the path is a semantic field, or the splat has no classes though they are asked for.
    """
    from ..formats import read_splats

    for folder in (path, path / "field"):
        if (folder / "field.json").is_file():
            raise ValueError(
                f"{name}: expected a splat file, got {path}, a semantic field; pass a colour splat, such as `kfgs color` "
                "writes"
            )
    splats = read_splats(path)
    if labelled and splats.gaussians.labels is None:
        raise ValueError(f"{name}: expected a splat with classes, got {path} without; `kfgs attach` gives it some")
    return splats


def choose_views(scene: Any, names: Sequence[str]) -> Any:
    """The scene with the named views alone.

    Raises:
        ValueError: if a name is none of the scene's views, or one view is named twice, with its ending and without.
    """
    seen = set[str]()
    for name in names:
        try:
            (view,) = (camera.name for camera in scene.select([name]).cameras)
        except ValueError as error:
            near = difflib.get_close_matches(name, [camera.name for camera in scene.cameras], n=3, cutoff=0)
            raise ValueError(
                f"views: expected names of the scene's {len(scene)} views, got {name!r}; "
                f"did you mean {' or '.join(map(repr, near))}?"
            ) from error
        if view in seen:
            raise ValueError(f"views: expected each view once, got {view!r} twice; name it once")
        seen.add(view)
    return scene.select(names)


def check_alone(name: str, given: object, why: str) -> None:
    """Raise a ValueError if an option is given that would have no effect; None, or False of a flag: it is not."""
    if given is None or given is False:
        return
    shown = f"--{name}" if given is True else given
    raise ValueError(f"{name}: expected none {why}, got {shown}; leave it out")


def _check_place(name: str, target: Path, kind: str) -> None:
    if target.exists() and target.is_dir() != (kind == "a folder"):
        other = "a file" if kind == "a folder" else "a folder"
        raise ValueError(f"{name}: expected {kind} or nothing at {target}, got {other}; give another name")
    above = next(place for place in (*target.parents, Path("/")) if place.exists())
    if not above.is_dir():
        raise ValueError(f"{name}: expected a folder to write to, got {target} below the file {above}; give another")


def check_parts(splats: Any, edits: Iterable[Any]) -> None:
    """Refuse a part of a class (`chair/6`) that `kfgs select` does not list: there is none, or it is a speck.

    Args:
        splats: what the edits begin with.
        edits: edits as `edits_from_words` makes them.

    Raises:
        ValueError: if a class has fewer parts; the message says how many.
    """
    import torch

    from ..labels import component_numbers
    from ..labels.parts import SPECK

    for part in (part for edit in edits for part in _parts(getattr(edit, "where", None))):
        name = part.where.name
        mask = part.where.mask(splats)
        numbers = component_numbers(splats.gaussians.means, mask, part.distance)
        sizes = torch.bincount(numbers[mask])
        count = int((sizes >= SPECK * sizes[0]).sum()) if len(sizes) else 0
        if part.rank >= count:
            raise ValueError(
                f"{name}/{part.rank + 1}: expected a part from {name}/1 to {name}/{count}, got none such; "
                f"`kfgs select {name} SPLAT` lists them"
                if count
                else f"{name}/{part.rank + 1}: expected Gaussians of class {name!r}, got none in this splat; "
                "`kfgs info SPLAT` lists what it holds"
            )


def _parts(where: Any) -> list[Any]:
    """The parts of classes that a selection made from words names."""
    from ..labels.where import Component, Either

    if isinstance(where, Either):
        return [part for one in where.parts for part in _parts(one)]
    return [where] if isinstance(where, Component) else []
