"""Walk binary COLMAP files record by record without trusting a single count in them.

Layout (little-endian, no padding; COLMAP's `reconstruction_io_binary`), every file beginning with a uint64 count:
cameras: uint32 id, int32 model, uint64 width, uint64 height, float64 parameters.
images: uint32 id, float64 qw qx qy qz tx ty tz, uint32 camera, name ending in NUL, uint64 n, n x (float64 x y, uint64 point).
points3D: uint64 id, float64 x y z, uint8 r g b, float64 error, uint64 n, n x (uint32 image, uint32 index).
rigs: uint32 id, uint32 n; if n > 0: int32 type, uint32 id of the reference sensor, then n - 1 x (int32 type, uint32 id,
uint8 has_pose, if so float64 qw qx qy qz tx ty tz).
frames: uint32 id, uint32 rig, float64 qw qx qy qz tx ty tz, uint32 n, n x (int32 type, uint32 sensor, uint64 data).
"""

from __future__ import annotations

import mmap
import struct
from array import array
from pathlib import Path

import numpy as np

from . import colmap_tables as tables
from .colmap_tables import CAMERA_MODELS, FrameRecord, ImageRecord, Model, Readers, Sensor, Tracks, require, walk_model
from .errors import SceneError

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")
_FRAME = struct.Struct("<II7dI")
_DATA = struct.Struct("<iIQ")
_POSE = struct.Struct("<7d")
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK = np.dtype([("image", "<u4"), ("observation", "<u4")])
_LONGEST_NAME = 4096  # bytes, the longest path of Linux


class _Cursor:
    """A position in a file that never leaves it. The file is mapped, so memory follows what is kept of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        self.position = 0
        require(self.size >= _COUNT.size, str(path), "at least the 8 bytes of a count", f"{self.size} bytes")
        with path.open("rb") as file:
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def advance(self, length: int, what: str) -> int:
        """Step over `length` bytes and return where they began."""
        left = self.size - self.position
        if length > left:
            raise SceneError(
                f"{self.path}: expected {length} bytes of {what} at byte {self.position}, got the end of the file after "
                f"{left}: it is truncated or corrupt; {tables.ADVICE}"
            )
        start = self.position
        self.position += length
        return start

    def take(self, layout: struct.Struct, what: str) -> tuple[int | float, ...]:
        """Unpack one structure."""
        start = self.advance(layout.size, what)
        return layout.unpack_from(self.data, start)

    def count(self, what: str, smallest: int) -> int:
        """A uint64 count of records of at least `smallest` bytes, which the rest of the file must be able to hold."""
        (count,) = self.take(_COUNT, f"the number of {what}")
        return self.hold(int(count), what, smallest)

    def hold(self, count: int, what: str, smallest: int) -> int:
        left = self.size - self.position
        require(count * smallest <= left, str(self.path), f"at most {left // smallest} {what} in {left} bytes", count)
        return count

    def name(self, what: str) -> str:
        """A NUL-terminated UTF-8 string."""
        end = self.data.find(b"\0", self.position, min(self.position + _LONGEST_NAME, self.size))
        require(end >= 0, str(self.path), f"{what}: a name that ends", f"none within {_LONGEST_NAME} bytes")
        raw = self.data[self.position : end]
        self.position = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise SceneError(
                f"{self.path}: expected {what} to have a UTF-8 name, got {raw[:40]!r}; {tables.ADVICE}"
            ) from error

    def finish(self) -> None:
        """The file must end here."""
        left = self.size - self.position
        require(left == 0, str(self.path), f"the end of the file at byte {self.position}", f"{left} more bytes")


def _read_cameras(path: Path) -> set[int]:
    cursor, cameras = _Cursor(path), set[int]()
    for i in range(cursor.count("cameras", _CAMERA.size + 16)):  # no model has fewer than two parameters
        where = f"{path}, camera {i}"
        camera_id, model_id, width, height = map(int, cursor.take(_CAMERA, f"camera {i}"))
        require(model_id in CAMERA_MODELS, where, f"a camera model id in 0..{max(CAMERA_MODELS)}", model_id)
        name, parameters, _ = CAMERA_MODELS[model_id]
        params = cursor.take(struct.Struct(f"<{parameters}d"), f"parameters of camera {i} ({name})")
        tables.check_camera(where, name, width, height, params)
        require(camera_id not in cameras, where, "an id of its own", f"{camera_id} again")
        cameras.add(camera_id)
    cursor.finish()
    return cameras


def _read_images(path: Path) -> dict[int, ImageRecord]:
    cursor, images = _Cursor(path), dict[int, ImageRecord]()
    for i in range(cursor.count("images", _IMAGE.size + 1 + _COUNT.size)):
        where = f"{path}, image {i}"
        image_id, *pose, camera_id = cursor.take(_IMAGE, f"image {i}")
        tables.check_pose(where, pose)
        name = cursor.name(f"image {i}")
        tables.check_name(where, name)
        what = f"2-D points of image {i}"
        count = cursor.count(what, _OBSERVATION.itemsize)
        start = cursor.advance(count * _OBSERVATION.itemsize, what)
        seen = np.frombuffer(cursor.data, dtype=_OBSERVATION, count=count, offset=start)["point"].astype(np.int64)
        require(image_id not in images, where, "an id of its own", f"{image_id} again")
        images[int(image_id)] = ImageRecord(name, int(camera_id), seen)
    cursor.finish()
    return images


def _read_points(path: Path) -> Tracks:
    cursor = _Cursor(path)
    ids, positions, lengths, parts = array("Q"), array("d"), array("Q"), []
    for i in range(cursor.count("points", _POINT.size)):
        point_id, x, y, z, *_, length = cursor.take(_POINT, f"point {i}")
        ids.append(int(point_id))
        positions.extend((x, y, z))
        lengths.append(cursor.hold(int(length), f"observations of point {i}", _TRACK.itemsize))
        start = cursor.advance(int(length) * _TRACK.itemsize, f"observations of point {i}")
        parts.append(np.frombuffer(cursor.data, dtype=_TRACK, count=int(length), offset=start))
    cursor.finish()
    tables.check_positions(str(path), positions)
    track = np.concatenate(parts) if parts else np.zeros(0, _TRACK)
    return Tracks(ids, lengths, track["image"].astype(np.int64), track["observation"].astype(np.int64))


def _read_rigs(path: Path) -> dict[int, list[Sensor]]:
    cursor, rigs = _Cursor(path), dict[int, list[Sensor]]()
    for i in range(cursor.count("rigs", _RIG.size)):
        where = f"{path}, rig {i}"
        rig_id, count = map(int, cursor.take(_RIG, f"rig {i}"))
        cursor.hold(count, f"sensors of rig {i}", _SENSOR.size)
        sensors: list[Sensor] = []
        for j in range(count):
            kind, sensor_id = map(int, cursor.take(_SENSOR, f"sensor {j} of rig {i}"))
            sensors.append((kind, sensor_id))
            if j == 0:
                continue  # the reference sensor has no pose
            flag = cursor.data[cursor.advance(1, f"pose flag of sensor {j} of rig {i}")]
            require(flag in (0, 1), where, "a pose flag of 0 or 1", flag)
            if flag:
                tables.check_pose(f"{where}, sensor {j}", cursor.take(_POSE, f"pose of sensor {j} of rig {i}"))
        _check_sensors(where, sensors)
        require(rig_id not in rigs, where, "an id of its own", f"{rig_id} again")
        rigs[rig_id] = sensors
    cursor.finish()
    return rigs


def _read_frames(path: Path) -> dict[int, FrameRecord]:
    cursor, frames = _Cursor(path), dict[int, FrameRecord]()
    for i in range(cursor.count("frames", _FRAME.size)):
        where = f"{path}, frame {i}"
        frame_id, rig_id, *pose, count = cursor.take(_FRAME, f"frame {i}")
        tables.check_pose(where, pose)
        data: list[tuple[int, int, int]] = []
        for j in range(cursor.hold(int(count), f"data of frame {i}", _DATA.size)):
            kind, sensor_id, data_id = map(int, cursor.take(_DATA, f"datum {j} of frame {i}"))
            data.append((kind, sensor_id, data_id))
        require(frame_id not in frames, where, "an id of its own", f"{frame_id} again")
        frames[int(frame_id)] = FrameRecord(int(rig_id), data)
    cursor.finish()
    return frames


def _check_sensors(where: str, sensors: list[Sensor]) -> None:
    kinds = {kind for kind, _ in sensors}
    require(kinds <= {0, 1}, where, "sensors of type 0 (camera) or 1 (IMU)", sorted(kinds))
    require(len(set(sensors)) == len(sensors), where, "each sensor once", sensors)


def read_binary(folder: Path) -> Model:
    """Walk the .bin files of a model."""
    return walk_model(folder, ".bin", Readers(_read_cameras, _read_images, _read_points, _read_rigs, _read_frames))
