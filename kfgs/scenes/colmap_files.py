"""The rows of the files of a COLMAP model, binary (.bin) and text (.txt).

Every count is compared with the rest of the file before it is used, so memory is bounded by the size of the file.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._files import text_encoding
from .files import SceneError

# The models in the order of COLMAP's ids, with their parameters. Those that begin with f are focal lengths.
CAMERA_MODELS: dict[str, str] = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k",
    "DIVISION": "fx fy cx cy k",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta",
    "EQUIRECTANGULAR": "w h",
}
ADVICE = "copy the model again from its source, or write it again with COLMAP"
_BROKEN = re.compile(r"[+-]?(nan\(\w*\)|1\.#\w+)", re.IGNORECASE)  # numbers that are none, as Windows writes them


Ints = NDArray[np.int64]
# The rows of the three tables; `where` is the place in the file, for messages.
CameraRow = tuple[str, int, str, int, int, tuple[float, ...]]  # where, id, model, width, height, parameters
ImageRow = tuple[str, int, tuple[float, ...], int, str, Ints]
"""where, id, qw qx qy qz tx ty tz (world to camera), camera, name, the 3-D point that each 2-D point sees (-1: none)."""
PointRow = tuple[int, tuple[float, ...], tuple[int, ...], Ints]
"""id, place, colour, track [n, 2]: the images that see the point, and the numbers of their 2-D points."""


def require(condition: bool, where: str, expected: str, got: object, advice: str = ADVICE) -> None:
    """Raise a SceneError in four parts unless `condition` holds."""
    if not condition:
        raise SceneError(f"{where}: expected {expected}, got {got}; {advice}")


class BinaryTable:
    """Little-endian, without padding: a uint64 number of records, then the records."""

    def __init__(self, path: Path) -> None:
        self.path, self.where, self.position, size = path, str(path), 0, path.stat().st_size
        require(size >= 8, self.where, "at least the 8 bytes of a count", f"{size} bytes")
        with path.open("rb") as file:  # mapped: only the parts that are used take memory
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def cameras(self) -> Iterator[CameraRow]:
        """The rows of the cameras file."""
        models = list(CAMERA_MODELS.items())
        for where in self._records("camera", 24 + 2 * 8):
            camera_id, model, width, height = self._take("IiQQ")
            require(0 <= model < len(models), where, f"a camera model in 0..{len(models) - 1}", model)
            name, params = models[model]
            yield where, camera_id, name, width, height, self._take(f"{len(params.split())}d")

    def images(self) -> Iterator[ImageRow]:
        """The rows of the images file."""
        for where in self._records("image", 4 + 7 * 8 + 4 + 1 + 8):
            image_id, *numbers, camera_id = self._take("I7dI")
            end = self.data.find(b"\0", self.position, self.position + 4096)  # the longest path of Linux
            require(end >= 0, where, "a NAME that ends", "none within 4096 bytes")
            raw, self.position = self.data[self.position : end], end + 1
            try:
                name = raw.decode("utf-8")
            except UnicodeDecodeError as error:
                raise SceneError(f"{where}: expected a UTF-8 NAME, got {raw[:40]!r}; {ADVICE}") from error
            points = self._array(np.dtype([("X", "<f8"), ("Y", "<f8"), ("ID", "<i8")]), "2-D points")
            yield where, image_id, tuple(numbers), camera_id, name, points["ID"].astype(np.int64)

    def points(self) -> Iterator[PointRow]:
        """The rows of the points file."""
        for _ in self._records("point", 8 + 3 * 8 + 3 + 8 + 8):
            point_id, x, y, z, *rgb, _ = self._take("q3d3Bd")
            yield point_id, (x, y, z), tuple(rgb), self._array(np.dtype(("<u4", 2)), "the track").astype(np.int64)

    def _records(self, what: str, smallest: int) -> Iterator[str]:
        """The place of each record; the file must end after the last."""
        for i in range(self._count(f"number of {what}s", smallest)):
            self.where = f"{self.path}, {what} {i}"
            yield self.where
        left = len(self.data) - self.position
        require(left == 0, str(self.path), f"the end of the file at byte {self.position}", f"{left} more bytes")

    def _take(self, layout: str) -> tuple[Any, ...]:
        size, left = struct.calcsize("<" + layout), len(self.data) - self.position
        got = f"{left}: it is truncated or corrupt"
        require(size <= left, self.where, f"{size} bytes at byte {self.position}", got)
        self.position += size
        return struct.unpack_from("<" + layout, self.data, self.position - size)

    def _count(self, name: str, smallest: int) -> int:
        (count,) = self._take("Q")
        left = len(self.data) - self.position
        require(count * smallest <= left, self.where, f"at most {left // smallest} ({name}) in {left} bytes", count)
        return int(count)

    def _array(self, dtype: np.dtype[Any], what: str) -> NDArray[Any]:
        count = self._count(f"number of {what}", dtype.itemsize)
        self.position += count * dtype.itemsize
        return np.frombuffer(self.data, dtype, count, self.position - count * dtype.itemsize)


class TextTable:
    """One record per line; blank lines and lines that begin with # are passed over."""

    def __init__(self, path: Path) -> None:
        self.path, self.where, self.lines = path, str(path), self._lines()

    def cameras(self) -> Iterator[CameraRow]:
        """The rows of the cameras file."""
        for line in self._records():
            with self._parsing("CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
                camera_id, model, width, height, *params = line.split()
                row = self.where, int(camera_id), model, int(width), int(height), tuple(map(_number, params))
            yield row

    def images(self) -> Iterator[ImageRow]:
        """The rows of the images file: two lines each, of which the second may be empty."""
        for line in self._records():
            with self._parsing("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
                image_id, *words, camera_id, name = line.strip().split(maxsplit=9)  # a name may hold blanks
                first = self.where, int(image_id), tuple(map(_number, words)), int(camera_id), name
                if len(words) != 7:
                    raise ValueError(f"{len(words) + 3} words")
            below = next(self.lines, None)
            require(below is not None, first[0], "a line of 2-D points below each image", "the end of the file")
            with self._parsing("2-D points as X Y POINT3D_ID"):
                points = (below or "").split()
                if len(points) % 3:
                    raise ValueError(f"{len(points)} words")
                row = *first, np.array(points[2::3], np.int64)
            yield row

    def points(self) -> Iterator[PointRow]:
        """The rows of the points file."""
        for line in self._records():
            with self._parsing("POINT3D_ID X Y Z R G B ERROR TRACK as (IMAGE_ID POINT2D_IDX)"):
                point_id, x, y, z, r, g, b, _, *track = line.split()
                rgb, pairs = (int(r), int(g), int(b)), np.array(track, np.int64).reshape(-1, 2)
                if not all(0 <= value <= 255 for value in rgb) or (pairs < 0).any():
                    raise ValueError(f"colour {rgb}, track {track[:6]}")
                row = int(point_id), (_number(x), _number(y), _number(z)), rgb, pairs
            yield row

    def _lines(self) -> Iterator[str]:
        """All lines; `where` names the last one."""
        try:
            with self.path.open(encoding=text_encoding(self.path)) as file:
                for number, line in enumerate(file, 1):
                    self.where = f"{self.path}, line {number}"
                    yield line
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.path}: expected UTF-8 text, got other bytes ({error}); {ADVICE}") from error

    def _records(self) -> Iterator[str]:
        return (line for line in self.lines if line.strip() and not line.lstrip().startswith("#"))

    @contextmanager
    def _parsing(self, expected: str) -> Iterator[None]:
        try:
            yield
        except (ValueError, OverflowError) as error:
            raise SceneError(f"{self.where}: expected {expected}, got something else ({error}); {ADVICE}") from error


def _number(word: str) -> float:
    return math.nan if _BROKEN.fullmatch(word) else float(word)
