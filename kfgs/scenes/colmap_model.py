"""Read a COLMAP model, binary or text: what is damaged is refused, numbers that are not finite are left out.

pycolmap 4.2.1 is not safe with files of strangers: it loads a truncated cameras.bin with wrong intrinsics, a corrupt points3D.bin
takes all memory, and names in text files are cut at blanks. So models are read here. `rigs` and `frames` (COLMAP 3.12) are not
needed: the images file has every pose, and the point that each 2-D point sees. Tracks tell whether the files are of one model.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fileinput import FileInput
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .._files import as_path, text_encoding
from .._notes import Repair
from ..cameras.camera import ROTATION_TOLERANCE
from ..formats.ply import to_number
from .files import MAX_NUMBER, MAX_SIDE, SceneError, is_inside, some
from .posed import Matrix

FILES = ("cameras", "images", "points3D")
# The models in the order of COLMAP's ids, with their parameters. Those that begin with f are focal lengths.
CAMERA_MODELS: dict[str, str] = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k", "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2", "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k", "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "SIMPLE_DIVISION": "f cx cy k", "DIVISION": "fx fy cx cy k", "SIMPLE_FISHEYE": "f cx cy", "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta", "EQUIRECTANGULAR": "w h",
}  # fmt: skip
QUATERNION_SLACK = 0.1  # text files are rounded; a norm farther from 1 means a wrong byte
STRANGE = 0.5  # share of the 2-D points of tracks that see another point: two models, not a damaged one
LEAST_BYTES = 73  # of an image without 2-D points, with a name of one letter

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ColmapCamera:
    """A lens and a sensor, in COLMAP's words."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        size, count = (self.width, self.height), len(CAMERA_MODELS[self.model].split())
        if not (0 < min(size) <= max(size) <= MAX_SIDE and len(self.params) == count):
            raise ValueError(f"{len(self.params)} parameters, not {count}, of {self.model}, of {size} pixels")

    @property
    def usable(self) -> bool:
        """Whether the parameters are plausible numbers, and focal lengths above 0."""
        named = zip(CAMERA_MODELS[self.model].split(), self.params, strict=True)
        return all(abs(value) < MAX_NUMBER and (value > 0 or name[0] != "f") for name, value in named)


@dataclass
class ColmapImage:
    """One picture."""

    name: str
    camera_id: int
    pose: Matrix | None  # [4, 4] world to camera; None if it or the camera has numbers that are not finite or plausible
    norm: float = 1.0  # the length of the file's quaternion
    observed: Ints = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[n] the id of the 3-D point that each 2-D point sees, -1 = none."""


@dataclass(frozen=True, repr=False)
class ColmapModel:
    """The content of a COLMAP model."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    point_ids: Ints  # [P] ascending
    points: Matrix  # [P, 3]
    colors: NDArray[np.uint8]  # [P, 3]
    notes: tuple[str, ...] = ()  # what was left out


def has_model(path: str | Path) -> bool:
    """Whether a folder holds a COLMAP cameras or images file, whole or not."""
    return any((as_path(path) / f"{name}.{suffix}").is_file() for name in FILES[:2] for suffix in ("bin", "txt"))


def count_images(model: Path) -> int | None:
    """The number of images in a model, without reading them; None if it is seen to be damaged."""
    file = model / "images.bin"
    with suppress(OSError, ValueError):
        if file.is_file():
            with file.open("rb") as head:
                count = int.from_bytes(head.read(8), "little")
            return count if 8 + count * LEAST_BYTES <= file.stat().st_size else None
        file = model / "images.txt"
        with FileInput(file, encoding=text_encoding(file)) as lines:
            return sum(next(lines, "") != "" for _ in filter(_is_record, lines))
    return None


def read_model(path: str | Path) -> ColmapModel:
    """Read a COLMAP model, binary or, if there is none, text. A SceneError for one that is damaged names the file.

    Poses without finite numbers and a nearly unit quaternion become None; points that are not finite, and entries of tracks that
    lead to no 2-D point (of deleted images), are left out and noted.
    """
    folder = as_path(path)
    whole = [s for s in ("bin", "txt") if all((folder / f"{name}.{s}").is_file() for name in FILES)]
    if not whole:
        got = ", ".join(sorted(file.name for file in folder.iterdir() if file.stem in FILES)) or "none of these files"
        expected = "a COLMAP model (cameras, images and points3D, all as .bin or all as .txt)"
        raise SceneError(f"{folder}: expected {expected}, got {got}; copy the missing files or run COLMAP (`kfgs sfm`)")
    cameras, images, points = (_read_table(folder / f"{name}.{whole[0]}") for name in FILES)
    for key, image in images.items():
        if image.camera_id not in cameras:
            got = f"none for image {key} (camera {image.camera_id}); copy the cameras and images files of one model"
            raise SceneError(f"{folder}: expected cameras for all images, got {got}")
        if not cameras[image.camera_id].usable:
            image.pose = None
    ids = np.array(sorted(points), np.int64)
    rows = [points[i] for i in ids.tolist()]
    places = np.array([place for place, _, _ in rows], np.float64).reshape(-1, 3)
    colors = np.array([color for _, color, _ in rows], np.uint8).reshape(-1, 3)
    notes = _check_tracks(folder / f"{FILES[2]}.{whole[0]}", ids, [track for *_, track in rows], images)
    scaled = {image.name: image.norm for image in images.values() if abs(image.norm**2 - 1) > ROTATION_TOLERANCE}
    if scaled:
        ends = f"{min(scaled.values()):.6g} to {max(scaled.values()):.6g}"
        notes.append(f"{len(scaled)} quaternions have a length of {ends}, not 1: {some(list(scaled))}")
    good = (np.abs(places) < MAX_NUMBER).all(1)  # NaN fails
    if not good.all():
        lost = some(list(map(str, ids[~good])))
        notes.append(f"{(~good).sum()} of {len(ids)} points have no finite place and were left out (ids {lost})")
    return ColmapModel(cameras, images, ids[good], places[good], colors[good], tuple(map(Repair, notes)))


def _check_tracks(file: Path, ids: Ints, tracks: list[Ints], images: dict[int, ColmapImage]) -> list[str]:
    """A note if 2-D points that tracks name are not there, or do not name the point of the track.

    kfgs does not use the tracks. But images and points of which most do not fit together come from two different models.
    """
    owner = np.repeat(ids, list(map(len, tracks)))
    image_ids, numbers = np.concatenate([np.zeros((0, 2), np.int64), *tracks]).T
    known, observed = sorted(images), [images[i].observed for i in sorted(images)]
    sizes = np.array(list(map(len, observed)), np.int64)
    place, there = np.searchsorted(known, image_ids), np.isin(image_ids, known)
    there[there] = numbers[there] < sizes[place[there]]
    good, starts = there.copy(), np.cumsum(sizes) - sizes
    good[there] = np.concatenate([ids[:0], *observed])[starts[place[there]] + numbers[there]] == owner[there]
    if good.all():
        return []
    strange, lost = there & ~good, sorted(set(image_ids.tolist()) - set(images))
    wrong = int(np.flatnonzero(strange if strange.any() else ~good)[0])
    example = f"point {owner[wrong]} names 2-D point {numbers[wrong]} of image {image_ids[wrong]}"
    if strange.sum() > STRANGE * there.sum():
        got = f"{strange.sum()} that see other points ({example}); copy the images and points files of one model"
        raise SceneError(f"{file}: expected tracks over 2-D points that see them, got {got}")
    gone = f"; images {some(list(map(str, lost)))} are not in the model" if lost else ""
    count = f"{(~good).sum()} of {len(good)} entries of tracks"
    return [f"{count} lead to no 2-D point that sees the point and were left out ({example}{gone})"]


def _read_table(file: Path) -> dict[int, Any]:
    """The records of a file by their ids."""
    table = dict[int, Any]()
    with FileInput(file, encoding=text_encoding(file)) as lines:
        try:
            for key, value in READERS[file.name](file if file.suffix == ".bin" else lines):
                if key in table:
                    raise ValueError(f"id {key} again")
                table[key] = value
        except (ValueError, KeyError, OverflowError, struct.error) as error:
            place = f"record {len(table) + 1}" if file.suffix == ".bin" else f"line {lines.lineno() or 1}"
            advice = "copy the model again from its source, or write it again with COLMAP"
            text = f"expected a COLMAP model, but {place} is truncated or damaged ({error})"
            raise SceneError(f"{file}: {text}; {advice}") from error
    return table


class _Binary(mmap.mmap):
    """A file of little-endian records without padding. It is mapped: only the parts that are used take memory."""

    def __new__(cls, file: Path) -> _Binary:
        with file.open("rb") as opened:
            return super().__new__(cls, opened.fileno(), 0, access=mmap.ACCESS_READ)

    def records(self) -> Iterator[_Binary]:
        """This, at the beginning of each record; the file must end after the last."""
        for _ in range(*self.take("Q")):
            yield self
        if self.tell() != len(self):
            raise ValueError(f"{len(self) - self.tell()} bytes follow the last")

    def take(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack("<" + layout, self.read(struct.calcsize("<" + layout)))

    def take_name(self) -> str:
        length = self.find(b"\0", self.tell()) - self.tell()
        if length < 0:
            raise ValueError("its name does not end")
        return self.read(length + 1)[:-1].decode("utf-8")

    def take_array(self, dtype: np.dtype[Any]) -> NDArray[Any]:
        (count,) = self.take("Q")
        return np.frombuffer(self.read(count * dtype.itemsize), dtype, count)  # refuses more than there is


def _binary_cameras(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    models = dict(enumerate(CAMERA_MODELS))
    for record in _Binary(file).records():
        key, number, width, height = record.take("IiQQ")
        params = record.take(f"{len(CAMERA_MODELS[models[number]].split())}d")
        yield key, ColmapCamera(models[number], width, height, params)


def _binary_images(file: Path) -> Iterator[tuple[int, ColmapImage]]:
    points = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
    for record in _Binary(file).records():
        key, *pose, camera_id = record.take("I7dI")
        image = _image(record.take_name(), camera_id, pose)
        image.observed = record.take_array(points)["id"].astype(np.int64)
        yield key, image


def _binary_points(file: Path) -> Iterator[tuple[int, tuple[Any, ...]]]:
    track = np.dtype(("<u4", 2))
    for record in _Binary(file).records():
        key, x, y, z, *color, _ = record.take("q3d3Bd")
        yield key, ((x, y, z), color, record.take_array(track).astype(np.int64))


def _is_record(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _text_cameras(lines: FileInput[str]) -> Iterator[tuple[int, ColmapCamera]]:
    for line in filter(_is_record, lines):
        key, model, width, height, *params = line.split()
        yield int(key), ColmapCamera(model, int(width), int(height), tuple(map(to_number, params)))


def _text_images(lines: FileInput[str]) -> Iterator[tuple[int, ColmapImage]]:
    """Two lines each, of which the second may be empty. It is read when the first is known to be good: errors name a line."""
    for line in filter(_is_record, lines):
        key, *words, camera_id, name = line.strip().split(maxsplit=9)  # a name may hold blanks
        image = _image(name, int(camera_id), list(map(to_number, words)))
        yield int(key), image
        points = next(lines, "no line of 2-D points").split()
        if len(points) % 3:
            raise ValueError(f"{points[:4]} are not 2-D points as X Y POINT3D_ID")
        image.observed = np.array(points[2::3], np.int64)


def _text_points(lines: FileInput[str]) -> Iterator[tuple[int, tuple[Any, ...]]]:
    for line in filter(_is_record, lines):
        key, x, y, z, r, g, b, _, *track = line.split()
        color = int(r), int(g), int(b)
        pairs = np.array(track, np.int64).reshape(-1, 2)
        if not 0 <= min(color) <= max(color) <= 255 or (pairs < 0).any():
            raise ValueError(f"colour {color}, track {track[:6]}")
        yield int(np.int64(int(key))), ((to_number(x), to_number(y), to_number(z)), color, pairs)


READERS: dict[str, Callable[[Any], Iterator[tuple[int, Any]]]] = {
    "cameras.bin": _binary_cameras, "images.bin": _binary_images, "points3D.bin": _binary_points,
    "cameras.txt": _text_cameras, "images.txt": _text_images, "points3D.txt": _text_points,
}  # fmt: skip


def _image(name: str, camera_id: int, numbers: list[float]) -> ColmapImage:
    """An image with its pose from qw qx qy qz tx ty tz."""
    if not (name.isprintable() and is_inside(name)):
        raise ValueError(f"{name!r} is not a file inside the image folder: rename the image in the model")
    if len(numbers) != 7:
        raise ValueError(f"{len(numbers)} numbers of its pose, not 7: qw qx qy qz tx ty tz")
    w, x, y, z, tx, ty, tz = numbers
    norm = math.hypot(w, x, y, z)
    if not abs(norm - 1) < QUATERNION_SLACK or not all(abs(number) < MAX_NUMBER for number in numbers):
        return ColmapImage(name, camera_id, None)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), (tx, ty, tz)
    return ColmapImage(name, camera_id, pose, norm)
