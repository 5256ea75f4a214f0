"""Read a COLMAP model: refuse what is damaged, leave out numbers that are not finite.

pycolmap 4.2.1 is not safe with files of strangers: it loads a truncated cameras.bin with wrong intrinsics, a corrupt points3D.bin
takes all memory, and names in text files are cut at blanks. So models are read here. `rigs` and `frames` (COLMAP 3.12) are not
needed: the images file has every pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .._files import as_path
from .._notes import Repair
from .colmap_files import CAMERA_MODELS, BinaryTable, CameraRow, ImageRow, Ints, TextTable, require
from .files import MAX_NUMBER, MAX_SIDE, SceneError, is_inside, some
from .posed import Matrix, is_rotation, mending_notes

FILES = ("cameras", "images", "points3D")
QUATERNION_SLACK = 0.1  # text files are rounded; a norm farther from 1 means a wrong byte
STRANGE = 0.5  # share of the 2-D points of tracks that see another point: two models, not a damaged one


@dataclass(frozen=True)
class ColmapCamera:
    """A lens and a sensor, in COLMAP's words."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def usable(self) -> bool:
        """Whether the parameters are plausible numbers, and focal lengths above 0."""
        focal = [v for name, v in zip(CAMERA_MODELS[self.model].split(), self.params, strict=True) if name[0] == "f"]
        return all(abs(value) < MAX_NUMBER for value in self.params) and all(f > 0 for f in focal)


@dataclass(frozen=True)
class ColmapImage:
    """One picture."""

    name: str
    camera_id: int
    pose: Matrix | None
    """[4, 4] world to camera; None if the file has no plausible one."""
    observed: Ints = field(repr=False)
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


def model_suffix(folder: Path) -> str | None:
    """`bin` or `txt`, whichever all three files have; None if neither."""
    return next((s for s in ("bin", "txt") if all((folder / f"{name}.{s}").is_file() for name in FILES)), None)


def read_model(path: str | Path) -> ColmapModel:
    """Read a COLMAP model, binary or, if there is none, text.

    What does not fit together is refused. Poses without finite numbers and a unit quaternion become None; points that are not
    finite, and entries of tracks that lead to no 2-D point (of deleted images), are left out and noted.
    """
    folder = as_path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected a COLMAP model there")
    suffix = model_suffix(folder)
    if suffix is None:
        present = sorted(file.name for file in folder.iterdir() if file.stem in FILES)
        raise SceneError(
            f"{folder}: expected a COLMAP model (cameras, images and points3D, all as .bin or all as .txt), got "
            f"{', '.join(present) or 'none of these files'}; copy the missing files or run COLMAP (`kfgs sfm`)"
        )
    files = [folder / f"{name}.{suffix}" for name in FILES]
    table, scales = BinaryTable if suffix == "bin" else TextTable, dict[str, float]()
    cameras = _cameras(table(files[0]).cameras())
    images = _images(table(files[1]).images(), cameras, scales)
    rows = sorted(table(files[2]).points(), key=lambda row: row[0])
    ids = np.array([row[0] for row in rows], np.int64)
    points = np.array([row[1] for row in rows], np.float64).reshape(-1, 3)
    colors = np.array([row[2] for row in rows], np.uint8).reshape(-1, 3)
    twice = ids[1:][ids[1:] == ids[:-1]]
    require(len(twice) == 0, str(files[2]), "each point id once", f"{twice[:1]} again")
    notes = _check_tracks(str(files[2]), ids, [row[3] for row in rows], images) + mending_notes([], scales)
    good = (np.abs(points) < MAX_NUMBER).all(1)  # NaN fails
    if not good.all():
        lost = some(list(map(str, ids[~good])))
        notes.append(f"{(~good).sum()} of {len(ids)} points have no finite place and were left out (ids {lost})")
    lensless = [image.name for image in images.values() if not cameras[image.camera_id].usable]
    if lensless:
        lens = "a camera without a focal length above 0 and finite parameters"
        notes.append(f"{len(lensless)} images have {lens}: {some(lensless)}")
    return ColmapModel(cameras, images, ids[good], points[good], colors[good], tuple(map(Repair, notes)))


def read_whole_model(path: str | Path) -> ColmapModel:
    """Read a model of which pycolmap needs all: nothing may be left out."""
    model = read_model(path)
    advice = "write a whole binary model with COLMAP, or estimate one: `kfgs sfm PHOTOS --out OUT`"
    require(not model.notes, str(path), "a model with nothing broken, for pycolmap", "; ".join(model.notes), advice)
    blank = next((image.name for image in model.images.values() if len(image.name.split()) > 1), "")
    expected = "names without blanks, at which COLMAP cuts those of text files"
    require(model_suffix(as_path(path)) == "bin" or not blank, str(path), expected, repr(blank), advice)
    return model


def _cameras(rows: Iterator[CameraRow]) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for where, camera_id, model, width, height, params in rows:
        require(model in CAMERA_MODELS, where, f"a MODEL of {', '.join(CAMERA_MODELS)}", repr(model))
        count = len(CAMERA_MODELS[model].split())
        expected = f"the parameters {CAMERA_MODELS[model]} of {model}"
        require(len(params) == count, where, expected, f"{len(params)}")
        good = 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE
        require(good, where, f"an image of 1 to {MAX_SIDE} pixels a side", f"{width} x {height}")
        require(camera_id not in cameras, where, "an id that no other has", f"{camera_id} again")
        cameras[camera_id] = ColmapCamera(model, width, height, params)
    return cameras


def _images(
    rows: Iterator[ImageRow], cameras: dict[int, ColmapCamera], scales: dict[str, float]
) -> dict[int, ColmapImage]:
    images: dict[int, ColmapImage] = {}
    names: dict[str, int] = {}
    for where, image_id, numbers, camera_id, name, observed in rows:
        rename = "rename the image in the model (no absolute path, no '..', no control characters)"
        expected = "an image's file name inside the image folder"
        require(name.isprintable() and is_inside(name), where, expected, repr(name), rename)
        known = f"a camera of the model ({', '.join(map(str, sorted(cameras)[:8])) or 'it has none'})"
        require(camera_id in cameras, where, f"image {image_id}: {known}", f"camera {camera_id}")
        expected = f"image {image_id}: a name that no other image has"
        require(name not in names, where, expected, f"{name!r} again (as image {names.get(name)})")
        require(image_id not in images, where, "an id that no other has", f"{image_id} again")
        pose = _pose(numbers, f"image {image_id}", scales)
        images[image_id], names[name] = ColmapImage(name, camera_id, pose, observed), image_id
    return images


def _pose(numbers: tuple[float, ...], key: str, scales: dict[str, float]) -> Matrix | None:  # [4, 4]
    """A pose from qw qx qy qz tx ty tz; None if they are not finite, or the first four not a unit quaternion.

    As in pycolmap, the quaternion is not normalised, unless the result is not a rotation for `Camera`; then `scales` receives
    its length.
    """
    norm = math.hypot(*numbers[:4])
    if not abs(norm - 1) < QUATERNION_SLACK or not all(abs(number) < MAX_NUMBER for number in numbers):
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
    return _pose((*(number / norm for number in numbers[:4]), *translation), key, {})


def _check_tracks(where: str, ids: Ints, tracks: list[Ints], images: dict[int, ColmapImage]) -> list[str]:
    """A note if 2-D points that tracks name are not there, or do not name the point of the track.

    kfgs does not use the tracks. But images and points of which most do not fit together come from two different models.
    """
    owner = np.repeat(ids, list(map(len, tracks)))
    image_ids, numbers = np.concatenate([np.zeros((0, 2), np.int64), *tracks]).T
    known = sorted(images)
    sizes = np.array([len(images[i].observed) for i in known], np.int64)
    seen = np.concatenate([np.zeros(0, np.int64), *(images[i].observed for i in known)])
    place, there = np.searchsorted(known, image_ids), np.isin(image_ids, known)
    there[there] = numbers[there] < sizes[place[there]]
    good = there.copy()
    good[there] = seen[(np.cumsum(sizes) - sizes)[place[there]] + numbers[there]] == owner[there]
    if good.all():
        return []
    strange, lost = there & ~good, sorted(set(image_ids.tolist()) - set(images))
    wrong = int(np.flatnonzero(strange if strange.any() else ~good)[0])
    example = f"point {owner[wrong]} names 2-D point {numbers[wrong]} of image {image_ids[wrong]}"
    got = f"{strange.sum()} that see other points ({example})"
    fits = strange.sum() <= STRANGE * there.sum()
    require(fits, where, "tracks over 2-D points that see them", got, "copy the images and points files of one model")
    gone = f"; images {some(list(map(str, lost)))} are not in the model" if lost else ""
    count = f"{(~good).sum()} of {len(good)} entries of tracks"
    return [f"{count} lead to no 2-D point that sees the point and were left out ({example}{gone})"]
