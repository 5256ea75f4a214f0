"""Files and folders that are either whole or absent, however their writer ends.

What is being written lies in a hidden folder beside its place, `.kfgs-unfinished/new-*`, and is moved from there in one step.
A lock shows that its writer lives; the next writer beside it deletes what others left.

A folder that holds files already stays, with everything in it that the new content does not replace. The new content moves to
`FOLDER/.kfgs-unfinished/waiting` in one step, and from there its files move to their places one by one. From that step on,
`current_file` finds the new ones, before it the old ones, and the next writer finishes what a killed one began. A reader of
several files uses `open_current`.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from .errors import retold
from .locks import open_lock, try_lock
from .own import check_inside, check_ordinary
from .paths import as_path

HIDDEN, WAITING, LOCK, NEW = ".kfgs-unfinished", "waiting", ".kfgs-lock", "new-"
ATTEMPTS = 100  # to put a folder where other processes put theirs

T = TypeVar("T")


def _read_umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


UMASK = _read_umask()  # once: it can only be read by setting it, for all threads


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a hidden path of the same name to write a file to, and move it to `path` if the block succeeds.

    If `path` is a link, the new file takes its place; what the link leads to stays as it is.

    Raises:
        ValueError: if a pipe or device is there, or a link in place of the hidden folder.
        FullDiskError: if the disk is full.
        OSError: if `path` cannot be written; all errors name `path`, none the hidden one.
    """
    target = as_path(path)
    check_ordinary(target)
    with hidden_folder(target.parent, target) as place:
        new = place / target.name
        yield new
        _make_ordinary(new)
        os.replace(new, target)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Give a hidden folder to fill, and put it to `path` if the block succeeds. Errors are those of `atomic_path`.

    If `path` holds files already, the new ones replace those of the same names, all others stay. Read such a folder with
    `current_file`. A link to a folder stays a link; links in that folder to others are not followed.
    """
    target = Path(os.path.realpath(as_path(path)))
    used = _is_used(target)
    if used:  # a writer that made it may have been killed when it was there
        _tidy(target.parent / HIDDEN)
    with hidden_folder(target if used else target.parent, as_path(path)) as place:
        new = place / "new"
        new.mkdir(mode=0o777 & ~UMASK)
        yield new
        if not (place / LOCK).exists():  # deleted, and perhaps made again by who wrote into it
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(new))
        for file in new.rglob("*"):
            if file.is_file() and not file.is_symlink():
                _make_ordinary(file)
        _put(new, target)


def current_file(folder: Path, name: str) -> Path:
    """Where a file of a folder is that `atomic_folder` wrote, also if its writer was killed while moving the files."""
    waiting = folder / HIDDEN / WAITING
    there = (waiting / name).exists() and not waiting.is_symlink() and not waiting.parent.is_symlink()
    return waiting / name if there else folder / name


def open_current(folder: Path, read: Callable[[Callable[[str], Path]], T]) -> T:
    """Read several files of a folder that `atomic_folder` wrote, all of them old or all new.

    Args:
        folder: the folder.
        read: reads the files and returns what is in them. It is given a function that finds a file by its name, as
            `current_file` does. It is called again if a file that it found was replaced meanwhile.

    Raises:
        ValueError: if another process replaces the files all the time.
        Exception: what `read` raises while no file is replaced.
    """
    for _ in range(ATTEMPTS):
        marks: dict[str, object] = {}
        try:
            result = read(partial(_find, folder, marks))
        except (OSError, ValueError):
            if not _replaced(folder, marks):
                raise
        else:
            if not _replaced(folder, marks):
                return result
    raise ValueError(
        f"{folder}: expected files that stay while they are read, got a folder that another process writes to all the time; "
        "wait until it has ended"
    )


def _find(folder: Path, marks: dict[str, object], name: str) -> Path:
    """The current file of a name; `marks` learns which one it is."""
    file = current_file(folder, name)
    marks.setdefault(name, _mark(file))
    return file


def _replaced(folder: Path, marks: dict[str, object]) -> bool:
    return any(_mark(current_file(folder, name)) != mark for name, mark in marks.items())


def _mark(file: Path) -> tuple[object, ...]:
    """Something that changes when another file takes the place of this one."""
    try:
        about = file.stat()
    except OSError:
        return (file,)
    return file, about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns


@contextmanager
def hidden_folder(parent: Path, target: Path | None = None) -> Iterator[Path]:
    """Make a hidden folder in `parent` (made if missing) to work in, and delete it in the end.

    Those of processes that have ended without deleting theirs are deleted first; those of living ones stay.

    Args:
        parent: a folder.
        target: what is written, for errors: they name it instead of the hidden folder.

    Raises:
        ValueError: if a link is in place of the hidden folder: it could lead anywhere.
    """
    shown = parent if target is None else target
    hidden = parent / HIDDEN
    check_inside(parent, [f"{HIDDEN}/{WAITING}"])
    try:
        _sweep(hidden)
        place, handle = _take(hidden)
    except OSError as error:
        raise retold(error, hidden, shown) or error from error
    try:
        yield place
    except Exception as error:
        told = retold(error, place, shown, gone=not (place / LOCK).exists())
        if told is None:
            raise
        raise told from error
    finally:
        _discard(place)
        os.close(handle)
        with suppress(OSError):  # another process works in it
            hidden.rmdir()


def _take(hidden: Path) -> tuple[Path, int]:
    """A new folder in `hidden`, and its lock."""
    while True:
        try:
            hidden.mkdir(parents=True, exist_ok=True)
            place = Path(tempfile.mkdtemp(prefix=NEW, dir=hidden))
            handle = open_lock(place / LOCK)
        except (FileNotFoundError, FileExistsError):  # another process deleted one of them, which was empty
            if not hidden.parent.is_dir() or hidden.is_file():
                raise
            continue
        if try_lock(handle) is not False and os.fstat(handle).st_nlink:
            return place, handle
        os.close(handle)  # another process took it for one that was left


def _sweep(hidden: Path) -> None:
    """Delete the folders in `hidden` whose writers have ended."""
    try:
        names = [] if hidden.is_symlink() else os.listdir(hidden)
    except FileNotFoundError:  # never there, or another process has just deleted it
        return
    for place in (hidden / name for name in names if name.startswith(NEW)):
        if place.is_symlink():
            continue
        try:
            handle = open_lock(place / LOCK, new=False)
        except (OSError, ValueError):  # its writer ended before locking it; if it lives, it makes another
            with suppress(OSError):
                place.rmdir()
            continue
        try:
            if try_lock(handle):
                _discard(place)
        finally:
            os.close(handle)


def _tidy(hidden: Path) -> None:
    """Sweep a folder, and delete it if nothing is left in it."""
    with suppress(OSError):  # another process works in it, or it may not be changed
        _sweep(hidden)
        hidden.rmdir()


def _discard(place: Path) -> None:
    """Delete a hidden folder; its lock last, so that it can be deleted again after a kill."""
    with suppress(OSError):
        for entry in list(os.scandir(place)):
            if entry.name == LOCK:
                continue
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                with suppress(OSError):
                    os.unlink(entry.path)
        os.unlink(place / LOCK)
        place.rmdir()


def _put(new: Path, target: Path) -> None:
    """Put a finished folder in its place, or its files into the folder that is there."""
    waiting = target / HIDDEN / WAITING
    for attempt in range(ATTEMPTS):
        try:
            if not _is_used(target):
                os.replace(new, target)  # also in place of an empty folder
                return
            _settle(target)
            _check_kinds(new, target)
            waiting.parent.mkdir(exist_ok=True)
            os.replace(new, waiting)
        except OSError as error:  # another process put its own there meanwhile, or has just finished
            known = error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT)
            if not known or not new.is_dir() or attempt == ATTEMPTS - 1:
                raise
        else:
            _settle(target)
            return


def finish_writing(folder: Path) -> None:
    """Finish what killed writers began in a folder, and delete what they left. A reader needs it not; it tidies up."""
    hidden = folder / HIDDEN
    check_inside(folder, [f"{HIDDEN}/{WAITING}"])
    if hidden.is_dir():
        _settle(folder)
        _tidy(hidden)


def _settle(folder: Path) -> None:
    """Move waiting files to their places in a folder. Several processes may do so at once."""
    check_inside(folder, [f"{HIDDEN}/{WAITING}"])
    waiting = folder / HIDDEN / WAITING
    _move_in(waiting, folder)
    with suppress(OSError):
        waiting.parent.rmdir()


def _move_in(source: Path, target: Path) -> None:
    """Move all that is in a folder into another one; folders of the same names are joined."""
    try:
        entries = sorted(os.scandir(source), key=lambda entry: entry.name)
    except FileNotFoundError:
        return
    for entry in entries:
        with suppress(FileNotFoundError):  # another process moved it
            if entry.is_dir(follow_symlinks=False) and (target / entry.name).is_dir():
                check_inside(target, [entry.name])
                _move_in(Path(entry.path), target / entry.name)
            else:
                os.replace(entry.path, target / entry.name)
    with suppress(OSError):
        source.rmdir()


def _check_kinds(new: Path, target: Path) -> None:
    """Raise unless files would replace files, and folders join folders: a move that has begun must come to its end."""
    for path in new.rglob("*"):
        there = target / path.relative_to(new)
        if path.is_dir():
            check_inside(target, [path.relative_to(new)])
        if os.path.lexists(there) and path.is_dir() != there.is_dir():
            raise IsADirectoryError(errno.EISDIR, "a folder is in place of a file, or a file of a folder", str(there))


def _is_used(folder: Path) -> bool:
    """Whether a folder may not be replaced by another: it holds something, is a disk, or the process runs in it (`--out .`)."""
    return folder.is_dir() and (any(folder.iterdir()) or folder.is_mount() or os.path.samefile(folder, os.curdir))


def _make_ordinary(file: Path) -> None:
    """Give a file the permissions of any new one: safetensors makes private files."""
    file.chmod(0o666 & ~UMASK)
