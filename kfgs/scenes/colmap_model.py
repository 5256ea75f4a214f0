"""Read a COLMAP model (binary or text): refuse what is damaged, leave out numbers that are none.

This is the only reader of models in kfgs. pycolmap 4.2.1 is not safe with untrusted files: it loads a truncated cameras.bin
with wrong intrinsics, a corrupt points3D.bin takes all memory, and random bytes in frames.bin never return. If
`read_whole_model` accepts a model, pycolmap reads it with the same result (`tests/scenes/test_colmap_model.py`).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from .._card import short_repr
from .._files import as_path
from .._notes import Repair
from .colmap_files import CAMERA_MODELS, OBSERVATIONS, TRACK, Table, open_table, require
from .files import MAX_SIDE, SceneError, some
from .poses import is_rotation, mending_notes

FILES = ("cameras", "images", "points3D")
QUATERNION_SLACK = 0.1  # text files are rounded; a norm farther from 1 means a wrong byte
ADVISED = "write a binary model of what is whole, with the same poses: `kfgs sfm SCENE --out OUT`"
STRANGE = 0.5  # share of the 2-D points of tracks that see another point: two models, not a damaged one
_POSE = "QW, QX, QY, QZ, TX, TY, TZ"
_CAMERA_SENSOR = 0

Sensor = tuple[int, int]
"""(type, id); type 0 is a camera, 1 an IMU."""
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class ColmapCamera:
    """A lens and a sensor, in COLMAP's words."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def usable(self) -> bool:
        """Whether the parameters are numbers, and focal lengths above 0."""
        names = dict(CAMERA_MODELS.values())[self.model].split(", ")
        focal = [value for name, value in zip(names, self.params, strict=True) if name.startswith("f")]
        return all(map(math.isfinite, self.params)) and all(f > 0 for f in focal)


@dataclass(frozen=True)
class ColmapImage:
    """One picture."""

    name: str
    camera_id: int
    pose: Matrix | None
    """[4, 4] world to camera; None: the file has none, or the place of the camera in its rig is unknown."""
    observed: NDArray[np.int64]
    """[n] the id of the 3-D point that each 2-D point sees, -1 = none."""

    __repr__ = short_repr


@dataclass(frozen=True)
class ColmapModel:
    """The content of a COLMAP model."""

    layout: str
    """`"binary"` or `"text"`. If both exist, binary is read, as in pycolmap."""
    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    point_ids: NDArray[np.uint64]
    """[P] ascending."""
    points: Matrix
    """[P, 3]."""
    colors: NDArray[np.uint8]
    """[P, 3]."""
    rigs: int
    """0 in the older layout of three files."""
    notes: tuple[str, ...] = ()
    """What was left out."""

    def __repr__(self) -> str:
        return f"ColmapModel({self.layout}, {len(self.cameras)} cameras, {len(self.images)} images, {len(self.points)} points)"


def has_model(path: str | Path) -> bool:
    """Whether a folder holds a COLMAP cameras or images file, whole or not."""
    return any((as_path(path) / f"{name}.{suffix}").is_file() for name in FILES[:2] for suffix in ("bin", "txt"))


def read_model(path: str | Path) -> ColmapModel:
    """Read a COLMAP model: binary or text, three files or, from COLMAP 3.12 on, five (rigs, frames).

    Checked are: each count against the size of the file, the exact end of each file, camera models and their number of
    parameters, plausible sizes, names inside the image folder, ids that are unique and refer to something that exists.
    Whether the poses are right is not checked. Poses without finite numbers and a unit quaternion become None. Points without
    finite numbers, and entries of tracks that lead to no 2-D point (of deleted images), are left out and noted.

    Args:
        path: the folder with `cameras`, `images`, `points3D` and perhaps `rigs`, `frames`, as .bin or as .txt.

    Raises:
        FileNotFoundError: if there is no such folder.
        SceneError: if the model is incomplete or damaged. The message names the file and the place in it.
    """
    folder = as_path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected a COLMAP model there")
    whole = [suffix for suffix in ("bin", "txt") if all((folder / f"{name}.{suffix}").is_file() for name in FILES)]
    if not whole:
        present = sorted(file.name for file in folder.iterdir() if file.stem in FILES)
        raise SceneError(
            f"{folder}: expected a COLMAP model (cameras, images and points3D, all as .bin or all as .txt), got "
            f"{', '.join(present) or 'none of these files'}; copy the missing files or run COLMAP (`kfgs sfm`)"
        )
    files = {name: folder / f"{name}.{whole[0]}" for name in (*FILES, "rigs", "frames")}
    tables = {name: open_table(file) for name, file in files.items() if file.is_file()}
    cameras = _read_cameras(tables["cameras"])
    scales: dict[str, float] = {}
    images = _read_images(tables["images"], cameras, scales)
    point_ids, points, colors, notes = _read_points(tables["points3D"], str(files["points3D"]), images)
    rigs = _read_rigs(tables["rigs"], cameras, scales) if "rigs" in tables else {}
    frames = _read_frames(tables["frames"], rigs, images, scales) if "frames" in tables else {}
    require(
        bool(rigs) == bool(frames),
        str(folder),
        f"rigs.{whole[0]} and frames.{whole[0]} together",
        f"{len(rigs)} rigs and frames of {len(frames)} images",
        "copy both files, or delete both (the poses in the images file are then used)",
    )
    if frames:  # else every image carries its pose
        lost = sorted(set(images) - set(frames))
        message = f"{len(lost)} images in none (image {lost[:1]})"
        require(not lost, str(files["frames"]), "every image in one frame", message)
        images = {i: replace(image, pose=frames[i]) for i, image in images.items()}
    notes += mending_notes([], {k: v for k, v in scales.items() if not (frames and k.startswith("image "))})
    lensless = [image.name for image in images.values() if not cameras[image.camera_id].usable]
    lens = "a camera without a focal length above 0 and finite parameters"
    notes += [f"{len(lensless)} images have {lens}: {some(lensless)}"] if lensless else []
    layout = "binary" if whole[0] == "bin" else "text"
    return ColmapModel(layout, cameras, images, point_ids, points, colors, len(rigs), tuple(map(Repair, notes)))


def read_whole_model(path: str | Path) -> ColmapModel:
    """Read a model for pycolmap, which needs all of it: nothing may be left out.

    Raises:
        FileNotFoundError: if there is no such folder.
        SceneError: if the model is damaged or partly broken, or has names in text files that pycolmap would cut at a blank.
    """
    model = read_model(path)
    require(not model.notes, str(path), "a model with nothing broken, for pycolmap", "; ".join(model.notes), ADVISED)
    blank = next((image.name for image in model.images.values() if len(image.name.split()) > 1), "")
    advice = f"{ADVISED}, or write _ for each blank, in images.txt and in the names of the files"
    expected = "names without blanks, at which COLMAP cuts those of text files"
    require(model.layout == "binary" or not blank, str(path), expected, repr(blank), advice)
    return model


def _new(where: str, key: int, known: object) -> int:
    require(key not in known, where, "an id that no other has", f"{key} again")  # type: ignore[operator]
    return key


def _pose(numbers: Sequence[float], key: str, scales: dict[str, float]) -> Matrix | None:  # [4, 4]
    """A pose from qw qx qy qz tx ty tz; None if they are no numbers, or the first four no unit quaternion.

    As in pycolmap, the quaternion is not normalised, and the sums are in Eigen's order; unless the result is not a rotation
    for `Camera`. Then it is, and `scales` receives its length.
    """
    norm = math.hypot(*numbers[:4])
    if not abs(norm - 1) < QUATERNION_SLACK or not all(map(math.isfinite, numbers)):
        return None
    w, x, y, z, *translation = numbers
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - (y2 * y + z2 * z), y2 * x - z2 * w, z2 * x + y2 * w],
        [y2 * x + z2 * w, 1 - (x2 * x + z2 * z), z2 * y - x2 * w],
        [z2 * x - y2 * w, z2 * y + x2 * w, 1 - (x2 * x + y2 * y)],
    ]
    pose[:3, 3] = translation
    if is_rotation(pose[:3, :3]):
        return pose
    scales[key] = norm
    return _pose([*(number / norm for number in numbers[:4]), *translation], key, {})


def _read_cameras(table: Table) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for where in table.records("camera", "ImQQ2d"):  # no model has fewer than two parameters
        camera_id, model = table.take("Im", "CAMERA_ID, MODEL")
        require(model in CAMERA_MODELS, where, f"a camera model in 0..{max(CAMERA_MODELS)}", model)
        name, params = CAMERA_MODELS[model]
        width, height = table.take("QQ", "WIDTH, HEIGHT")
        good = 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE
        require(good, where, f"an image of 1 to {MAX_SIDE} pixels a side", f"{width} x {height}")
        values = table.take(f"{params.count(',') + 1}z", params)
        cameras[_new(where, camera_id, cameras)] = ColmapCamera(name, width, height, values)
    return cameras


def _read_images(table: Table, cameras: dict[int, ColmapCamera], scales: dict[str, float]) -> dict[int, ColmapImage]:
    images: dict[int, ColmapImage] = {}
    names: dict[str, int] = {}
    for where in table.records("image", "I7dIBQ"):  # B: the end of the name
        image_id, *numbers, camera_id = table.take("I7zI", f"IMAGE_ID, {_POSE}, CAMERA_ID")
        name, pose = table.name(), _pose(numbers, f"image {image_id}", scales)
        inside = not PurePosixPath(name).is_absolute() and ".." not in PurePosixPath(name).parts
        require(
            bool(name) and name.isprintable() and inside,
            where,
            "an image's file name inside the image folder",
            repr(name),
            "rename the image in the model (no absolute path, no '..', no control characters)",
        )
        known = f"a camera of the model ({', '.join(map(str, sorted(cameras)[:8])) or 'it has none'})"
        require(camera_id in cameras, where, f"image {image_id}: {known}", f"camera {camera_id}")
        expected = f"image {image_id}: a name that no other image has"
        require(name not in names, where, expected, f"{name!r} again (as image {names.get(name)})")
        observed = table.rows(OBSERVATIONS, "2-D points")["POINT3D_ID"].astype(np.int64)
        images[_new(where, image_id, images)] = ColmapImage(name, camera_id, pose, observed)
        names[name] = image_id
    return images


def _read_points(
    table: Table, where: str, images: dict[int, ColmapImage]
) -> tuple[NDArray[np.uint64], Matrix, NDArray[np.uint8], list[str]]:
    """The points by ascending ids, and notes."""
    ids, xyz, rgb, tracks = array("Q"), array("d"), array("B"), [np.zeros(0, TRACK)]
    for _ in table.records("point", "Q3d3BxQ"):
        point_id, x, y, z, *color = table.take("Q3z3Bx", "POINT3D_ID, X, Y, Z, R, G, B, ERROR")
        ids.append(point_id)
        xyz.extend((x, y, z))
        rgb.extend(color)
        tracks.append(table.rows(TRACK, "the track"))
    point_ids = np.array(ids, np.uint64)
    order = np.argsort(point_ids)
    twice = point_ids[order][1:] == point_ids[order][:-1]
    require(not twice.any(), where, "each point id once", f"{point_ids[order][1:][twice][:1]} again")
    owner = np.repeat(point_ids.view(np.int64), list(map(len, tracks[1:])))
    notes = _check_tracks(where, owner, np.concatenate(tracks), images)
    points = np.array(xyz, np.float64).reshape(-1, 3)[order]
    finite = np.isfinite(points).all(1)
    if not finite.all():
        shown = some(list(map(str, point_ids[order][~finite])))
        notes.append(f"{(~finite).sum()} of {len(points)} points have no finite place and were left out (ids {shown})")
    return point_ids[order][finite], points[finite], np.array(rgb, np.uint8).reshape(-1, 3)[order][finite], notes


def _check_tracks(
    where: str, owner: NDArray[np.int64], track: NDArray[np.void], images: dict[int, ColmapImage]
) -> list[str]:
    """A note if 2-D points that tracks name are not there, or do not name the point of the track: pycolmap fails on them.

    kfgs does not use the tracks. But images and points of which most do not fit together come from two different models.
    """
    known = sorted(images)
    seen = [*(images[i].observed for i in known), np.zeros(1, np.int64)]  # at the end: no image, and what it sees
    sizes = np.array([*map(len, seen[:-1]), 0])
    image_ids, observations = track["IMAGE_ID"].astype(np.int64), track["POINT2D_IDX"].astype(np.int64)
    ordered = np.array([*known, 2**40])
    place = np.searchsorted(ordered, image_ids)
    there = (ordered[place] == image_ids) & (observations < sizes[place])
    flat = np.where(there, np.cumsum(sizes)[place] - sizes[place] + observations, -1)
    good = there & (np.concatenate(seen)[flat] == owner)
    if good.all():
        return []
    strange, lost = there & ~good, sorted(set(image_ids[ordered[place] != image_ids].tolist()))
    wrong = int(np.flatnonzero(strange if strange.any() else ~good)[0])
    example = f"point {int(owner[wrong]) % 2**64} names 2-D point {observations[wrong]} of image {image_ids[wrong]}"
    require(
        strange.sum() <= STRANGE * there.sum(), where, "tracks over 2-D points that see them",
        f"{strange.sum()} that see other points ({example})", "copy the images and points files of one model",
    )  # fmt: skip
    gone = f"; images {some(list(map(str, lost)))} are not in the model" if lost else ""
    count = f"{(~good).sum()} of {len(good)} entries of tracks"
    return [f"{count} lead to no 2-D point that sees the point and were left out ({example}{gone})"]


def _read_sensor(table: Table, where: str) -> Sensor:
    kind, sensor_id = table.take("sI", "SENSOR_TYPE, SENSOR_ID")
    require(kind in (0, 1), where, "a sensor of type 0 (camera) or 1 (IMU)", kind)
    return kind, sensor_id


def _read_rigs(
    table: Table, cameras: dict[int, ColmapCamera], scales: dict[str, float]
) -> dict[int, dict[Sensor, Matrix | None]]:
    """For each rig, the pose of each sensor (rig to sensor); None if unknown."""
    rigs: dict[int, dict[Sensor, Matrix | None]] = {}
    for where in table.records("rig", "II"):
        (rig_id,) = table.take("I", "RIG_ID")
        sensors: dict[Sensor, Matrix | None] = {}
        for i in range(table.count("NUM_SENSORS", "sI")):
            sensor = _read_sensor(table, where)
            known = sensor[0] != _CAMERA_SENSOR or sensor[1] in cameras
            require(known, where, f"rig {rig_id}: a camera of the model", f"camera {sensor[1]}")
            require(sensor not in sensors, where, f"rig {rig_id}: each sensor once", f"{sensor} again")
            sensors[sensor] = np.eye(4)  # the first sensor is the origin of the rig
            if i:
                (has_pose,) = table.take("B", "HAS_POSE")
                require(has_pose in (0, 1), where, "HAS_POSE of 0 or 1", has_pose)
                sensors[sensor] = _pose(table.take("7z", _POSE), f"rig {rig_id}", scales) if has_pose else None
        rigs[_new(where, rig_id, rigs)] = sensors
    return rigs


def _read_frames(
    table: Table,
    rigs: dict[int, dict[Sensor, Matrix | None]],
    images: dict[int, ColmapImage],
    scales: dict[str, float],
) -> dict[int, Matrix | None]:
    """World to camera of each image: the pose of its frame, then that of its camera in the rig."""
    poses: dict[int, Matrix | None] = {}
    frame_ids: set[int] = set()
    for where in table.records("frame", "II7dI"):
        frame_id, rig_id, *numbers = table.take("II7z", f"FRAME_ID, RIG_ID, {_POSE}")
        here = f"{where}, frame {frame_id}"
        require(rig_id in rigs, here, "a rig of the model", f"rig {rig_id}")
        rig_from_world = _pose(numbers, f"frame {frame_id}", scales)
        for _ in range(table.count("NUM_DATA_IDS", "sIQ")):
            sensor, (image_id,) = _read_sensor(table, where), table.take("Q", "DATA_ID")
            require(
                sensor in rigs[rig_id], here, f"a sensor of rig {rig_id}", f"sensor {sensor[1]} of type {sensor[0]}"
            )
            if sensor[0] != _CAMERA_SENSOR:
                continue
            require(image_id not in poses, here, "images of one frame only", f"image {image_id} for the second time")
            fits = image_id not in images or images[image_id].camera_id == sensor[1]
            require(fits, here, f"image {image_id} with the camera that took it", f"camera {sensor[1]}")
            placed = rigs[rig_id][sensor]
            poses[image_id] = None if placed is None or rig_from_world is None else placed @ rig_from_world
        frame_ids.add(_new(where, frame_id, frame_ids))
    return poses
