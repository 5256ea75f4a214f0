"""Read scenes from transforms.json (nerfstudio, instant-ngp, Blender). `transforms_frame` has the conventions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from .._files import Names, as_path
from .._origin import Origin
from ..cameras.camera import Camera
from .files import IMAGE_SUFFIXES, SceneError, find_pictures, is_file, list_images, natural_key, read_scene_json, some
from .posed import MILLIMETRE, as_large_as_pictures, near_zero, picture_size, points_of_cameras, read_points
from .poses import mending_notes
from .scene import Scene
from .splits import split_by_lists
from .transforms_frame import Frame

_UNNAMED_POINTS = "points3d.ply"


@dataclass
class _Reader:
    """One file: the views read from it, and the missing images."""

    path: Path
    root: Path
    images: Path | None
    views: list[tuple[Camera, Path]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    masks: dict[Path, Path] = field(default_factory=dict)
    unmasked: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    scaled: dict[str, float] = field(default_factory=dict)
    respelled: dict[str, str] = field(default_factory=dict)
    depths: list[Path | None] = field(default_factory=list)

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

    def with_depth(self, origin: Origin) -> list[tuple[Camera, Path, Path, Path | None]]:
        """Camera, picture, depth picture, and mask if there is one, of each view that has the first three."""
        both = zip(self.views, self.depths, strict=True)
        kept = [(camera, path, depth) for (camera, path), depth in both if depth is not None]
        return [(c.with_origin(origin).to(torch.float32), path, depth, self.masks.get(path)) for c, path, depth in kept]


def load_transforms(path: str | Path, images: str | Path | None = None) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may be at the top or in each frame (the frame wins): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) if focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` each frame has the size of its own picture, without `cx, cy` its centre.

    A frame whose file is missing, or whose pose or lens has NaN or infinite numbers, is left out and named in `notes`. A scale
    of a pose is removed. Frames outside the scene folder (an absolute path, or
    `..`) are read if they are image files, and counted in `notes`. `ply_file_path` gives the points if it is inside the
    folder, without it the `points3d.ply` of 3DGS and OpenGaussian; else the scene has no points (P = 0), and a
    note says so. Without points, those of `depth_file_path` are taken (millimetres, or `integer_depth_scale`), if no lens
    is distorted. What is black in a `mask_path` is ignored (`Scene.masks`); masks that are missing are counted in `notes`.

    Args:
        path: the file, or a folder with `transforms.json` or `transforms_train.json`.
        images: where to look for image files before the scene folder. Other sizes than the file says resize the cameras.

    Returns:
        The scene in natural order of names. Splits come from the file (`train_filenames`, `val_filenames`, `test_filenames`; what
        none of them names is in no split) or from Blender's files; without test views, the validation views are tested. Else
        all views train.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it is damaged, a number is missing or implausible, a lens is unknown to kfgs, or no frame has a file.
    """
    files = _files(as_path(path))
    readers = {}
    for split, file in files.items():
        reader = _Reader(file, file.parent, None if images is None else as_path(images))
        readers[split] = (reader, _read_frames(reader))
    views = [(camera, image, split) for split, (reader, _) in readers.items() for camera, image in reader.views]
    missing = [name for reader, _ in readers.values() for name in reader.missing]
    outside = [name for reader, _ in readers.values() for name in reader.outside]
    notes = [note for reader, _ in readers.values() for note in mending_notes(reader.broken, reader.scaled)]
    if not views:
        lost = [*missing, *(name for reader, _ in readers.values() for name in reader.broken)]
        raise SceneError(
            f"{path}: expected frames with image files and poses, none of {len(lost)} has both ({some(lost, 3)}); "
            f"copy the images next to the file or pass their folder{''.join(f'; {note}' for note in notes)}"
        )
    views.sort(key=lambda view: natural_key(view[0].name))
    first, top = next(iter(readers.values()))
    points, colors, told = _points(first, top)
    paths = [view[1] for view in views]
    cameras, points, far = near_zero([view[0] for view in views], points)
    if len(points) == 0:
        unit = Frame(first.path, "top level", top).number("integer_depth_scale", MILLIMETRE)  # world units per step
        frames = [frame for reader, _ in readers.values() for frame in reader.with_depth(cameras[0].origin)]
        found = points_of_cameras(frames, unit)
        points, colors, told = found or (points, colors, told)
    notes += told
    if missing:
        notes.append(f"{len(missing)} of {len(missing) + len(views)} frames have no image file: {some(missing)}")
    if outside:
        notes.append(f"{len(outside)} image files lie outside {first.root}: {some(outside, 3)}")
    named = {image: mask for reader, _ in readers.values() for image, mask in reader.masks.items()}
    masks = [named.get(path) for path in paths]
    unmasked = [name for reader, _ in readers.values() for name in reader.unmasked]
    if any(masks):
        notes.append(
            f"masks: {len(masks) - masks.count(None)} of {len(views)} frames have a mask_path; black is ignored"
        )
    if unmasked:
        notes.append(f"{len(unmasked)} files of mask_path are missing, and those frames have no mask: {some(unmasked)}")
    other = [f"{listed} is {file}" for reader, _ in readers.values() for listed, file in reader.respelled.items()]
    if other:
        notes.append(f"{len(other)} images were found by a name that is spelled otherwise: {some(other)}")
    cameras, shrunk = as_large_as_pictures(cameras, paths, first.images)
    splits, told = _splits(path, views, top)
    scene = Scene(cameras, paths, points, colors, splits, (*notes, *shrunk, *told, *far)).with_near()
    return replace(scene, masks=masks) if any(masks) else scene


def transforms_cameras(path: Path) -> tuple[list[Camera], list[str]]:
    """The cameras (float64) of the files that `load_transforms` reads, by names, also of frames without an image file.

    Notes say what is broken and left out.

    A frame without `file_path` is named by its number, `0007.png`. A picture is opened only if its frame has no `w, h`.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it is damaged, a number is missing or implausible, or a lens is unknown to kfgs.
    """
    cameras, notes = [], []
    for file in _files(path).values():
        reader = _Reader(file, file.parent, None)
        for i, (frame, _) in enumerate(_frames(reader, _read_top(reader))):
            listed = frame.values.get("file_path") or f"{i:04d}"
            if not isinstance(listed, str) or not listed.isprintable() or not Path(listed).name:
                expected = "a file's name without control characters"  # as in COLMAP's models
                raise frame.fail("file_path", expected, listed, "correct it, or leave it out")
            named, found = reader.root / listed.replace("\\", "/"), _find_image(reader, listed)
            if named.suffix.lower() not in IMAGE_SUFFIXES:  # of Blender
                named = named.with_name(f"{named.name}.png")
            if found is not None and not {"w", "h"} <= set(frame.values):
                frame.values["w"], frame.values["h"] = picture_size(found)
            cameras.append(reader.camera(frame, _name(reader, found or named)))
        notes += mending_notes(reader.broken, reader.scaled)
    return sorted((c for c in cameras if c is not None), key=lambda camera: natural_key(camera.name)), notes


def _files(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` if the file itself has splits or none."""
    if path.is_dir():
        if (path / "transforms.json").is_file():
            return {"all": path / "transforms.json"}
        parts = {name: path / f"transforms_{name}.json" for name in ("train", "test", "val")}
        found = {name: file for name, file in parts.items() if file.is_file()}
        if "test" in found:  # then nobody needs those for validation
            found.pop("val", None)
        if "train" not in found:
            raise FileNotFoundError(f"{path}: no transforms.json and no transforms_train.json; expected one of them")
        return found
    return {"all": path}


def _read_top(reader: _Reader) -> dict[str, Any]:
    top = read_scene_json(reader.path, "correct it there")
    if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
        place = Frame(reader.path, "top level", {})
        raise place.fail("", "an object with a list of 'frames'", top, "is this a transforms.json?")
    return top


def _frames(reader: _Reader, top: dict[str, Any]) -> Iterator[tuple[Frame, Any]]:
    """Each frame with what the top says for all, and as it is in the file."""
    for i, values in enumerate(top["frames"]):
        frame = Frame(reader.path, f"frame {i}", {})
        if not isinstance(values, dict):
            raise frame.fail("", "an object with a 'transform_matrix'", values, "take it out of the file")
        frame.values.update({**top, **values})
        yield frame, values


def _read_frames(reader: _Reader) -> dict[str, Any]:
    """Fill `reader.views`; return the top level of the file."""
    top = _read_top(reader)
    for frame, values in _frames(reader, top):
        merged, listed = frame.values, frame.values.get("file_path")
        if not isinstance(listed, str) or not listed:
            raise frame.fail("", "an object with a 'file_path'", values, "add it, or take the frame out")
        file = _find_image(reader, listed)
        if file is None:
            reader.missing.append(listed)
            continue
        _find_mask(reader, merged.get("mask_path"), file)
        if not {"w", "h"} <= set(merged):  # Blender; a smaller copy in `images` is not what the file is about
            merged["w"], merged["h"] = picture_size(_find_image(replace(reader, images=None), listed) or file)
        camera = reader.camera(frame, _name(reader, file))
        if camera is not None:
            reader.depths.append(_depth_file(reader, merged))
            reader.views.append((camera, file))
    return top


def _find_image(reader: _Reader, listed: str) -> Path | None:
    """The file of a frame: as listed, or with a suffix added (Blender), or by `Names`. Only image files count."""
    if "\0" in listed:
        return None
    relative = PurePosixPath(listed.replace("\\", "/"))
    places = [reader.root / listed, reader.root / relative]
    if reader.images is not None and not relative.is_absolute():
        places = [reader.images / relative, reader.images / PurePosixPath(*relative.parts[1:]), *places]
    for place in places:
        if place.suffix.lower() in IMAGE_SUFFIXES and is_file(place):
            return place
        for suffix in IMAGE_SUFFIXES:
            if place.name and is_file(with_suffix := place.with_name(place.name + suffix)):
                return with_suffix
    for folder, names in reader.names.items():
        near = names.find(str(relative))
        if near is not None:
            reader.respelled[listed] = near
            return folder / near
    return None


def _find_mask(reader: _Reader, listed: Any, image: Path) -> None:
    """Note the mask of a frame, or that it is missing."""
    if listed is None:
        return
    place = reader.root / str(listed).replace("\\", "/").replace("\0", "")
    mask = find_pictures(place.parent, [place.name]).get(place.name)
    if mask is None:
        reader.unmasked.append(f"{listed!r:.200}")
    else:
        reader.masks[image] = mask


def _name(reader: _Reader, file: Path) -> str:
    """File name relative to `images/` of the scene, or else to the scene folder; for other files, the bare name."""
    plain = _normal(file)
    for folder in (reader.images, reader.root / "images", reader.root):
        if folder is not None and plain.is_relative_to(_normal(folder)):
            return plain.relative_to(_normal(folder)).as_posix()
    reader.outside.append(str(file))
    return file.name


def _normal(path: Path) -> Path:
    """Absolute, without '..' (links are not followed: a linked image folder is still inside)."""
    parts: list[str] = []
    for part in path.absolute().parts:
        if part == "..":
            parts = parts[:-1] if len(parts) > 1 else parts
        else:
            parts.append(part)
    return Path(*parts)


def _points(reader: _Reader, top: dict[str, Any]) -> tuple[Tensor, Tensor, list[str]]:
    """The points of `ply_file_path`, in the frame of the poses."""
    nothing = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    listed, notes = top.get("ply_file_path"), []
    if listed is None and is_file(reader.root / _UNNAMED_POINTS):
        listed = _UNNAMED_POINTS
        notes = [
            f"points of {listed}, which no file names: 3DGS and OpenGaussian write it; 3DGS's are random for Blender scenes"
        ]
    if listed is None:
        return *nothing, [
            "no points: this transforms.json has no ply_file_path; `kfgs fit` and `kfgs color` triangulate some from the poses "
            "before they train"
        ]
    file = reader.root / listed if isinstance(listed, str) and "\0" not in listed else None
    if file is None or not _normal(file).is_relative_to(_normal(reader.root)) or not is_file(file):
        return *nothing, [f"no points: ply_file_path {listed!r:.200} is no file inside {reader.root}"]
    try:
        points, colors, told = read_points(file)
        return points, colors, notes + told
    except ValueError as error:
        if notes:
            raise SceneError(f"{error}; write the points again, or remove the file to load without points") from error
        raise SceneError(
            f"{error} (named by ply_file_path in {reader.path}; remove the entry to load without points)"
        ) from error


def _depth_file(reader: _Reader, values: dict[str, Any]) -> Path | None:
    """The depth picture of a frame inside the scene folder; nerfstudio and instant-ngp name it differently."""
    listed = values.get("depth_file_path", values.get("depth_path"))
    if not isinstance(listed, str) or "\0" in listed:
        return None
    file = reader.root / listed.replace("\\", "/")
    return file if file.suffix.lower() == ".png" and _normal(file).is_relative_to(_normal(reader.root)) else None


def _splits(
    path: str | Path, views: list[tuple[Camera, Path, str]], top: dict[str, Any]
) -> tuple[dict[str, list[int]], list[str]]:
    """The splits that the files give; if there are none, all views in train. And notes."""
    names = [camera.name for camera, _, _ in views]
    lists = {name: top.get(f"{name}_filenames") for name in ("train", "val", "test")}
    if views[0][2] != "all":
        lists = {name: [camera.name for camera, _, split in views if split == name] for name in lists}
    given = {
        name: [word for word in words if isinstance(word, str)]
        for name, words in lists.items()
        if isinstance(words, list) and words
    }
    if not given:
        return {"train": list(range(len(views))), "test": []}, []
    known, notes = Names(names, bare=True), []
    held = {known.find(word) for name in ("val", "test") for word in given.get(name, ())}
    every, own = given.get("train", []), [word for word in given.get("train", ()) if known.find(word) not in held]
    if every and not own:
        given, notes = {"train": every}, ["all training views are validation or test views, too: none is held out"]
    elif len(own) < len(every):
        notes = [
            f"{len(every) - len(own)} views of train_filenames are validation or test views, too: they do not train"
        ]
        given |= {"train": own}
    splits, told = split_by_lists(str(path), given, names)
    return splits, [*notes, *told]
