"""Read scenes from transforms.json (nerfstudio, instant-ngp, Blender).

**Convention**: `transform_matrix` is camera to world with OpenGL axes (x right, y up, z backward). kfgs wants world to
camera with y down and z forward, so the y and z columns change sign and the pose is inverted. World coordinates are those of
the file: `applied_transform`, which was applied to poses and points, is not undone.
`cx, cy` are read as in COLMAP (the centre of the first pixel is (0.5, 0.5)), because the converters of nerfstudio and
instant-ngp copy COLMAP's numbers and both programs sample pixels at +0.5.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import camtoworld_graphics_to_vision_4x4
from torch import Tensor

from .._files import Names, file_stem, read_json
from ..cameras.camera import Distortion
from .colmap import PANORAMA
from .files import IMAGE_SUFFIXES, MAX_NUMBER, MAX_SIDE, SceneError, list_images, picture_size, scene_error, some
from .posed import MILLIMETRE, Matrix, PosedPicture, points_from_depth, read_points, scene_of_poses
from .scene import Scene, split_by_lists

_LENSES = {  # the coefficients that each camera_model has
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE"), ()),
    **dict.fromkeys(("OPENCV_FISHEYE", "FISHEYE"), ("k1", "k2", "k3", "k4")),
    **dict.fromkeys(("PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("k1", "k2", "p1", "p2", "k3")),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_COEFFICIENTS = _LENSES["FULL_OPENCV"]
_NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", *_COEFFICIENTS)
_UNNAMED_POINTS = "points3d.ply"  # 3DGS and OpenGaussian write it


@dataclass(frozen=True)
class Frame:
    """The values of one frame; if the frame lacks one, that at the top of the file."""

    path: Path
    where: str
    values: dict[str, Any]

    def fail(self, where: str, expected: str, got: object, advice: str) -> SceneError:
        """An error that names the file, the frame and the place in it."""
        place = f"{self.where}, {where}" if where else self.where
        return SceneError(f"{self.path}, {place}: expected {expected}, got {got!r:.200}; {advice}")

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number of the frame; a SceneError if it is something else, or missing without a default."""
        value = self.values.get(name, default)
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < MAX_NUMBER:
            raise self.fail(name, "a finite number", value, "add it at the top or in each frame")
        return float(value)

    @property
    def broken(self) -> bool:
        """Whether its pose is missing, or a number of it or of the lens is NaN, infinite or implausible."""
        rows = self.values.get("transform_matrix")
        numbers = [self.values.get(name) for name in _NUMBERS]
        numbers += [number for row in rows if isinstance(row, list) for number in row] if isinstance(rows, list) else []
        return rows is None or any(isinstance(n, float) and not abs(n) < MAX_NUMBER for n in numbers)

    def lens(self) -> tuple[Matrix, tuple[int, int]]:
        """K [3, 3], and (width, height) in pixels."""
        width, height = self.number("w"), self.number("h")
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and width % 1 == 0 and height % 1 == 0):
            raise self.fail("", f"w and h of 1 to {MAX_SIDE} whole pixels", (width, height), "correct the size")
        fx, fy = self.focal_length("x", width), self.focal_length("y", height)
        if fx is None:
            advice = "add one at the top, or to all frames"
            raise self.fail("", "'fl_x' or 'camera_angle_x'", sorted(self.values), advice)
        cx, cy = self.number("cx", width / 2), self.number("cy", height / 2)
        return np.array([[fx, 0, cx], [0, fx if fy is None else fy, cy], [0, 0, 1]]), (int(width), int(height))

    def focal_length(self, axis: str, side: float) -> float | None:
        """The focal length in pixels along x or y, also from the angle of view; None if the frame has neither."""
        if f"fl_{axis}" in self.values:
            return self.number(f"fl_{axis}")
        name = f"camera_angle_{axis}"
        if name not in self.values:
            return None
        angle = self.number(name)
        if not 0 < angle < math.pi:
            raise self.fail(name, "an angle in (0, pi) radians", angle, "correct it")
        return side / 2 / math.tan(angle / 2)

    def distortion(self) -> Distortion | None:
        """The lens; a perspective lens whose coefficients are all zero is None.

        The k4 of nerfstudio's perspective camera is the fourth radial term; OpenCV's k4 is the first of the denominator. So
        k4 is accepted only with FULL_OPENCV, where it can only mean OpenCV's.
        """
        model = "OPENCV_FISHEYE" if self.values.get("is_fisheye") is True else self.values.get("camera_model", "OPENCV")
        if model not in _LENSES:
            advice = PANORAMA if model == "EQUIRECTANGULAR" else "undistort the images first"
            raise self.fail("camera_model", f"one of {', '.join(_LENSES)}", model, advice)
        values, known = {name: self.number(name, 0.0) for name in _COEFFICIENTS}, _LENSES[model]
        other = {name: value for name, value in values.items() if value and name not in known}
        if other:
            advice = 'correct camera_model ("FULL_OPENCV" for OpenCV\'s k4 k5 k6), or undistort the images first'
            raise self.fail("", f"only {' '.join(known) or 'zeros'} with camera_model {model}", other, advice)
        coefficients = tuple(values[name] for name in known)
        if "FISHEYE" in model:
            return Distortion("kannala_brandt", coefficients)
        if not any(coefficients):
            return None
        used = next(n for n in (4, 5, 8) if not any(coefficients[n:]))  # as few as kornia and OpenCV need
        return Distortion("brown_conrady", coefficients[:used])

    def pose(self) -> Matrix:  # [4, 4] float64
        """Camera to world, x right, y down, z forward."""
        rows = self.values.get("transform_matrix")
        try:
            pose = np.array(rows, dtype=np.float64)
            if pose.shape == (3, 4):
                pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
            if pose.shape != (4, 4):
                raise ValueError(f"shape {pose.shape}")
        except (TypeError, ValueError, OverflowError) as error:
            advice = "correct it, or take the frame out"
            raise self.fail("transform_matrix", "4 rows of 4 numbers", rows, advice) from error
        return camtoworld_graphics_to_vision_4x4(torch.from_numpy(pose)[None])[0].numpy()  # OpenGL axes to COLMAP's


@dataclass
class _Reader:
    """Finds the files of one scene's frames, and remembers what was noticed about them."""

    root: Path
    images: Path | None
    missing: list[str] = field(default_factory=list)  # pictures that frames name
    told: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  # what else, and of which files
    names: dict[tuple[Path, bool], Names] = field(default_factory=dict)

    def read(self, path: Path, top: dict[str, Any], pictures: bool) -> list[PosedPicture]:
        """The views of a file; without `pictures` also those of frames that have no image file or no name."""
        views = []
        for i, values in enumerate(top["frames"]):
            if not isinstance(values, dict):
                raise Frame(path, f"frame {i}", {}).fail("", "an object with a 'transform_matrix'", values, "drop it")
            frame = Frame(path, f"frame {i}", {**top, **values})
            listed = frame.values.get("file_path") or ("" if pictures else f"{i:04d}")
            named = isinstance(listed, str) and bool(listed)
            if not named or not (pictures or (listed.isprintable() and Path(listed).name)):
                expected = "a file's name without control characters"
                raise frame.fail("file_path", expected, listed, "correct it, or take the frame out")
            file = self.find_image(listed, self.images)
            if file is None and pictures:
                self.missing.append(listed)
                continue
            if file is not None and not {"w", "h"} <= set(frame.values):
                # Blender; a smaller copy in `images` is not what the file is about
                frame.values["w"], frame.values["h"] = picture_size(self.find_image(listed, None) or file)
            if file is None:
                file = self.root / listed.replace("\\", "/")
                file = file if file.suffix.lower() in IMAGE_SUFFIXES else file.with_name(f"{file.name}.png")
            view = PosedPicture(self.name(file), file, None, f"{path}, frame {i} ({self.name(file)})")
            if not frame.broken:
                view.pose, (view.K, view.size), view.distortion = frame.pose(), frame.lens(), frame.distortion()
            view.mask = self.find_mask(frame.values.get("mask_path"))
            depth = self.inside(frame.values.get("depth_file_path", frame.values.get("depth_path")))
            view.depth = depth if depth is not None and depth.suffix.lower() == ".png" else None
            views.append(view)
        return views

    def by_name(self, folder: Path, name: str, *, below: bool = True) -> Path | None:
        """The picture in a folder, or below it, that a name means."""
        if (folder, below) not in self.names:
            here = list_images(folder) if below else next(os.walk(folder), ("", [], []))[2]
            self.names[folder, below] = Names((f for f in here if f.lower().endswith(IMAGE_SUFFIXES)), bare=below)
        near = self.names[folder, below].find(name)
        return None if near is None else folder / near

    def find_image(self, listed: str, images: Path | None) -> Path | None:
        """The file of a frame: in the folder that the user gave, else as listed, else by `Names`. Only image files count."""
        name = listed.replace("\\", "/").removeprefix("./")
        if images is not None and (given := self.by_name(images, name)) is not None:
            return given
        if Path(name).suffix.lower() in IMAGE_SUFFIXES and os.path.isfile(self.root / name):
            return self.root / name
        file = self.by_name(self.root, name)
        if file is not None and name not in (near := file.relative_to(self.root).as_posix(), file_stem(near)):
            self.told["images were found by a name that is spelled otherwise"].append(f"{listed} is {near}")
        return file

    def find_mask(self, listed: Any) -> Path | None:
        """The mask of a frame; one that is missing is noted."""
        if listed is None:
            return None
        place = self.root / str(listed).replace("\\", "/").replace("\0", "")
        mask = place if os.path.isfile(place) else self.by_name(place.parent, place.name, below=False)
        if mask is None:
            self.told["files of mask_path are missing, and those frames have no mask"].append(f"{listed!r:.200}")
        return mask

    def inside(self, listed: Any) -> Path | None:
        """A file that is listed, unless it lies outside of the scene folder."""
        if not isinstance(listed, str):
            return None
        file = self.root / listed.replace("\\", "/")
        return file if _normal(file).is_relative_to(_normal(self.root)) and os.path.isfile(file) else None

    def name(self, file: Path) -> str:
        """File name relative to `images/` of the scene, or else to the scene folder; for other files, the bare name."""
        for folder in map(_normal, filter(None, (self.images, self.root / "images", self.root))):
            if _normal(file).is_relative_to(folder):
                return _normal(file).relative_to(folder).as_posix()
        return file.name

    def notes(self, views: list[PosedPicture]) -> list[str]:
        """What was noticed, for people."""
        masked, lost = sum(view.mask is not None for view in views), len(self.missing)
        told = [f"{len(names)} {what}: {some(names)}" for what, names in self.told.items()]
        if lost:
            told.append(f"{lost} of {lost + len(views)} frames have no image file: {some(self.missing)}")
        if masked:
            told.append(f"masks: {masked} of {len(views)} frames have a mask_path; black is ignored")
        return told


def load_transforms(path: Path, images: Path | None = None, *, pictures: bool = True) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may be at the top or in each frame (the frame wins): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) if focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` each frame has the size of its own picture, without `cx, cy` its centre.

    A frame whose file is missing, or whose pose or lens has NaN or infinite numbers, is left out and noted. A scale of a pose
    is removed. Points are those of `ply_file_path` inside the folder, else of `points3d.ply`, else from `depth_file_path`
    (millimetres, or `integer_depth_scale`) if no lens is distorted. What is black in a `mask_path` is ignored. Splits come from
    the file's lists (`train_filenames`, ...) or from Blender's files; else all views train.

    Image files are looked for in `images` before the scene folder; other sizes than the file says resize the cameras. Without
    `pictures` only cameras are read, also of frames without an image file; one without `file_path` is called `0007.png`.
    """
    sources, parts, tops = _sources(path), dict[str, list[PosedPicture]](), list[Any]()
    first = next(iter(sources.values()))
    reader = _Reader(first.parent, images)
    for split, file in sources.items():
        with scene_error(after="; correct it there"):
            top = read_json(file)
        if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
            expected = "an object with a list of 'frames'"
            raise Frame(file, "top level", {}).fail("", expected, top, "is this a transforms.json?")
        parts[split] = reader.read(file, top, pictures)
        tops.append(top)
    top = tops[0]
    views = [view for part in parts.values() for view in part]
    if not views:
        got = f"none of {len(reader.missing)} has one ({some(reader.missing, 3)})"
        advice = "copy the images next to the file or pass their folder"
        raise SceneError(f"{path}: expected frames with image files, {got}; {advice}")
    if not pictures:
        return scene_of_poses(path, views, notes=reader.notes(views), pictures=False)
    points, told = _points(reader, first, top, views)
    scene = scene_of_poses(path, views, points, [*reader.notes(views), *told])
    names = [camera.name for camera in scene.cameras]
    lists = {name: top.get(f"{name}_filenames") for name in ("train", "val", "test")}
    if "all" not in sources:
        lists = {split: [view.name for view in part if view.name in names] for split, part in parts.items()}
    given = {k: [word for word in v if isinstance(word, str)] for k, v in lists.items() if isinstance(v, list) and v}
    if not given:
        return scene
    splits, told = split_by_lists(str(path), given, names, held_out_wins=True)
    return replace(scene, splits=splits, notes=(*scene.notes, *told))


def _sources(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` if the file itself has splits or none."""
    if not path.is_dir() or (path / "transforms.json").is_file():
        return {"all": path / "transforms.json" if path.is_dir() else path}
    parts = {name: path / f"transforms_{name}.json" for name in ("train", "test", "val")}
    return {name: f for name, f in parts.items() if f.is_file() and not (name == "val" and parts["test"].is_file())}


def _normal(path: Path) -> Path:
    """Absolute, without '..' (links are not followed: a linked image folder is still inside)."""
    return Path(os.path.abspath(path))


def _points(
    reader: _Reader, path: Path, top: dict[str, Any], views: list[PosedPicture]
) -> tuple[tuple[Tensor, Tensor] | None, list[str]]:
    """Points and colours in the frame of the poses, and notes."""
    notes, listed = list[str](), top.get("ply_file_path")
    if listed is None and os.path.isfile(reader.root / _UNNAMED_POINTS):
        listed = _UNNAMED_POINTS
        notes = [f"points of {listed}, which no file names: 3DGS and OpenGaussian write it; random for Blender scenes"]
    file = reader.inside(listed)
    if file is not None:
        advice = f"write the points of {path} again, or remove ply_file_path or the file"
        points, colors, told = read_points(file, advice)
        notes += told
        if len(points):
            return (points, colors), notes
    unit = Frame(path, "top level", top).number("integer_depth_scale", MILLIMETRE)  # world units per step
    if not unit > 0:
        raise SceneError(f"{path}: integer_depth_scale: expected a number above 0, got {unit:g}; correct it")
    lifted = points_from_depth(views, unit)
    if lifted is not None:
        notes = [f"points from the depth pictures of {sum(view.depth is not None for view in views)} views"]
    elif listed is not None and not notes:
        notes = [f"ply_file_path {listed!r:.200} is not a file inside {reader.root}"]
    return lifted, notes
