"""Read scenes from transforms.json (nerfstudio, instant-ngp, Blender). `transforms_frame` has the conventions."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from .._files import Names, file_stem
from .depth import MILLIMETRE, points_from_depth
from .files import (
    IMAGE_SUFFIXES,
    SceneError,
    find_pictures,
    is_file,
    list_images,
    picture_size,
    read_scene_json,
    some,
)  # fmt: skip
from .posed import PosedPicture, read_points, scene_of_poses
from .scene import Scene
from .splits import split_by_lists
from .transforms_frame import Frame

_UNNAMED_POINTS = "points3d.ply"  # 3DGS and OpenGaussian write it


@dataclass
class _Reader:
    """Finds the files of one scene's frames, and remembers what was noticed about them."""

    root: Path
    images: Path | None
    missing: list[str] = field(default_factory=list)
    unmasked: list[str] = field(default_factory=list)
    respelled: list[str] = field(default_factory=list)

    def read(self, path: Path, top: dict[str, Any], pictures: bool) -> list[PosedPicture]:
        """The views of a file; without `pictures` also those of frames that have no image file or no name."""
        views = []
        for i, values in enumerate(top["frames"]):
            if not isinstance(values, dict):
                expected = "an object with a 'transform_matrix'"
                raise Frame(path, f"frame {i}", {}).fail("", expected, values, "take it out of the file")
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

    @cached_property
    def known(self) -> Names:
        """The images in the scene folder, for names that are not there as they are written."""
        return Names(list_images(self.root), bare=True)

    @cached_property
    def given(self) -> Names:
        """The images in the folder that the user gave."""
        return Names([] if self.images is None else list_images(self.images), bare=True)

    def find_image(self, listed: str, images: Path | None) -> Path | None:
        """The file of a frame: in the folder that the user gave, else as listed, else by `Names`. Only image files count."""
        name = listed.replace("\\", "/").removeprefix("./")
        if images is not None and (near := self.given.find(name)) is not None:
            return images / near
        if Path(name).suffix.lower() in IMAGE_SUFFIXES and is_file(self.root / name):
            return self.root / name
        near = self.known.find(name)
        if near is None:
            return None
        if name not in (near, file_stem(near)):
            self.respelled.append(f"{listed} is {near}")
        return self.root / near

    def find_mask(self, listed: Any) -> Path | None:
        """The mask of a frame; one that is missing is noted."""
        if listed is None:
            return None
        place = self.root / str(listed).replace("\\", "/").replace("\0", "")
        mask = find_pictures(place.parent, [place.name]).get(place.name)
        if mask is None:
            self.unmasked.append(f"{listed!r:.200}")
        return mask

    def inside(self, listed: Any) -> Path | None:
        """A file that is listed, unless it lies outside of the scene folder."""
        if not isinstance(listed, str):
            return None
        file = self.root / listed.replace("\\", "/")
        return file if _normal(file).is_relative_to(_normal(self.root)) and is_file(file) else None

    def name(self, file: Path) -> str:
        """File name relative to `images/` of the scene, or else to the scene folder; for other files, the bare name."""
        for folder in (self.images, self.root / "images", self.root):
            if folder is not None and _normal(file).is_relative_to(_normal(folder)):
                return _normal(file).relative_to(_normal(folder)).as_posix()
        return file.name

    def notes(self, views: list[PosedPicture]) -> list[str]:
        """What was noticed, for people."""
        masks, frames = sum(view.mask is not None for view in views), len(self.missing) + len(views)
        pairs = [
            (self.missing, f"{len(self.missing)} of {frames} frames have no image file: {some(self.missing)}"),
            (masks, f"masks: {masks} of {len(views)} frames have a mask_path; black is ignored"),
            (self.unmasked, f"{len(self.unmasked)} files of mask_path are missing, and those frames have no mask: "
             f"{some(self.unmasked)}"),
            (self.respelled, f"{len(self.respelled)} images were found by a name that is spelled otherwise: "
             f"{some(self.respelled)}"),
        ]  # fmt: skip
        return [note for some_are, note in pairs if some_are]


def load_transforms(path: Path, images: Path | None = None, *, pictures: bool = True) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may be at the top or in each frame (the frame wins): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) if focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` each frame has the size of its own picture, without `cx, cy` its centre.

    A frame whose file is missing, or whose pose or lens has NaN or infinite numbers, is left out and noted. A scale of a pose
    is removed. Points are those of `ply_file_path` inside the folder, else of `points3d.ply`, else from `depth_file_path`
    (millimetres, or `integer_depth_scale`) if no lens is distorted. What is black in a `mask_path` is ignored. Splits come from
    the file's lists (`train_filenames`, ...) or from Blender's files; else all views train.

    Args:
        path: the file, or a folder with `transforms.json` or `transforms_train.json`.
        images: where to look for image files before the scene folder. Other sizes than the file says resize the cameras.
        pictures: False reads cameras alone, also of frames without an image file; a frame without `file_path` is named by its
            number, `0007.png`.
    """
    files = _files(path)
    first, tops = next(iter(files.values())), {split: _read_top(file) for split, file in files.items()}
    reader, top = _Reader(first.parent, images), tops[next(iter(files))]
    parts = {split: reader.read(file, tops[split], pictures) for split, file in files.items()}
    views = [view for part in parts.values() for view in part]
    if not views:
        raise SceneError(
            f"{path}: expected frames with image files, none of {len(reader.missing)} has one ({some(reader.missing, 3)}); copy "
            "the images next to the file or pass their folder"
        )
    if not pictures:
        return scene_of_poses(path, views, notes=reader.notes(views), pictures=False)
    points, told = _points(reader, first, top, views)
    scene = scene_of_poses(path, views, points, [*reader.notes(views), *told], images)
    names = [camera.name for camera in scene.cameras]
    lists = {name: top.get(f"{name}_filenames") for name in ("train", "val", "test")}
    if "all" not in files:
        lists = {split: [view.name for view in part if view.name in names] for split, part in parts.items()}
    splits, held = _splits(path, names, lists)
    return replace(scene, splits=splits, notes=(*scene.notes, *held))


def _files(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` if the file itself has splits or none."""
    if not path.is_dir() or (path / "transforms.json").is_file():
        return {"all": path / "transforms.json" if path.is_dir() else path}
    files = {name: path / f"transforms_{name}.json" for name in ("train", "test", "val")}
    files = {name: file for name, file in files.items() if file.is_file()}
    if "test" in files:  # then nobody needs those for validation
        files.pop("val", None)
    return files


def _read_top(path: Path) -> dict[str, Any]:
    top = read_scene_json(path, "correct it there")
    if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
        place = Frame(path, "top level", {})
        raise place.fail("", "an object with a list of 'frames'", top, "is this a transforms.json?")
    return top


def _normal(path: Path) -> Path:
    """Absolute, without '..' (links are not followed: a linked image folder is still inside)."""
    return Path(os.path.abspath(path))


def _points(
    reader: _Reader, path: Path, top: dict[str, Any], views: list[PosedPicture]
) -> tuple[tuple[Tensor, Tensor] | None, list[str]]:
    """Points and colours in the frame of the poses, and notes."""
    listed, notes = top.get("ply_file_path"), list[str]()
    if listed is None and is_file(reader.root / _UNNAMED_POINTS):
        listed = _UNNAMED_POINTS
        notes.append(
            f"points of {listed}, which no file names: 3DGS and OpenGaussian write it; random for Blender scenes"
        )
    file = reader.inside(listed)
    if file is not None:
        try:
            points, colors, told = read_points(file)
        except SceneError as error:
            advice = f"write the points of {path} again, or remove ply_file_path or the file"
            raise SceneError(f"{error}; {advice}") from error
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


def _splits(path: Path, names: list[str], lists: dict[str, Any]) -> tuple[dict[str, list[int]], list[str]]:
    """The splits that the files give; if there are none, all views in train. And notes."""
    given = {k: [word for word in v if isinstance(word, str)] for k, v in lists.items() if isinstance(v, list) and v}
    if not given:
        return {"train": list(range(len(names))), "test": []}, []
    known, every = Names(names, bare=True), given.get("train", [])
    held = {known.find(word) for name in ("val", "test") for word in given.get(name, ())}
    own = [word for word in every if known.find(word) not in held]
    notes = []
    if every and not own:
        given, notes = {"train": every}, ["all training views are validation or test views, too: none is held out"]
    elif len(own) < len(every):
        both = len(every) - len(own)
        notes = [f"{both} views of train_filenames are validation or test views, too: they do not train"]
        given |= {"train": own}
    splits, told = split_by_lists(str(path), given, names)
    return splits, [*notes, *told]
