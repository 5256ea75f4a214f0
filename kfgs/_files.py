"""Files that are whole or absent: written aside and moved into place. Also names, paths, JSON, digests and locks."""

from __future__ import annotations

import codecs
import difflib
import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from filelock import FileLock, Timeout
from safetensors import SafetensorError

ASIDE = ".kfgs-new-"  # begins the name of the folder in which a file is written; what a kill left may be deleted
UNNAMED = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)  # errors that Python raises without a file
_ENDING = re.compile(r"(?<=[^/])\.[A-Za-z][A-Za-z0-9]{1,4}$")  # .png, not the .5 of `shot.5`, which may be a stem


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

    A ValueError if the path is empty, something of another kind is there, or a file is in place of a folder above it; an
    OSError if it cannot be written to. The messages name the argument, `name`.
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
    place = Path(f"{target.parent}/{ASIDE}{os.getpid()}-{os.urandom(4).hex()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir()
        yield place
    except OSError as error:
        short = error.errno in UNNAMED or "requested and" in str(error)  # the last: NumPy's
        if place.is_dir() and str(place) not in str(error.filename) and not (error.filename is None and short):
            raise  # another file's
        raise OSError(error.errno or errno.ENOSPC, error.strerror or str(error), str(target)) from error
    except SafetensorError as error:
        code = re.search(r"\(os error (\d+)\)", str(error))
        raise (OSError(int(code[1]), os.strerror(int(code[1])), str(target)) if code else error) from error
    finally:
        shutil.rmtree(place, ignore_errors=True)


@contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Keep other processes out of a folder, which is made if it does not exist (ValueError if one is in it).

    `name` is that of the lock file, which stays. The system ends the lock with its process.
    """
    check_output("folder", folder, "a folder").mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder / name).acquire(timeout=0)
    except Timeout as error:
        got = "one in use; wait until that process has ended, or name another folder"
        raise ValueError(f"{folder}: expected a folder that no other process writes to, got {got}") from error
    with lock:
        yield


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
        got = f"other bytes ({error}); save it as UTF-8"
        raise ValueError(f"{path}: expected {expected} in UTF-8, got {got}") from error


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


def file_stem(name: str) -> str:
    """A view's name without its suffix, folders kept. Feature and label files of the view carry this name.

    Example:
        >>> file_stem("rgb_5.png"), file_stem("train/r_0.png")
        ('rgb_5', 'train/r_0')
    """
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.name else name  # "/" and "." have no suffix to take


def folded_name(name: str) -> str:
    r"""A name with slashes, composed letters (a Mac's zip has them in two parts) and no upper case.

    Example:
        >>> folded_name("left\\A.JPG"), folded_name("./Ku\u0308che.png") == folded_name("K\u00fcche.png")
        ('left/a.jpg', True)
    """
    plain = unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
    return str(PurePosixPath(plain.replace("\\", "/")))


class Names:
    r"""Names of files or views, which may be asked for in other spellings. Every reader of names in kfgs uses this rule.

    A name is looked up as it is, then folded (`folded_name`), then without its ending, then without its first folders, and
    if `bare` without all of them. The first way that fits anything decides; if it fits several names, none is found.

    Example:
        >>> names = Names(["images/A.jpg", "images/b.png"])
        >>> names.find("images/a.JPG"), names.find(r"D:\room\images\b.tif"), names.find("c"), names.advice("image/b")
        ('images/A.jpg', 'images/b.png', None, "did you mean 'images/b.png'?")
    """

    def __init__(self, names: Iterable[str], *, bare: bool = False) -> None:
        self.names, self.bare = dict.fromkeys(names), bare

    def find(self, name: str) -> str | None:
        """The one of the names that is meant; None if there is none, or it is not clear which."""
        if name in self.names:
            return name
        parts, ways = folded_name(name).split("/"), [("stem", name)]
        for i in range(len(parts)):
            tail = "/".join(parts[i:])  # without its ending, in its own case first: a.jpg is a.png, not A.png
            ways += [("folded", tail), ("folded stem", tail)]
            ways += [("stem", _ENDING.sub("", name)), ("folded stem", _ENDING.sub("", tail))]
        if self.bare and len(parts) == 1:
            ways += [("bare", parts[0]), ("bare", _ENDING.sub("", parts[0]))]
        fits = next((self._spellings[way] for way in ways if way in self._spellings), [])
        return fits[0] if len(fits) == 1 else None

    def find_each(self, names: Iterable[str]) -> list[str | None]:
        """`find` for names of different things: what several of them find is only for one that is spelled so."""
        pairs = [(name, self.find(name)) for name in names]
        counts = Counter(fit for _, fit in pairs)
        return [
            fit if fit is None or counts[fit] == 1 or name in (fit, file_stem(fit)) else None for name, fit in pairs
        ]

    def advice(self, name: str) -> str:
        """What to say about a name that is not found: the nearest one."""
        keys = {folded_name(known): known for known in self.names}
        near = difflib.get_close_matches(folded_name(name), keys, n=1, cutoff=0)
        return f"did you mean {keys[near[0]]!r}?" if near else "there are no names to choose from"

    @cached_property
    def _spellings(self) -> dict[tuple[str, str], list[str]]:
        """The names by their stems, folded, by folded stems, and by folded names and stems without folders."""
        spellings: dict[tuple[str, str], list[str]] = {}
        for name in self.names:
            stem, plain = file_stem(name), folded_name(name)
            folded = folded_name(stem)
            bare = (("bare", word.rpartition("/")[2]) for word in (plain, folded))
            for spelling in {("stem", stem), ("folded", plain), ("folded stem", folded), *bare}:
                spellings.setdefault(spelling, []).append(name)
        return spellings
