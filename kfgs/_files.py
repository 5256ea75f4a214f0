"""Files that are either whole or absent: atomic writing, JSON, and digests of what was read; sizes and times in words.

Every file of kfgs is written beside its final name and moved there in one step, so a killed process leaves nothing
half-written behind.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def _read_umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


NESTED = 200  # most levels of lists and objects in JSON: neither people nor kfgs write half as many
_UMASK = _read_umask()  # once: it can only be read by setting it, for all threads


def _make_ordinary(file: Path) -> None:
    """Give a file the permissions of any new one: mkstemp makes private files, and so does safetensors."""
    file.chmod(0o666 & ~_UMASK)


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary name beside `path` to write a file to, and move it to `path` if the block succeeds."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    _make_ordinary(Path(name))
    try:
        yield Path(name)
        _make_ordinary(Path(name))
        os.replace(name, target)
    finally:
        Path(name).unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Give a temporary folder beside `path` to fill, and move it to `path` (replacing it) if the block succeeds."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    temporary.chmod(0o777 & ~_UMASK)
    try:
        yield temporary
        for path in temporary.rglob("*"):
            if path.is_file() and not path.is_symlink():
                _make_ordinary(path)
        if target.exists():
            old = temporary.with_name(temporary.name + ".old")
            os.replace(target, old)
            try:
                os.replace(temporary, target)
            except BaseException:
                os.replace(old, target)
                raise
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN and infinity are refused (ValueError)."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read a JSON file; the error names the file and what is wrong with it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not UTF-8 JSON.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a JSON file there")
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected a JSON file, but it cannot be parsed ({error})") from error


def parse_json(text: str | bytes, **options: Any) -> Any:
    """The value of a JSON text that somebody else wrote; `options` are those of `json.loads`.

    Raises:
        ValueError: if it is not JSON in UTF-8, has an integer of thousands of digits, or more than `NESTED` levels.
    """
    deep = f"brackets nest more than {NESTED} deep"
    try:
        value = json.loads(text, **options)
    except RecursionError:
        raise ValueError(deep) from None
    level, depth = [value], 0  # not by recursion, which what follows (repr, json.dumps) has not endless room for
    while level := [part for one in level for part in _inside(one) if type(part) in (dict, list)]:
        depth += 1
        if depth >= NESTED:
            raise ValueError(deep)
    return value


def _inside(value: Any) -> Iterable[Any]:
    return value.values() if type(value) is dict else value if type(value) is list else ()


def digest_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_value(value: Any) -> str:
    """SHA-256 of a JSON-able value (keys sorted), in hexadecimal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()


def bytes_in_words(count: float | None) -> str:
    """Bytes for people: `15.9 GB`, `0.3 MB`; `unknown` for None."""
    if count is None:
        return "unknown"
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def seconds_in_words(seconds: float | None) -> str:
    """A duration for people: `40 s`, `12 min`, `3.3 h`; `unknown` for None."""
    if seconds is None:
        return "unknown"
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
