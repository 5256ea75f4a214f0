"""Read the files of a COLMAP model, binary and text. Both have the same fields in the same order, so one reader is enough.

A `Table` returns the fields of one record after the other. It compares every count with the rest of the file before using
it, so memory is bounded by the size of the file.

Fields are named by letters, as in `struct`: B, I and Q are unsigned integers of 1, 4 and 8 bytes, d is a float64. Four letters
are ours: m is a camera model and s a sensor type (integers in .bin, words in .txt), x is an unused float64, and z a float64
that is NaN where the file has none that is finite and plausible.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections import deque
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .._files import text_encoding
from .files import MAX_NUMBER, SceneError

# COLMAP's id of a camera model: its name and its parameters. Those that begin with f are focal lengths.
CAMERA_MODELS: dict[int, tuple[str, str]] = {
    0: ("SIMPLE_PINHOLE", "f, cx, cy"),
    1: ("PINHOLE", "fx, fy, cx, cy"),
    2: ("SIMPLE_RADIAL", "f, cx, cy, k"),
    3: ("RADIAL", "f, cx, cy, k1, k2"),
    4: ("OPENCV", "fx, fy, cx, cy, k1, k2, p1, p2"),
    5: ("OPENCV_FISHEYE", "fx, fy, cx, cy, k1, k2, k3, k4"),
    6: ("FULL_OPENCV", "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6"),
    7: ("FOV", "fx, fy, cx, cy, omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f, cx, cy, k"),
    9: ("RADIAL_FISHEYE", "f, cx, cy, k1, k2"),
    10: ("THIN_PRISM_FISHEYE", "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", "fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3"),
    12: ("SIMPLE_DIVISION", "f, cx, cy, k"),
    13: ("DIVISION", "fx, fy, cx, cy, k"),
    14: ("SIMPLE_FISHEYE", "f, cx, cy"),
    15: ("FISHEYE", "fx, fy, cx, cy"),
    16: ("EUCM", "fx, fy, cx, cy, alpha, beta"),
    17: ("EQUIRECTANGULAR", "w, h"),
}
OBSERVATIONS = np.dtype([("X", "<f8"), ("Y", "<f8"), ("POINT3D_ID", "<i8")])
"""The 2-D points of an image; -1 = no 3-D point."""
TRACK = np.dtype([("IMAGE_ID", "<u4"), ("POINT2D_IDX", "<u4")])
"""The 2-D points that see one 3-D point."""

ADVICE = "copy the model again from its source, or write it again with COLMAP"
_LARGEST = {"B": 2**8 - 1, "I": 2**32 - 1, "Q": 2**64 - 1}
_WORDS = {"m": {name: i for i, (name, _) in CAMERA_MODELS.items()}, "s": {"CAMERA": 0, "IMU": 1}}
_NUMERIC = frozenset("0123456789+-.eE")  # characters of numbers in C++: no '1_000', no 'nan'
_BROKEN = re.compile(r"[+-]?(nan(\(\w*\))?|inf(inity)?|1\.#\w+)", re.IGNORECASE)  # as C and Windows write them
_LONGEST_NAME = 4096  # bytes, the longest path of Linux


def require(condition: bool, where: str, expected: str, got: object, advice: str = ADVICE) -> None:
    """Raise a SceneError in four parts unless `condition` holds."""
    if not condition:
        raise SceneError(f"{where}: expected {expected}, got {got}; {advice}")


@lru_cache
def _kinds(fields: str) -> str:
    """One letter for each field: "I3d" -> "Iddd"."""
    return re.sub(r"(\d+)(\w)", lambda found: int(found[1]) * found[2], fields)


@lru_cache
def _layout(fields: str) -> struct.Struct:
    return struct.Struct("<" + _kinds(fields).replace("m", "i").replace("s", "i").replace("x", "8x").replace("z", "d"))


class Table(Protocol):
    """One file of a model, read record by record."""

    def records(self, what: str, smallest: str) -> Iterator[str]:
        """Go through all records; gives their place in the file, for messages. `smallest`: the fields of the shortest."""

    def take(self, fields: str, names: str) -> tuple[Any, ...]:
        """The next fields; floating-point numbers are finite, except z. `names`: COLMAP's, separated by ", "."""

    def count(self, name: str, fields: str) -> int:
        """The next field as a number of items, each of at least these fields, that the rest can hold."""

    def name(self) -> str:
        """The next field as an image's name; the table then stands before its 2-D points."""

    def rows(self, columns: np.dtype[Any], what: str) -> NDArray[Any]:
        """An array that ends the record."""


class _Binary:
    """A .bin file (little-endian, no padding): a uint64 number of records, then the records."""

    def __init__(self, path: Path) -> None:
        self.path, self.where, self.position = path, str(path), 0
        size = path.stat().st_size
        require(size >= 8, self.where, "at least the 8 bytes of a count", f"{size} bytes")
        with path.open("rb") as file:  # mapped: only the parts that are used take memory
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def records(self, what: str, smallest: str) -> Iterator[str]:
        count = self._count("Q", f"number of {what}s", _layout(smallest).size)
        for i in range(count):
            self.where = f"{self.path}, {what} {i}"
            yield self.where
        left = len(self.data) - self.position
        require(left == 0, str(self.path), f"the end of the file at byte {self.position}", f"{left} more bytes")

    def take(self, fields: str, names: str) -> tuple[Any, ...]:
        layout = _layout(fields)
        values = layout.unpack_from(self.data, self._advance(layout.size, names))
        if all(abs(value) < MAX_NUMBER for value in values if isinstance(value, float)):
            return values
        pairs = list(zip(_kinds(fields).replace("x", ""), values, strict=True))
        good = all(abs(value) < MAX_NUMBER for kind, value in pairs if kind == "d")
        require(good, self.where, f"finite, plausible numbers ({names})", list(values))
        return tuple(value if kind != "z" or abs(value) < MAX_NUMBER else math.nan for kind, value in pairs)

    def count(self, name: str, fields: str) -> int:
        return self._count("I", name, _layout(fields).size)

    def name(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + _LONGEST_NAME)
        require(end >= 0, self.where, "a NAME that ends", f"none within {_LONGEST_NAME} bytes")
        raw, self.position = self.data[self.position : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.where}: expected a UTF-8 NAME, got {raw[:40]!r}; {ADVICE}") from error

    def rows(self, columns: np.dtype[Any], what: str) -> NDArray[Any]:
        count = self._count("Q", f"number of {what}", columns.itemsize)
        return np.frombuffer(self.data, columns, count, self._advance(count * columns.itemsize, what))

    def _count(self, field: str, name: str, smallest: int) -> int:
        (count,) = self.take(field, name)
        left = len(self.data) - self.position
        require(count * smallest <= left, self.where, f"at most {left // smallest} ({name}) in {left} bytes", count)
        return int(count)

    def _advance(self, length: int, what: str) -> int:
        """Skip `length` bytes, and return where they begin."""
        start, left = self.position, len(self.data) - self.position
        if length > left:
            raise SceneError(
                f"{self.where}: expected {length} bytes ({what}) at byte {start}, got the end of the file after {left}: "
                f"it is truncated or corrupt; {ADVICE}"
            )
        self.position += length
        return start


class _Text:
    """A .txt file: one record per line; blank lines and lines that begin with # are passed over."""

    def __init__(self, path: Path) -> None:
        self.path, self.where, self.line, self.lines = path, str(path), "", self._lines()
        self.words: deque[str] = deque()

    def _lines(self) -> Iterator[str]:
        """All lines; `where` names the last one."""
        try:
            with self.path.open(encoding=text_encoding(self.path)) as file:
                for number, self.line in enumerate(file, 1):
                    self.where = f"{self.path}, line {number}"
                    yield self.line
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.path}: expected UTF-8 text, got other bytes ({error}); {ADVICE}") from error

    def records(self, what: str, smallest: str) -> Iterator[str]:  # a line says itself where it ends
        for line in self.lines:
            if line.strip() and not line.lstrip().startswith("#"):
                self.words = deque(line.split())
                yield self.where
                require(not self.words, self.where, "the end of the line", " ".join(self.words)[:80])

    def take(self, fields: str, names: str) -> tuple[Any, ...]:
        kinds = _kinds(fields)
        values = [self._value(kind, name) for kind, name in zip(kinds, names.split(", "), strict=True)]
        return tuple(value for kind, value in zip(kinds, values, strict=True) if kind != "x")

    def count(self, name: str, fields: str) -> int:
        count, most = self._value("I", name), len(self.words) // len(_kinds(fields))
        require(count <= most, self.where, f"{name}: at most {most}, which the line can hold", count)
        return int(count)

    def name(self) -> str:
        where, taken = self.where, len(self.line.split()) - len(self.words)
        require(bool(self.words), where, "NAME", "the end of the line")
        name = self.line.split(maxsplit=taken)[taken].strip()  # the rest of the line: a name may hold blanks
        below = next(self.lines, None)  # pycolmap silently drops an image without this line
        require(
            below is not None, where, "a line of 2-D points (perhaps empty) below each image", "the end of the file"
        )
        self.words = deque((below or "").split())
        return name

    def rows(self, columns: np.dtype[Any], what: str) -> NDArray[Any]:
        words, width = list(self.words), len(columns.names or ())
        self.words.clear()
        expected = f"{what} as {' '.join(columns.names or ())}"
        require(len(words) % width == 0, self.where, expected, f"{len(words)} words")
        wrong = [word for word in words if not _NUMERIC.issuperset(word) and not _BROKEN.fullmatch(word)]
        require(not wrong, self.where, expected, wrong[:1])
        table = np.empty(len(words) // width, columns)
        try:
            for i, name in enumerate(columns.names or ()):
                table[name] = np.array(words[i::width], columns[i])
        except (ValueError, OverflowError) as error:
            raise SceneError(f"{self.where}: expected {expected} ({error}); {ADVICE}") from error
        return table

    def _value(self, kind: str, name: str) -> Any:
        require(bool(self.words), self.where, name, "the end of the line")
        word = self.words.popleft()
        if kind in _WORDS:
            require(word in _WORDS[kind], self.where, f"{name}: one of {', '.join(_WORDS[kind])}", repr(word))
            return _WORDS[kind][word]
        if kind in _LARGEST:
            good = word.isascii() and word.isdigit() and len(word) <= 20 and int(word) <= _LARGEST[kind]
            require(good, self.where, f"{name}: an integer in [0, {_LARGEST[kind]}]", repr(word))
            return int(word)
        try:
            number = float(word) if _NUMERIC.issuperset(word) else math.nan
        except ValueError:
            number = math.nan
        if kind in "xz" and (_BROKEN.fullmatch(word) or abs(number) >= MAX_NUMBER):
            return math.nan
        require(abs(number) < MAX_NUMBER, self.where, f"{name}: a finite number", repr(word))
        return number


def open_table(path: Path) -> Table:
    """Open one file of a model; its suffix says whether it is binary or text."""
    return _Binary(path) if path.suffix == ".bin" else _Text(path)
