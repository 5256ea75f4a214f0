"""What kfgs may write to: ordinary files and folders, no link inside an output folder, no file that something else wrote."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path


def check_ordinary(path: Path) -> None:
    """Raise a ValueError if there is a pipe, socket or device at a path, or behind a link there."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ValueError(
            f"{path}: expected an ordinary file or nothing there, got a pipe or a device; give another name"
        )


def check_inside(folder: Path, names: Iterable[str | Path]) -> None:
    """Check that no place in an output folder, to which kfgs is going to write, is a link: it may lead anywhere.

    The folder itself may be one: its name was given by the user.

    Args:
        folder: the output folder; it need not exist.
        names: of folders in it, also nested ("sparse/0").

    Raises:
        ValueError: if one of them, or a folder above it in `folder`, is a link.
    """
    for name in names:
        for part in [Path(name), *Path(name).parents][:-1]:
            place = folder / part
            if place.is_symlink():
                raise ValueError(
                    f"{place}: expected a folder or nothing there, got a link to {os.readlink(place)}; kfgs follows no "
                    "links inside an output folder: delete it, or name another output. To use another disk, put the whole "
                    "output folder there; a link to it may be the output"
                )


def check_own(path: Path, ours: Callable[[Path], bool], writer: str) -> None:
    """Check that a file may be replaced whose name the user did not give: it is absent, or `writer` wrote it.

    Args:
        path: the file.
        ours: whether an existing file is what `writer` wrote, see `is_own`.
        writer: for the message: "kfgs edit".

    Raises:
        FileExistsError: if something else is there.
    """
    if os.path.lexists(path) and not is_own(path, ours):
        raise foreign(path, writer)


def is_own(path: Path, ours: Callable[[Path], bool]) -> bool:
    """Whether a file is there, is no link, and `ours` says so; if it cannot be read, or has no such part, it is not."""
    try:
        return path.is_file() and not path.is_symlink() and ours(path)
    except (OSError, ValueError, LookupError, TypeError):
        return False


def foreign(place: Path | str, writer: str) -> FileExistsError:
    """The error for a file that `writer` must not replace."""
    return FileExistsError(
        f"{place}: expected nothing there, or what an earlier `{writer}` wrote, got something else; move it away, or "
        "choose another output"
    )
