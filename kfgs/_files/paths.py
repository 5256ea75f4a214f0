"""Paths as users write them, and the check of an output before the work."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from .own import check_inside

BLOCK = 4096  # bytes written on trial: a disk without them is full


def as_path(path: str | Path) -> Path:
    """A path as a user wrote it, with `~` as the home folder.

    As in a shell, `~name` is the home folder of a user if there is one of that name, else an ordinary name.

    Raises:
        TypeError: if it is no path.
        ValueError: if it is an empty text, which would be the current folder.
    """
    if path == "":
        raise ValueError("path: expected the name of a file or folder, got an empty text; '.' is the current folder")
    return Path(os.path.expanduser(path))


def real_path(path: str | Path) -> Path:
    """The absolute path with all links followed. One that leads to itself stays: `Path.resolve` raises before Python 3.13."""
    return Path(os.path.realpath(as_path(path)))


def noted_path(place: Path, noted: str) -> Path:
    """The absolute form of a path that is relative to a folder. Links are resolved first: it is noted of the real folder."""
    return Path(os.path.normpath(real_path(place) / noted))


def utf8(name: str) -> str:
    """A name of a file as text that can be saved: bytes that are no UTF-8 are written as backslashes and digits."""
    return name.encode(errors="backslashreplace").decode()


def check_output(
    name: str,
    path: str | Path,
    kind: Literal["a file", "a folder"],
    *,
    apart: Iterable[Path] = (),
    other: Iterable[Path | None] = (),
    inside: Iterable[str | Path] = (),
) -> Path:
    """Check before the work that its result can be written.

    Args:
        name: the argument, for messages.
        path: the file or folder to write; it need not exist.
        kind: which of the two.
        apart: folders in which nothing may be written: those of a scene for its pictures and feature maps.
        other: folders that it must not be, but may lie in; None is skipped.
        inside: names of the folders in it that will be written to; none may be a link.

    Returns:
        The path, with `~` expanded.

    Raises:
        ValueError: if the path is empty; if a folder is in place of a file, a file in place of a folder or above, or a pipe or
            device in place of either; or if `apart`, `other` or `inside` forbid it.
        OSError: if it cannot be written to, or the disk is full.
    """
    if path == "":
        raise ValueError(f"{name}: expected the name of {kind}, got an empty text; '.' is the current folder")
    target = as_path(path)
    check_inside(target, inside)
    got = "a folder" if target.is_dir() else "a file" if target.is_file() else "a pipe or a device"
    if target.exists() and got != kind:
        raise ValueError(f"{name}: expected {kind} or nothing at {path}, got {got}; give another name")
    above = next(place for place in target.absolute().parents if place.exists())
    if not above.is_dir():
        raise ValueError(f"{name}: expected a folder to write to, got {path} below the file {above}; give another")
    real = real_path(target)
    forbidden = [(folder, (real, *real.parents)) for folder in apart]
    forbidden += [(folder, (real,)) for folder in other if folder is not None]
    for folder, places in forbidden:
        if real_path(folder) in places:
            raise ValueError(
                f"{name}: expected a place apart from the pictures and feature maps in {folder}, got {path}; give another"
            )
    try:
        if target.exists() and not os.access(target, os.W_OK):
            raise PermissionError(13, "Permission denied")
        with tempfile.TemporaryFile(dir=target if target.is_dir() else above, buffering=0) as trial:
            full = trial.write(bytes(BLOCK)) < BLOCK
    except OSError as error:
        raise type(error)(
            f"{name}: expected {kind} that can be written, got {path} ({error.strerror}); choose another place"
        ) from error
    if full:
        raise OSError(f"{name}: expected space on the disk for {path}, got none; free some, or choose another place")
    return target
