"""Read scenes from transforms.json (nerfstudio, instant-ngp, Blender). `transforms_frame` has the conventions."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._files import Names
from ..cameras.camera import Camera
from .depth import MILLIMETRE, points_from_depth
from .files import (
    IMAGE_SUFFIXES,
    SceneError,
    find_pictures,
    is_file,
    list_images,
    natural_key,
    picture_size,
    read_scene_json,
    some,
)
from .posed import NO_POINTS, PosedPicture, as_large_as_pictures, assemble_scene, mending_notes, read_points
from .scene import Scene
from .splits import split_by_lists
from .transforms_frame import Frame

_UNNAMED_POINTS = "points3d.ply"  # 3DGS and OpenGaussian write it


class _View(NamedTuple):
    camera: Camera
    path: Path
    split: str
    mask: Path | None
    depth: Path | None


@dataclass
class _Reader:
    """The views of one scene, and what was noticed about them."""

    root: Path
    images: Path | None
    views: list[_View] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    unmasked: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    scaled: dict[str, float] = field(default_factory=dict)
    respelled: list[str] = field(default_factory=list)

    @cached_property
    def names(self) -> dict[Path, Names]:
        """The images in each folder where they may be, for names that are not there as they are written."""
        folders = (self.images, self.root / "images", self.root)
        return {folder: Names(list_images(folder)) for folder in folders if folder is not None}

    def camera(self, frame: Frame, name: str) -> Camera | None:
        """The camera of a frame; None, and noted, if something of it is broken."""
        camera, scale = (None, None) if frame.broken else frame.camera(name)
        if camera is None:
            self.broken.append(name)
        elif scale is not None:
            self.scaled[name] = scale
        return camera

    def read(self, split: str, path: Path, top: dict[str, Any]) -> None:
        """Add the views of a file."""
        for frame, values in _frames(path, top):
            listed = frame.values.get("file_path")
            if not isinstance(listed, str) or not listed:
                raise frame.fail("", "an object with a 'file_path'", values, "add it, or take the frame out")
            file = self.find_image(listed, self.images)
            if file is None:
                self.missing.append(listed)
                continue
            if not {"w", "h"} <= set(frame.values):  # Blender; a smaller copy in `images` is not what the file is about
                frame.values["w"], frame.values["h"] = picture_size(self.find_image(listed, None) or file)
            camera = self.camera(frame, self.name(file))
            mask = self.find_mask(frame.values.get("mask_path"))
            if camera is not None:
                depth = self.inside(frame.values.get("depth_file_path", frame.values.get("depth_path")))
                depth = depth if depth is not None and depth.suffix.lower() == ".png" else None
                self.views.append(_View(camera, file, split, mask, depth))

    def find_image(self, listed: str, images: Path | None) -> Path | None:
        """The file of a frame: as listed, or with a suffix added (Blender), or by `Names`. Only image files count."""
        if "\0" in listed:
            return None
        relative = PurePosixPath(listed.replace("\\", "/"))
        places = [self.root / listed, self.root / relative]
        if images is not None and not relative.is_absolute():
            places = [images / relative, images / PurePosixPath(*relative.parts[1:]), *places]
        for place in places:
            if place.suffix.lower() in IMAGE_SUFFIXES and is_file(place):
                return place
            for suffix in IMAGE_SUFFIXES:
                if place.name and is_file(with_suffix := place.with_name(place.name + suffix)):
                    return with_suffix
        for folder, names in self.names.items():
            near = names.find(str(relative))
            if near is not None:
                self.respelled.append(f"{listed} is {near}")
                return folder / near
        return None

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
        if not isinstance(listed, str) or "\0" in listed:
            return None
        file = self.root / listed.replace("\\", "/")
        return file if _normal(file).is_relative_to(_normal(self.root)) else None

    def name(self, file: Path) -> str:
        """File name relative to `images/` of the scene, or else to the scene folder; for other files, the bare name."""
        for folder in (self.images, self.root / "images", self.root):
            if folder is not None and _normal(file).is_relative_to(_normal(folder)):
                return _normal(file).relative_to(_normal(folder)).as_posix()
        self.outside.append(str(file))
        return file.name

    def notes(self) -> list[str]:
        """What was noticed, for people."""
        masks = sum(view.mask is not None for view in self.views)
        frames = len(self.missing) + len(self.views)
        pairs = [
            (self.missing, f"{len(self.missing)} of {frames} frames have no image file: {some(self.missing)}"),
            (self.outside, f"{len(self.outside)} image files lie outside {self.root}: {some(self.outside, 3)}"),
            (masks, f"masks: {masks} of {len(self.views)} frames have a mask_path; black is ignored"),
            (self.unmasked, f"{len(self.unmasked)} files of mask_path are missing, and those frames have no mask: "
             f"{some(self.unmasked)}"),
            (self.respelled, f"{len(self.respelled)} images were found by a name that is spelled otherwise: "
             f"{some(self.respelled)}"),
        ]  # fmt: skip
        return [*mending_notes(self.broken, self.scaled), *(note for some_are, note in pairs if some_are)]


def load_transforms(path: Path, images: Path | None = None) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may be at the top or in each frame (the frame wins): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) if focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` each frame has the size of its own picture, without `cx, cy` its centre.

    A frame whose file is missing, or whose pose or lens has NaN or infinite numbers, is left out and noted. A scale of a pose
    is removed. Image files outside the scene folder are read. Points are those of `ply_file_path` inside the folder, else of
    `points3d.ply`, else from `depth_file_path` (millimetres, or `integer_depth_scale`) if no lens is distorted. What is
    black in a `mask_path` is ignored (`Scene.masks`).

    Args:
        path: the file, or a folder with `transforms.json` or `transforms_train.json`.
        images: where to look for image files before the scene folder. Other sizes than the file says resize the cameras.

    Returns:
        The scene. Splits come from the file (`train_filenames`, `val_filenames`, `test_filenames`; what none of them names is
        in no split) or from Blender's files; without test views, the validation views are tested. Else all views train.
    """
    files = _files(path)
    tops = {split: _read_top(file) for split, file in files.items()}
    reader = _Reader(next(iter(files.values())).parent, images)
    for split, file in files.items():
        reader.read(split, file, tops[split])
    if not reader.views:
        lost = [*reader.missing, *reader.broken]
        raise SceneError(
            f"{path}: expected frames with image files and poses, none of {len(lost)} has both ({some(lost, 3)}); "
            f"copy the images next to the file or pass their folder; {'; '.join(reader.notes())}"
        )
    views = sorted(reader.views, key=lambda view: natural_key(view.camera.name))
    first, top = next(iter(files.values())), next(iter(tops.values()))
    points, colors, told = _points(reader, first, top, views)
    paths, masks = [view.path for view in views], [view.mask for view in views]
    cameras, resized = as_large_as_pictures([view.camera for view in views], paths, images)
    splits, held = _splits(path, views, top)
    scene = assemble_scene(cameras, paths, points, colors, [*reader.notes(), *told, *resized, *held])
    return replace(scene, splits=splits, masks=masks if any(masks) else None)


def transforms_cameras(path: Path) -> tuple[list[Camera], list[str]]:
    """The cameras (float64) of the files that `load_transforms` reads, by names, also of frames without an image file.

    A frame without `file_path` is named by its number, `0007.png`. A picture is opened only if its frame has no `w, h`. Notes
    say what is broken and left out.
    """
    files = _files(path)
    reader, cameras = _Reader(next(iter(files.values())).parent, None), []
    for file in files.values():
        for i, (frame, _) in enumerate(_frames(file, _read_top(file))):
            listed = frame.values.get("file_path") or f"{i:04d}"
            if not isinstance(listed, str) or not listed.isprintable() or not Path(listed).name:
                expected = "a file's name without control characters"  # as in COLMAP's models
                raise frame.fail("file_path", expected, listed, "correct it, or leave it out")
            named, found = reader.root / listed.replace("\\", "/"), reader.find_image(listed, None)
            if named.suffix.lower() not in IMAGE_SUFFIXES:  # of Blender
                named = named.with_name(f"{named.name}.png")
            if found is not None and not {"w", "h"} <= set(frame.values):
                frame.values["w"], frame.values["h"] = picture_size(found)
            cameras.append(reader.camera(frame, reader.name(found or named)))
    known = [camera for camera in cameras if camera is not None]
    return sorted(known, key=lambda camera: natural_key(camera.name)), mending_notes(reader.broken, reader.scaled)


def _files(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` if the file itself has splits or none."""
    if not path.is_dir() or (path / "transforms.json").is_file():
        return {"all": path / "transforms.json" if path.is_dir() else path}
    files = {name: path / f"transforms_{name}.json" for name in ("train", "test", "val")}
    files = {name: file for name, file in files.items() if file.is_file()}
    if "train" not in files:
        raise FileNotFoundError(f"{path}: no transforms.json and no transforms_train.json; expected one of them")
    if "test" in files:  # then nobody needs those for validation
        files.pop("val", None)
    return files


def _read_top(path: Path) -> dict[str, Any]:
    top = read_scene_json(path, "correct it there")
    if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
        place = Frame(path, "top level", {})
        raise place.fail("", "an object with a list of 'frames'", top, "is this a transforms.json?")
    return top


def _frames(path: Path, top: dict[str, Any]) -> Iterator[tuple[Frame, Any]]:
    """Each frame with what the top says for all, and as it is in the file."""
    for i, values in enumerate(top["frames"]):
        frame = Frame(path, f"frame {i}", {})
        if not isinstance(values, dict):
            raise frame.fail("", "an object with a 'transform_matrix'", values, "take it out of the file")
        frame.values.update({**top, **values})
        yield frame, values


def _normal(path: Path) -> Path:
    """Absolute, without '..' (links are not followed: a linked image folder is still inside)."""
    return Path(os.path.abspath(path))


def _points(reader: _Reader, path: Path, top: dict[str, Any], views: list[_View]) -> tuple[Tensor, Tensor, list[str]]:
    """Points and colours in the frame of the poses, and notes."""
    listed, notes = top.get("ply_file_path"), []
    if listed is None and is_file(reader.root / _UNNAMED_POINTS):
        listed = _UNNAMED_POINTS
        notes = [
            f"points of {listed}, which no file names: 3DGS and OpenGaussian write it; 3DGS's are random for Blender scenes"
        ]
    file = reader.inside(listed)
    if file is not None and is_file(file):
        try:
            points, colors, told = read_points(file)
        except SceneError as error:
            raise SceneError(
                f"{error}; write the points of {path} again, or remove ply_file_path or the file"
            ) from error
        if len(points):
            return points, colors, notes + told
        notes += told
    unit = Frame(path, "top level", top).number("integer_depth_scale", MILLIMETRE)  # world units per step
    if not unit > 0:
        raise SceneError(f"{path}: integer_depth_scale: expected a number above 0, got {unit:g}; correct it")
    posed, depths = [], []
    for view in views:
        camera = view.camera
        if view.depth is not None and camera.distortion is None:
            lens = camera.K.double().numpy(), (camera.width, camera.height)
            pose = torch.linalg.inv(camera.viewmat.double()).numpy()
            posed.append(PosedPicture(camera.name, view.path, pose, str(view.depth), lens, view.mask))
            depths.append(view.depth)
    from_depth = points_from_depth(posed, depths, unit)
    if from_depth is not None:
        return *from_depth, [f"points from the depth pictures of {len(posed)} views"]
    lost = f"no points: ply_file_path {listed!r:.200} is not a file inside {reader.root}"
    return (
        torch.zeros(0, 3),
        torch.zeros(0, 3, dtype=torch.uint8),
        [*notes, NO_POINTS if listed is None or notes else lost],
    )


def _splits(path: Path, views: list[_View], top: dict[str, Any]) -> tuple[dict[str, list[int]], list[str]]:
    """The splits that the files give; if there are none, all views in train. And notes."""
    names = [view.camera.name for view in views]
    lists = {name: top.get(f"{name}_filenames") for name in ("train", "val", "test")}
    if views[0].split != "all":
        lists = {name: [view.camera.name for view in views if view.split == name] for name in lists}
    given = {k: [word for word in v if isinstance(word, str)] for k, v in lists.items() if isinstance(v, list) and v}
    if not given:
        return {"train": list(range(len(views))), "test": []}, []
    known, notes = Names(names, bare=True), []
    held = {known.find(word) for name in ("val", "test") for word in given.get(name, ())}
    every = given.get("train", [])
    own = [word for word in every if known.find(word) not in held]
    if every and not own:
        given, notes = {"train": every}, ["all training views are validation or test views, too: none is held out"]
    elif len(own) < len(every):
        both = len(every) - len(own)
        notes = [f"{both} views of train_filenames are validation or test views, too: they do not train"]
        given |= {"train": own}
    splits, told = split_by_lists(str(path), given, names)
    return splits, [*notes, *told]
