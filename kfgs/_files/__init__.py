"""Files: atomic writing, locks, outputs checked before the work, JSON, digests of what was read; sizes and times in words."""

from __future__ import annotations

import codecs
import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .atomic import (
    HIDDEN,
    atomic_folder,
    atomic_path,
    current_file,
    finish_writing,
    hidden_folder,
    open_current,
)
from .errors import FullDiskError
from .locks import InUseError, is_locked, locked
from .names import Names, file_stem, folded_name
from .own import check_inside, check_own, foreign, is_own
from .paths import as_path, check_output, real_path

__all__ = [
    "HIDDEN",
    "FullDiskError",
    "InUseError",
    "Names",
    "as_path",
    "atomic_folder",
    "atomic_path",
    "bytes_in_words",
    "check_inside",
    "check_output",
    "check_own",
    "current_file",
    "digest_file",
    "digest_value",
    "file_stem",
    "finish_writing",
    "folded_name",
    "foreign",
    "hidden_folder",
    "is_locked",
    "is_own",
    "locked",
    "open_current",
    "parse_json",
    "read_json",
    "read_text",
    "real_path",
    "seconds_in_words",
    "text_encoding",
    "write_json",
]

NESTED = 200  # most levels of lists and objects in JSON: neither people nor kfgs write half as many
LARGEST = 1 << 29  # most bytes of a JSON file: COCO's own annotations have 470 MB
DIGITS = 300  # most digits of a whole number in JSON: it fits into a float, so that nobody has to ask


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically; NaN and infinity are refused (ValueError)."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_json(path: str | Path, expected: str = "a JSON file") -> Any:
    """Read a JSON file; the error names the file, what was `expected`, and what is wrong with it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not UTF-8 JSON, or larger than `LARGEST`.
    """
    path = as_path(path)
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long for the disk
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there")
    if (size := path.stat().st_size) > LARGEST:  # in memory it would take some ten times as much
        raise ValueError(
            f"{path}: expected a JSON file of at most {bytes_in_words(LARGEST)}, got {bytes_in_words(size)}; split it"
        )
    try:
        return parse_json(read_text(path, expected))
    except ValueError as error:
        raise ValueError(f"{path}: expected a JSON file, but it cannot be parsed ({error})") from error


def read_text(path: str | Path, expected: str = "a text file") -> str:
    """Read a text that somebody else wrote, in UTF-8 or UTF-16, with or without a byte-order mark. Lines end with a newline.

    Raises:
        FileNotFoundError: if there is no such file; the message says what was `expected`.
        ValueError: if it is in another encoding.
    """
    path = as_path(path)
    if not os.path.isfile(path):  # Path.is_file raises for a name that is too long for the disk
        raise FileNotFoundError(f"{path}: no such file; expected {expected} there")
    try:
        return path.read_text(encoding=text_encoding(path))
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: expected {expected} in UTF-8, got other bytes ({error}); save it as UTF-8"
        ) from error


def text_encoding(path: Path) -> str:
    """The encoding that a text's first bytes tell. UTF-8 may begin with a mark; UTF-16, which PowerShell writes, must."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def parse_json(text: str | bytes, **options: Any) -> Any:
    """The value of a JSON text that somebody else wrote; `options` are those of `json.loads`.

    Raises:
        ValueError: if it is not JSON in UTF-8, has an integer of more than `DIGITS` digits, or more than `NESTED` levels.
    """
    deep = f"brackets nest more than {NESTED} deep"
    try:
        value = json.loads(text, **{"parse_int": _whole_number} | options)
    except RecursionError:
        raise ValueError(deep) from None
    if "\\ud" in (text if isinstance(text, str) else text.decode("utf-8", "ignore")).lower():
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise ValueError("a text has half of a pair of surrogates, which is no character") from None
    level, depth = [value], 0  # in a loop: recursion ends at some 1,000 levels
    while level := [part for one in level for part in _inside(one) if type(part) in (dict, list)]:
        depth += 1
        if depth >= NESTED:
            raise ValueError(deep)
    return value


def _whole_number(word: str) -> int:
    if len(word) > DIGITS:
        raise ValueError(f"a number has {len(word)} digits")
    return int(word)


def _inside(value: Any) -> Iterable[Any]:
    return value.values() if type(value) is dict else value if type(value) is list else ()


def digest_file(path: str | Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with as_path(path).open("rb") as file:
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
