"""What a COLMAP model must hold before pycolmap may see it: the tables, their numbers, and how they refer to each other.

Both layouts are read into these tables, the three files of old (cameras, images, points3D) and the five of COLMAP 3.12
and later (rigs, frames as well), from binary (`colmap_binary`) or text (`colmap_text`).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import SceneError

# COLMAP's id: (name, number of parameters, how many of them, at the front, are focal lengths)
CAMERA_MODELS: dict[int, tuple[str, int, int]] = {
    0: ("SIMPLE_PINHOLE", 3, 1),
    1: ("PINHOLE", 4, 2),
    2: ("SIMPLE_RADIAL", 4, 1),
    3: ("RADIAL", 5, 1),
    4: ("OPENCV", 8, 2),
    5: ("OPENCV_FISHEYE", 8, 2),
    6: ("FULL_OPENCV", 12, 2),
    7: ("FOV", 5, 2),
    8: ("SIMPLE_RADIAL_FISHEYE", 4, 1),
    9: ("RADIAL_FISHEYE", 5, 1),
    10: ("THIN_PRISM_FISHEYE", 12, 2),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2),
    12: ("SIMPLE_DIVISION", 4, 1),
    13: ("DIVISION", 5, 2),
    14: ("SIMPLE_FISHEYE", 3, 1),
    15: ("FISHEYE", 4, 2),
    16: ("EUCM", 6, 2),
    17: ("EQUIRECTANGULAR", 2, 0),
}
CAMERA_SENSOR = 0  # COLMAP's sensor types: -1 invalid, 0 camera, 1 IMU
SENSOR_NAMES = {"INVALID": -1, "CAMERA": CAMERA_SENSOR, "IMU": 1}

MAX_SIDE = 100_000  # pixels: beyond any sensor, so a larger number is a wrong byte
MAX_NUMBER = 1e15  # of lengths and intrinsics: still far inside float32
QUATERNION_SLACK = 0.1  # text files are rounded; a norm further from 1 is no rotation but a wrong byte
ADVICE = "copy the model again from its source, or write it again with COLMAP"


@dataclass
class ImageRecord:
    """One row of images.{bin,txt}."""

    name: str
    camera_id: int
    points: NDArray[np.int64]
    """[n] which 3-D point each 2-D point of the image sees, -1 = none."""


Sensor = tuple[int, int]
"""(type, id)."""


@dataclass
class FrameRecord:
    """One row of frames.{bin,txt}."""

    rig_id: int
    data: list[tuple[int, int, int]]
    """(sensor type, sensor id, data id); the data of a camera are an image."""


@dataclass
class Model:
    """All tables of one COLMAP model."""

    cameras: set[int] = field(default_factory=set)
    images: dict[int, ImageRecord] = field(default_factory=dict)
    points: int = 0
    rigs: dict[int, list[Sensor]] | None = None
    frames: dict[int, FrameRecord] | None = None


class Tracks(NamedTuple):
    """Which images see each point: flat columns over the points, and over all observations."""

    point_ids: array[int]
    """[P]."""
    lengths: array[int]
    """[P] observations of each point."""
    image_ids: NDArray[np.int64]
    """[T]."""
    observations: NDArray[np.int64]
    """[T] which 2-D point of that image."""


class Readers(NamedTuple):
    """How the five files of one layout, binary or text, are read."""

    cameras: Callable[[Path], set[int]]
    images: Callable[[Path], dict[int, ImageRecord]]
    points: Callable[[Path], Tracks]
    rigs: Callable[[Path], dict[int, list[Sensor]]]
    frames: Callable[[Path], dict[int, FrameRecord]]


def walk_model(folder: Path, suffix: str, readers: Readers) -> Model:
    """Read the files of a model and check that they refer to each other rightly; see `colmap_check.check_model`."""
    paths = {name: folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    model = Model(readers.cameras(paths["cameras"]), readers.images(paths["images"]))
    check_images(str(paths["images"]), model.images, model.cameras)
    tracks = readers.points(paths["points3D"])
    check_tracks(str(paths["points3D"]), tracks, model.images)
    model.points = len(tracks.point_ids)
    if paths["rigs"].is_file():
        model.rigs = readers.rigs(paths["rigs"])
    if paths["frames"].is_file():
        model.frames = readers.frames(paths["frames"])
    check_rigs(folder, suffix, model)
    return model


def require(condition: bool, where: str, expected: str, got: object, advice: str = ADVICE) -> None:
    """Raise a SceneError in four parts unless `condition` holds."""
    if not condition:
        raise SceneError(f"{where}: expected {expected}, got {got}; {advice}")


def check_camera(where: str, model: str, width: int, height: int, params: Sequence[float]) -> None:
    """Sizes and intrinsics that a camera can have; `where` names the file and the record."""
    _, _, focal_lengths = next(entry for entry in CAMERA_MODELS.values() if entry[0] == model)
    require(
        0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE,
        where,
        f"an image of 1 to {MAX_SIDE} pixels a side",
        f"{width} x {height}",
    )
    require(all(abs(p) < MAX_NUMBER for p in params), where, "finite, plausible parameters", list(params))
    require(all(f > 0 for f in params[:focal_lengths]), where, "a focal length above 0", list(params[:focal_lengths]))


def check_pose(where: str, pose: Sequence[float]) -> None:
    """A unit quaternion (wxyz) and a finite translation."""
    require(all(abs(p) < MAX_NUMBER for p in pose), where, "a finite pose (qw qx qy qz tx ty tz)", list(pose))
    norm = math.hypot(*pose[:4])
    require(abs(norm - 1) < QUATERNION_SLACK, where, "a unit quaternion", f"{list(pose[:4])} of length {norm:.3g}")


def check_name(where: str, name: str) -> None:
    """A file name inside the image folder."""
    inside = not PurePosixPath(name).is_absolute() and ".." not in PurePosixPath(name).parts
    require(
        bool(name) and name.isprintable() and inside,
        where,
        "an image's file name inside the image folder",
        repr(name),
        "rename the image in the model (no absolute path, no '..', no control characters)",
    )


def check_positions(where: str, positions: array[float]) -> None:
    """[3 P] coordinates of the points."""
    finite = np.abs(np.frombuffer(positions, dtype=np.float64)) < MAX_NUMBER if positions else np.ones(0, bool)
    if not finite.all():
        first = int(np.flatnonzero(~finite)[0]) // 3
        require(False, f"{where}, point {first}", "finite coordinates", list(positions[3 * first : 3 * first + 3]))


def check_images(where: str, images: dict[int, ImageRecord], cameras: set[int]) -> None:
    """Images refer to cameras that exist, under names that differ."""
    seen: dict[str, int] = {}
    for image_id, image in images.items():
        known = f"a camera of the model ({', '.join(map(str, sorted(cameras)[:8])) or 'it has none'})"
        require(image.camera_id in cameras, f"{where}, image {image_id}", known, f"camera {image.camera_id}")
        require(
            image.name not in seen,
            f"{where}, image {image_id}",
            "a name of its own",
            f"{image.name!r} again (as image {seen.get(image.name)})",
        )
        seen[image.name] = image_id


def check_tracks(where: str, tracks: Tracks, images: dict[int, ImageRecord]) -> None:
    """Points have ids of their own, and points and 2-D points name each other.

    pycolmap fails with an IndexError or a CHECK that names no file otherwise.
    """
    ids = np.asarray(tracks.point_ids, dtype=np.uint64).view(np.int64)
    require(len(np.unique(ids)) == len(ids), where, "each point id once", "a repeated id")
    if len(tracks.image_ids) == 0:
        return
    known = np.array(sorted(images), dtype=np.int64)
    sizes = np.array([len(images[int(i)].points) for i in known], dtype=np.int64)
    place = np.searchsorted(known, tracks.image_ids).clip(max=max(len(known) - 1, 0))
    inside = known[place] == tracks.image_ids if len(known) else np.zeros(len(tracks.image_ids), bool)
    inside[inside] = tracks.observations[inside] < sizes[place[inside]]
    owner = np.repeat(ids, np.asarray(tracks.lengths, dtype=np.int64))
    good = inside.copy()
    if inside.any():
        flat = np.concatenate([images[int(i)].points for i in known])
        first = np.cumsum(sizes) - sizes
        good[inside] = flat[first[place[inside]] + tracks.observations[inside]] == owner[inside]
    if not good.all():
        _report_track(where, tracks, images, owner, int(np.flatnonzero(~good)[0]))


def _report_track(
    where: str, tracks: Tracks, images: dict[int, ImageRecord], owner: NDArray[np.int64], wrong: int
) -> None:
    image_id, observation = int(tracks.image_ids[wrong]), int(tracks.observations[wrong])
    if image_id not in images:
        says = "an image that is not in the model"
    elif observation >= len(images[image_id].points):
        says = f"an image that has {len(images[image_id].points)} 2-D points"
    else:
        says = f"which sees point {images[image_id].points[observation]}"
    require(
        False,
        f"{where}, point {int(owner[wrong]) % 2**64}",
        "a track over 2-D points that see it",
        f"2-D point {observation} of image {image_id}, {says}",
        "write images and points with the same run of COLMAP; if the 2-D points were stripped, empty the tracks too",
    )


def check_rigs(folder: Path, suffix: str, model: Model) -> None:
    """Rigs refer to cameras, frames to rigs and images, and every image belongs to exactly one frame."""
    rigs, frames = model.rigs, model.frames
    if not rigs and not frames:
        return  # absent or both empty: pycolmap makes one rig per camera
    require(
        bool(rigs) and bool(frames),
        f"{folder}",
        f"rigs{suffix} and frames{suffix} together",
        f"{len(rigs or ())} rigs and {len(frames or ())} frames",
        "copy both files, or delete both (the poses in the images file are then used)",
    )
    assert rigs is not None
    assert frames is not None
    for rig_id, sensors in rigs.items():
        for sensor_type, camera_id in sensors:
            known = sensor_type != CAMERA_SENSOR or camera_id in model.cameras
            require(known, f"{folder / f'rigs{suffix}'}, rig {rig_id}", "a camera of the model", f"camera {camera_id}")
    where = f"{folder / f'frames{suffix}'}"
    frame_of: dict[int, int] = {}
    for frame_id, frame in frames.items():
        require(frame.rig_id in rigs, f"{where}, frame {frame_id}", "a rig of the model", f"rig {frame.rig_id}")
        for sensor_type, sensor_id, data_id in frame.data:
            here = f"{where}, frame {frame_id}"
            sensor = f"sensor {sensor_id} of type {sensor_type}"
            require((sensor_type, sensor_id) in rigs[frame.rig_id], here, f"a sensor of rig {frame.rig_id}", sensor)
            if sensor_type != CAMERA_SENSOR:
                continue
            require(data_id not in frame_of, here, "images of one frame only", f"image {data_id} for the second time")
            frame_of[data_id] = frame_id
            image = model.images.get(data_id)
            own = image is None or image.camera_id == sensor_id
            require(own, here, f"image {data_id} with its own camera", f"camera {sensor_id}")
    lost = sorted(set(model.images) - set(frame_of))
    require(not lost, where, "every image in one frame", f"{len(lost)} images in none (image {lost[:1]})")
