"""Walk text COLMAP files line by line; the layouts are in the comments that COLMAP writes at their head."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import colmap_tables as tables
from .colmap_tables import (
    CAMERA_MODELS,
    SENSOR_NAMES,
    FrameRecord,
    ImageRecord,
    Model,
    Readers,
    Sensor,
    Tracks,
    require,
    walk_model,
)
from .errors import SceneError

_PARAMETERS = {name: parameters for name, parameters, _ in CAMERA_MODELS.values()}
_UINT32 = 2**32 - 1


class _Row:
    """The words of one line, taken from the left; numbers as C++ reads them, so no '1_000', no 'nan'."""

    def __init__(self, where: str, line: str) -> None:
        self.where, self.words, self.next = where, line.split(), 0

    def __len__(self) -> int:
        return len(self.words) - self.next

    def word(self, what: str) -> str:
        require(len(self) > 0, self.where, what, f"only {len(self.words)} words")
        self.next += 1
        return self.words[self.next - 1]

    def integer(self, what: str, largest: int = _UINT32) -> int:
        word = self.word(what)
        good = word.isascii() and word.isdigit() and len(word) <= 20 and int(word) <= largest
        require(good, self.where, f"{what}: an integer in [0, {largest}]", repr(word))
        return int(word)

    def number(self, what: str) -> float:
        word = self.word(what)
        plain = word.isascii() and set(word) <= set("0123456789+-.eE")
        try:
            value = float(word) if plain else float("nan")
        except ValueError:
            value = float("nan")
        require(abs(value) < tables.MAX_NUMBER, self.where, f"{what}: a finite number", repr(word))
        return value

    def pose(self) -> list[float]:
        pose = [self.number(name) for name in ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")]
        tables.check_pose(self.where, pose)
        return pose

    def sensor(self) -> Sensor:
        word = self.word("a sensor type")
        require(word in SENSOR_NAMES, self.where, f"a sensor type of {sorted(SENSOR_NAMES)}", repr(word))
        return SENSOR_NAMES[word], self.integer("a sensor id")

    def finish(self) -> None:
        require(len(self) == 0, self.where, f"a line of {self.next} words", f"{len(self.words)} words")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """All lines with their numbers from 1, stripped."""
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                yield number, line.strip()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: expected UTF-8 text, got other bytes ({error}); {tables.ADVICE}") from error


def _rows(path: Path) -> Iterator[_Row]:
    for number, line in _lines(path):
        if line and not line.startswith("#"):
            yield _Row(f"{path}, line {number}", line)


def _read_cameras(path: Path) -> set[int]:
    cameras: set[int] = set()
    for row in _rows(path):
        camera_id = row.integer("CAMERA_ID")
        model = row.word("MODEL")
        require(model in _PARAMETERS, row.where, f"a camera model of {', '.join(_PARAMETERS)}", repr(model))
        width, height = row.integer("WIDTH"), row.integer("HEIGHT")
        params = [row.number(f"parameter {i} of {model}") for i in range(_PARAMETERS[model])]
        row.finish()
        tables.check_camera(row.where, model, width, height, params)
        require(camera_id not in cameras, row.where, "an id of its own", f"{camera_id} again")
        cameras.add(camera_id)
    return cameras


def _read_images(path: Path) -> dict[int, ImageRecord]:
    images: dict[int, ImageRecord] = {}
    lines = _lines(path)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        row = _Row(f"{path}, line {number}", line)
        image_id = row.integer("IMAGE_ID")
        row.pose()
        camera_id, name = row.integer("CAMERA_ID"), row.word("NAME")
        if len(row):  # pycolmap 4.2.1 reads up to the first space and says nothing
            raise SceneError(
                f"{row.where}: expected an image name without spaces, got {' '.join(row.words[9:])!r}, which pycolmap "
                "would cut; rename the image, or write the model as binary (`colmap model_converter`)"
            )
        tables.check_name(row.where, name)
        below = next(lines, None)  # an image without this line is dropped silently by pycolmap
        require(below is not None, row.where, "a line of 2-D points (perhaps empty) below each image", "the end")
        assert below is not None
        require(image_id not in images, row.where, "an id of its own", f"{image_id} again")
        images[image_id] = ImageRecord(name, camera_id, _read_observations(f"{path}, line {below[0]}", below[1]))
    return images


def _read_observations(where: str, line: str) -> NDArray[np.int64]:
    """The 3-D point of each 2-D point, -1 = none."""
    words = line.split()
    require(len(words) % 3 == 0, where, "2-D points as X Y POINT3D_ID", f"{len(words)} words")
    try:
        np.array(words[0::3] + words[1::3], dtype=np.float64)
        return np.array(words[2::3], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise SceneError(f"{where}: expected 2-D points as X Y POINT3D_ID ({error}); {tables.ADVICE}") from error


def _read_points(path: Path) -> Tracks:
    ids, positions, lengths, track = array("Q"), array("d"), array("Q"), array("q")
    for row in _rows(path):
        ids.append(row.integer("POINT3D_ID", 2**64 - 1))
        positions.extend([row.number(name) for name in "XYZ"])
        for channel in "RGB":
            row.integer(channel, 255)
        row.number("ERROR")
        require(len(row) % 2 == 0, row.where, "a track as IMAGE_ID POINT2D_IDX", f"{len(row)} words")
        lengths.append(len(row) // 2)
        while len(row):
            track.append(row.integer("track"))
    flat = np.array(track, dtype=np.int64).reshape(-1, 2)
    return Tracks(ids, lengths, flat[:, 0], flat[:, 1])


def _read_rigs(path: Path) -> dict[int, list[Sensor]]:
    rigs: dict[int, list[Sensor]] = {}
    for row in _rows(path):
        rig_id, count = row.integer("RIG_ID"), row.integer("NUM_SENSORS")
        sensors: list[Sensor] = []
        for i in range(min(count, len(row))):  # a count beyond the words fails in row.sensor
            sensors.append(row.sensor())
            if i and row.integer("HAS_POSE", 1):
                row.pose()
        require(len(sensors) == count, row.where, f"{count} sensors", f"{len(sensors)}")
        require(len(set(sensors)) == len(sensors), row.where, "each sensor once", sensors)
        row.finish()
        require(rig_id not in rigs, row.where, "an id of its own", f"{rig_id} again")
        rigs[rig_id] = sensors
    return rigs


def _read_frames(path: Path) -> dict[int, FrameRecord]:
    frames: dict[int, FrameRecord] = {}
    for row in _rows(path):
        frame_id, rig_id = row.integer("FRAME_ID"), row.integer("RIG_ID")
        row.pose()
        count = row.integer("NUM_DATA_IDS")
        require(len(row) == 3 * count, row.where, f"{3 * count} words of {count} data ids", f"{len(row)} words")
        data = [(*row.sensor(), row.integer("DATA_ID", 2**64 - 1)) for _ in range(count)]
        row.finish()
        require(frame_id not in frames, row.where, "an id of its own", f"{frame_id} again")
        frames[frame_id] = FrameRecord(rig_id, data)
    return frames


def read_text(folder: Path) -> Model:
    """Walk the .txt files of a model."""
    return walk_model(folder, ".txt", Readers(_read_cameras, _read_images, _read_points, _read_rigs, _read_frames))
