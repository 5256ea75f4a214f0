"""Read scenes from transforms.json (nerfstudio, instant-ngp, Blender). `transforms_frame` has the conventions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from .._files import as_path
from .._origin import Origin
from ..cameras.camera import Camera
from .files import IMAGE_SUFFIXES, SceneError, is_file, natural_key, read_scene_json, some
from .posed import MILLIMETRE, as_large_as_pictures, near_zero, picture_size, points_of_cameras, read_points
from .scene import Scene
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
    masked: int = 0
    depths: list[Path | None] = field(default_factory=list)

    def with_depth(self, origin: Origin) -> list[tuple[Camera, Path, Path]]:
        """Camera, picture and depth picture of each view that has all three."""
        both = zip(self.views, self.depths, strict=True)
        kept = [(camera, path, depth) for (camera, path), depth in both if depth is not None]
        return [(camera.with_origin(origin).to(torch.float32), path, depth) for camera, path, depth in kept]


def load_transforms(path: str | Path, images: str | Path | None = None) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may be at the top or in each frame (the frame wins): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) if focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` each frame has the size of its own picture, without `cx, cy` its centre.

    A frame whose file is missing is left out and named in `notes`. Frames outside the scene folder (an absolute path, or
    `..`) are read if they are image files, and counted in `notes`. `ply_file_path` gives the points if it is inside the
    folder, without it the `points3d.ply` of 3DGS and OpenGaussian; else the scene has no points (P = 0), and a
    note says so. Without points, those of `depth_file_path` are taken (millimetres, or `integer_depth_scale`), if no lens
    is distorted. `mask_path` is not read.

    Args:
        path: the file, or a folder with `transforms.json` or `transforms_train.json`.
        images: where to look for image files before the scene folder. Other sizes than the file says resize the cameras.

    Returns:
        The scene in natural order of names. Splits come from the file (`train_filenames`, `test_filenames`) or from Blender's
        two files; else all views train.

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
    if not views:
        raise SceneError(
            f"{path}: expected frames with image files, none of {len(missing)} has one ({some(missing, 3)}); "
            "copy the images next to the file or pass their folder"
        )
    views.sort(key=lambda view: natural_key(view[0].name))
    first, top = next(iter(readers.values()))
    points, colors, notes = _points(first, top)
    paths = [view[1] for view in views]
    cameras, points, far = near_zero([view[0] for view in views], points)
    if len(points) == 0:
        unit = Frame(first.path, "top level", top).number("integer_depth_scale", MILLIMETRE)  # world units per step
        frames = [frame for reader, _ in readers.values() for frame in reader.with_depth(cameras[0].origin)]
        found = points_of_cameras(frames, unit)
        points, colors, notes = found or (points, colors, notes)
    if missing:
        notes.append(f"{len(missing)} of {len(missing) + len(views)} frames have no image file: {some(missing)}")
    if outside:
        notes.append(f"{len(outside)} image files lie outside {first.root}: {some(outside, 3)}")
    if any(reader.masked for reader, _ in readers.values()):
        notes.append(f"{sum(reader.masked for reader, _ in readers.values())} frames have a mask_path; it is not used")
    cameras, shrunk = as_large_as_pictures(cameras, paths, first.images)
    return Scene(cameras, paths, points, colors, _splits(views, first.root, top), (*notes, *shrunk, *far)).with_near()


def transforms_cameras(path: Path) -> list[Camera]:
    """The cameras (float64) of the files that `load_transforms` reads, by names, also of frames without an image file.

    A frame without `file_path` is named by its number, `0007.png`. A picture is opened only if its frame has no `w, h`.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it is damaged, a number is missing or implausible, or a lens is unknown to kfgs.
    """
    cameras = []
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
            cameras.append(frame.camera(_name(reader, found or named)))
    return sorted(cameras, key=lambda camera: natural_key(camera.name))


def _files(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` if the file itself has splits or none."""
    if path.is_dir():
        if (path / "transforms.json").is_file():
            return {"all": path / "transforms.json"}
        parts = {name: path / f"transforms_{name}.json" for name in ("train", "test")}
        found = {name: file for name, file in parts.items() if file.is_file()}
        if "train" not in found:
            raise FileNotFoundError(f"{path}: no transforms.json and no transforms_train.json; expected one of them")
        return found
    return {"all": path}


def _read_top(reader: _Reader) -> dict[str, Any]:
    top = read_scene_json(reader.path, "write the file again")
    if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
        place = Frame(reader.path, "top level", {})
        raise place.fail("", "an object with a list of 'frames'", top, "is this a transforms.json?")
    return top


def _frames(reader: _Reader, top: dict[str, Any]) -> Iterator[tuple[Frame, Any]]:
    """Each frame with what the top says for all, and as it is in the file."""
    for i, values in enumerate(top["frames"]):
        frame = Frame(reader.path, f"frame {i}", {})
        if not isinstance(values, dict):
            raise frame.fail("", "an object with a 'transform_matrix'", values, "write the file again")
        frame.values.update({**top, **values})
        yield frame, values


def _read_frames(reader: _Reader) -> dict[str, Any]:
    """Fill `reader.views`; return the top level of the file."""
    top = _read_top(reader)
    for frame, values in _frames(reader, top):
        merged, listed = frame.values, frame.values.get("file_path")
        if not isinstance(listed, str) or not listed:
            raise frame.fail("", "an object with a 'file_path'", values, "write the file again")
        file = _find_image(reader, listed)
        if file is None:
            reader.missing.append(listed)
            continue
        reader.masked += "mask_path" in values
        if not {"w", "h"} <= set(
            merged
        ):  # Blender writes no size; a smaller copy in `images` is not what the file is about
            merged["w"], merged["h"] = picture_size(_find_image(replace(reader, images=None), listed) or file)
        reader.depths.append(_depth_file(reader, merged))
        reader.views.append((frame.camera(_name(reader, file)), file))
    return top


def _candidates(reader: _Reader, listed: str) -> Iterator[Path]:
    for spelled in dict.fromkeys((listed, listed.replace("\\", "/"))):
        relative = PurePosixPath(spelled)
        if reader.images is not None and not relative.is_absolute():
            yield reader.images / relative
            yield reader.images / PurePosixPath(*relative.parts[1:])
        yield reader.root / relative


def _find_image(reader: _Reader, listed: str) -> Path | None:
    """The file of a frame: as listed, or (Blender) with a suffix added. Only image files count."""
    if "\0" in listed:
        return None
    for candidate in _candidates(reader, listed):
        if candidate.suffix.lower() in IMAGE_SUFFIXES and is_file(candidate):
            return candidate
        for suffix in IMAGE_SUFFIXES:
            if candidate.name and is_file(with_suffix := candidate.with_name(candidate.name + suffix)):
                return with_suffix
    return None


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
        return *read_points(file), notes
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


def _splits(views: list[tuple[Camera, Path, str]], root: Path, top: dict[str, Any]) -> dict[str, list[int]]:
    """The splits that the files give; if there are none, all views in train."""
    origin = [split for _, _, split in views]
    if "all" not in origin:
        return {name: [i for i, split in enumerate(origin) if split == name] for name in ("train", "test")}
    listed = {name: top.get(f"{name}_filenames") for name in ("train", "test")}
    if all(isinstance(names, list) and names for names in listed.values()):
        files = {_normal(path): i for i, (_, path, _) in enumerate(views)}
        splits: dict[str, list[int]] = {}
        for name, names in listed.items():
            found = [files.get(_normal(root / file)) for file in names or () if isinstance(file, str)]
            splits[name] = sorted({i for i in found if i is not None})
        if splits["train"] and not set(splits["train"]) & set(splits["test"]):
            return splits
    return {"train": list(range(len(views))), "test": []}
