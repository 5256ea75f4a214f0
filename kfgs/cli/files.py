"""Check the files that commands read and write before the work begins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .._files import check_output, real_path

# Heavy imports happen inside the functions, so that `kfgs --help` answers at once.


def check_target(name: str, target: Path, *sources: Path, endings: tuple[str, ...] = ()) -> None:
    """Raise a ValueError unless `target` can become a file that overwrites none of the sources; see `check_output`.

    Args:
        name: the parameter.
        target: its file.
        sources: files that are read.
        endings: those of the file; by default those of splat files.
    """
    from ..formats import formats

    if not endings:
        endings = tuple(ending for one in formats().values() if hasattr(one, "write") for ending in one.SUFFIXES)
    if not target.name.lower().endswith(endings):
        raise ValueError(
            f"{name}: expected a file whose name ends in one of {', '.join(endings)}, got {target}; "
            f"the ending chooses the format"
        )
    check_output(name, target, "a file")
    for source in sources:
        if real_path(target) == real_path(source):
            raise ValueError(f"{name}: expected another file than {source}, got the same; give another name")


def check_alone(name: str, given: object, why: str) -> None:
    """Raise a ValueError if an option is given that would have no effect; None, or False for a flag: it is not given."""
    if given is None or given is False:
        return
    shown = "--" + name.replace("_", "-") if given is True else given
    raise ValueError(f"{name}: expected none {why}, got {shown}; leave it out")


def is_field(path: Path) -> bool:
    """Whether a path is a field: a folder, one file, or a run folder with one in it (`open_field` then names that one)."""
    from ..fields.store import find_field

    return find_field(path) is not None


def open_field(name: str, field: Path) -> Any:
    """Load a semantic field, of a run folder its `field.kfgs`. Raises a ValueError if the path is not a field."""
    from ..fields import SemanticField
    from ..fields.store import find_field

    found = find_field(field)
    if found is None:
        what = "a file" if field.is_file() else "a folder without one" if field.is_dir() else "no such file"
        raise ValueError(
            f"{name}: expected a field (RUN/field.kfgs, or the run folder), got {field}, {what}; make one with `kfgs fit`"
        )
    return SemanticField.load(found)


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
            f"{name}: expected the names of its classes beside {path}, got no file {names_path(path)}; copy it, too, from "
            "where the splat was, or run `kfgs attach` again"
        )
    return splats
