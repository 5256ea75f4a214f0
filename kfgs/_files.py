"""Files that are whole or absent: written aside and moved into place. Also paths, JSON, digests and locks."""

from __future__ import annotations

import codecs
import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout
from safetensors import SafetensorError

from ._stems import Names as Names
from ._stems import file_stem as file_stem
from ._stems import folded_name as folded_name

ASIDE = ".kfgs-new-"  # begins the name of the folder in which a file is written; what a kill left may be deleted
UNNAMED = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)  # errors that Python raises without a file


class InUseError(ValueError):
    """Another process works in a folder."""


def as_path(path: str | Path) -> Path:
    """A path as a user wrote it, with `~` as the home folder; a ValueError for an empty text."""
    if path == "":
        raise ValueError("path: expected the name of a file or folder, got an empty text; '.' is the current folder")
    return Path(os.path.expanduser(path))


def real_path(path: str | Path) -> Path:
    """The absolute path with all links followed. One that leads to itself stays: `Path.resolve` raises before Python 3.13."""
    return Path(os.path.realpath(as_path(path)))


def check_output(name: str, path: str | Path, kind: Literal["a file", "a folder"]) -> Path:
    """Check before long work that its result can be written to `path`, which need not exist; return it with `~` expanded.

    Raises:
        ValueError: if the path is empty, something of another kind is there, or a file is in place of a folder above it.
        OSError: if it cannot be written to. The messages name the argument, `name`.
    """
    target = as_path(path)
    got = "a folder" if target.is_dir() else "a file" if target.is_file() else "a pipe or a device"
    if target.exists() and got != kind:
        raise ValueError(f"{name}: expected {kind} or nothing at {path}, got {got}; give another name")
    above = next(place for place in target.absolute().parents if place.exists())
    if not above.is_dir():
        raise ValueError(f"{name}: expected a folder to write to, got {path} below the file {above}; give another")
    try:
        if target.exists() and not os.access(target, os.W_OK):
            raise PermissionError(errno.EACCES, "Permission denied")
        with tempfile.TemporaryFile(dir=target if target.is_dir() else above) as trial:
            trial.write(bytes(4096))  # what a full disk does not take
    except OSError as error:
        message = f"{name}: expected {kind} that can be written, got {path} ({error.strerror}); choose another place"
        raise type(error)(message) from error
    return target


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a path of the same name in a hidden folder to write a file to, and move it to `path` if the block succeeds.

    Folders above `path` are made. If `path` is a link, the new file takes its place. An OSError names `path`.
    """
    target = as_path(path)
    with _aside(target) as place:
        yield place / target.name
        (place / target.name).chmod(place.stat().st_mode & 0o666)  # safetensors makes private files
        os.replace(place / target.name, target)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Give a hidden folder to fill, and move it to `path` in one step if the block succeeds.

    If `path` is a folder with files already, the new files move there one by one; the others stay. Folders that must
    always be read whole (the stages of a run) are therefore never written twice. An OSError names `path`.
    """
    target = real_path(path)
    with _aside(target) as place:
        new = place / target.name
        new.mkdir()
        yield new
        files = [file for file in sorted(new.rglob("*")) if file.is_symlink() or file.is_file()]
        for file in files:
            if not file.is_symlink():
                file.chmod(place.stat().st_mode & 0o666)
        if not target.is_dir() or (not any(target.iterdir()) and target != real_path(".")):
            os.replace(new, target)
            return
        for file in files:
            there = target / file.relative_to(new)
            there.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, there)


@contextmanager
def _aside(target: Path) -> Iterator[Path]:
    """A new hidden folder next to `target`, deleted in the end. Errors of writing name the target."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        place = Path(f"{target.parent}/{ASIDE}{os.getpid()}-{os.urandom(4).hex()}")
        place.mkdir()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error
    try:
        yield place
    except OSError as error:
        short = error.errno in UNNAMED or "requested and" in str(error)  # the last: NumPy's
        if str(place) not in str(error.filename) and not (error.filename is None and short):
            raise  # another file's
        raise OSError(error.errno or errno.ENOSPC, error.strerror or str(error), str(target)) from error
    except SafetensorError as error:
        code = re.search(r"\(os error (\d+)\)", str(error))
        raise (OSError(int(code[1]), os.strerror(int(code[1])), str(target)) if code else error) from error
    finally:
        shutil.rmtree(place, ignore_errors=True)


@contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Keep other processes out of a folder, which is made if it does not exist (InUseError if one is in it).

    `name` is that of the lock file, which stays. The system ends the lock with its process.
    """
    check_output("folder", folder, "a folder").mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / name)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InUseError(
            f"{folder}: expected a folder that no other process writes to, got one in use; wait until that process has "
            "ended, or name another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON, whole; NaN and infinity are refused (ValueError)."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | Path, expected: str = "a JSON file") -> Any:
    """Read a JSON file; a ValueError names the file, and what is wrong with it (FileNotFoundError: what was `expected`)."""
    text = read_text(path, expected)
    try:
        return parse_json(text)
    except ValueError as error:
        raise ValueError(f"{path}: expected a JSON file, but it cannot be parsed ({error})") from error


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text; a ValueError if it is not JSON, or its brackets nest too deep."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("brackets nest too deep") from None


def read_text(path: str | Path, expected: str = "a text file") -> str:
    """Read a text in UTF-8 or UTF-16, with or without a byte-order mark; a ValueError if it has another encoding."""
    path = as_path(path)
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long for the disk
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there")
    try:
        return path.read_text(encoding=text_encoding(path))
    except UnicodeError as error:
        raise ValueError(
            f"{path}: expected {expected} in UTF-8, got other bytes ({error}); save it as UTF-8"
        ) from error


def text_encoding(path: Path) -> str:
    """The encoding that a text's first bytes tell. UTF-8 may begin with a mark; UTF-16, which PowerShell writes, must."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def digest_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with as_path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_value(value: Any) -> str:
    """SHA-256 of a JSON-able value (keys sorted), in hexadecimal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()
