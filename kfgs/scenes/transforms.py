"""transforms.json (nerfstudio, instant-ngp, Blender) to scenes.

**Convention**: `transform_matrix` is camera to world with OpenGL axes (x right, y up, z backward); kfgs wants world to
camera with y down and z forward, so the y and z columns change sign and the pose is inverted. The world stays the
file's: `applied_transform` says what was done to poses and points alike, and is not undone.
`cx, cy` are read as COLMAP's (the centre of the first pixel is (0.5, 0.5)), because nerfstudio's and instant-ngp's
converters copy COLMAP's numbers and both programs sample pixels at +0.5.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from .._files import read_json
from ..cameras.camera import Camera, Distortion
from ..formats.ply import points_from_columns, read_ply
from .files import IMAGE_SUFFIXES, SceneError, is_file, natural_key, read_image, some
from .scene import Scene

_PERSPECTIVE = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_COEFFICIENTS = {"PINHOLE": (), "SIMPLE_PINHOLE": (), **dict.fromkeys(_FISHEYE, ("k1", "k2", "k3", "k4"))}
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # OpenGL axes to COLMAP's
_MAX_SIDE = 100_000


@dataclass
class _Reader:
    """What one file says about frames, and what went wrong with some of them."""

    path: Path
    root: Path
    images: Path | None
    views: list[tuple[Camera, Path]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    masked: int = 0

    def fail(self, where: str, expected: str, got: object, advice: str) -> SceneError:
        return SceneError(f"{self.path}, {where}: expected {expected}, got {got!r:.200}; {advice}")


def load_transforms(path: str | Path, images: str | Path | None = None) -> Scene:
    """Read a transforms.json, or the transforms_train.json and transforms_test.json of a Blender scene.

    Intrinsics may stand at the top or in each frame (the frame's count): `w, h, fl_x, fl_y, cx, cy`, `camera_angle_x`
    and `camera_angle_y` (radians) where focal lengths are missing, `k1 k2 p1 p2 [k3]` or, with a fisheye, `k1 k2 k3 k4`.
    Without `w, h` the picture's own size is taken, without `cx, cy` its centre.

    A frame whose file is missing is left out and named in `notes`. Frames that reach outside the scene folder (an absolute
    path, or `..`) are read if they are image files, and counted in `notes`. `ply_file_path` gives the points, if it is inside the
    folder; else the scene has none (P = 0, noted). `mask_path` and `depth_file_path` are not read.

    Args:
        path: the file, or a folder with `transforms.json` or `transforms_train.json`.
        images: look image files up here before the scene folder.

    Returns:
        The scene in natural order of names. Splits are the file's (`train_filenames`, `test_filenames`, Blender's files), or
        all views in `train`.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it is damaged, a number is missing or implausible, a lens has no exact form in kfgs, or no frame
            has a file.
    """
    files = _files(Path(path))
    readers = {}
    for split, file in files.items():
        reader = _Reader(file, file.parent, None if images is None else Path(images))
        readers[split] = (reader, _read_frames(reader))
    views = [(camera, image, split) for split, (reader, _) in readers.items() for camera, image in reader.views]
    missing = [name for reader, _ in readers.values() for name in reader.missing]
    outside = [name for reader, _ in readers.values() for name in reader.outside]
    if not views:
        raise SceneError(
            f"{path}: expected frames with image files, none of {len(missing)} has one ({some(missing, 3)}); "
            "copy the images beside the file or give their folder"
        )
    views.sort(key=lambda view: natural_key(view[0].name))
    first, top = next(iter(readers.values()))
    points, colors, notes = _points(first, top)
    if missing:
        notes.append(f"{len(missing)} of {len(missing) + len(views)} frames have no image file: {some(missing)}")
    if outside:
        notes.append(f"{len(outside)} image files lie outside {first.root}: {some(outside, 3)}")
    if any(reader.masked for reader, _ in readers.values()):
        notes.append(f"{sum(reader.masked for reader, _ in readers.values())} frames have a mask_path; it is not used")
    cameras, paths = [view[0] for view in views], [view[1] for view in views]
    return Scene(cameras, paths, points, colors, _splits(views, first.root, top), tuple(notes)).with_near()


def _files(path: Path) -> dict[str, Path]:
    """The files to read, by split; `all` where the file does not say."""
    if path.is_dir():
        if (path / "transforms.json").is_file():
            return {"all": path / "transforms.json"}
        parts = {name: path / f"transforms_{name}.json" for name in ("train", "test")}
        found = {name: file for name, file in parts.items() if file.is_file()}
        if "train" not in found:
            raise FileNotFoundError(f"{path}: no transforms.json and no transforms_train.json; expected one of them")
        return found
    return {"all": path}


def _read_frames(reader: _Reader) -> dict[str, Any]:
    """Fill `reader.views`; return the file's top level."""
    try:
        top = read_json(reader.path)
    except ValueError as error:
        raise SceneError(f"{error}; write the file again") from error
    except RecursionError as error:
        raise SceneError(
            f"{reader.path}: expected a JSON file, got brackets nested too deep; write the file again"
        ) from error
    if not isinstance(top, dict) or not isinstance(top.get("frames"), list) or not top["frames"]:
        raise reader.fail("top level", "an object with a list of 'frames'", top, "is this a transforms.json?")
    sizes: dict[str, tuple[int, int]] = {}
    for i, frame in enumerate(top["frames"]):
        where = f"frame {i}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise reader.fail(where, "an object with a 'file_path'", frame, "write the file again")
        file = _find_image(reader, frame["file_path"])
        if file is None:
            reader.missing.append(frame["file_path"])
            continue
        merged = {**top, **frame}
        reader.masked += "mask_path" in frame
        if "w" not in merged or "h" not in merged:
            if "all" not in sizes:  # pictures of one size, as Blender writes them; another size fails in Scene.image
                height, width = read_image(file).shape[:2]
                sizes["all"] = width, height
            merged["w"], merged["h"] = sizes["all"]
        reader.views.append((_camera(reader, where, merged, _name(reader, file)), file))
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
    """File name relative to the image folder: `images/` of the scene, else the scene's folder; elsewhere the bare name."""
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


def _number(reader: _Reader, where: str, values: dict[str, Any], name: str, default: float | None = None) -> float:
    value = values.get(name, default)
    good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15
    if not good:
        raise reader.fail(f"{where}, {name}", "a finite number", value, "add it at the top or in each frame")
    assert value is not None
    return float(value)


def _camera(reader: _Reader, where: str, values: dict[str, Any], name: str) -> Camera:
    width, height = (_number(reader, where, values, side) for side in ("w", "h"))
    if not (1 <= width <= _MAX_SIDE and 1 <= height <= _MAX_SIDE and width % 1 == 0 and height % 1 == 0):
        raise reader.fail(where, f"w and h of 1 to {_MAX_SIDE} whole pixels", (width, height), "correct the size")
    fx, fy = _focal_lengths(reader, where, values, width, height)
    cx = _number(reader, where, values, "cx", width / 2)
    cy = _number(reader, where, values, "cy", height / 2)
    viewmat = _viewmat(reader, where, values.get("transform_matrix"))
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)
    lens = _distortion(reader, where, values)
    try:
        return Camera(viewmat.float(), K, int(width), int(height), name, lens)
    except ValueError as error:
        raise SceneError(f"{reader.path}, {where} ({name}): {error}") from error


def _focal_lengths(
    reader: _Reader, where: str, values: dict[str, Any], width: float, height: float
) -> tuple[float, float]:
    def from_angle(name: str, side: float) -> float | None:
        if name not in values:
            return None
        angle = _number(reader, where, values, name)
        if not 0 < angle < math.pi:
            raise reader.fail(f"{where}, {name}", "an angle in (0, pi) radians", angle, "correct it")
        return side / 2 / math.tan(angle / 2)

    fx = _number(reader, where, values, "fl_x") if "fl_x" in values else from_angle("camera_angle_x", width)
    if fx is None:
        raise reader.fail(where, "'fl_x' or 'camera_angle_x'", sorted(values), "add one at the top or in each frame")
    fy = _number(reader, where, values, "fl_y") if "fl_y" in values else from_angle("camera_angle_y", height)
    return fx, fx if fy is None else fy


def _distortion(reader: _Reader, where: str, values: dict[str, Any]) -> Distortion | None:
    """The lens; a perspective one whose coefficients are all zero is none.

    nerfstudio's k4 of a perspective camera is the fourth radial term, OpenCV's is the first of the denominator, so a k4
    is taken only with FULL_OPENCV, which can only mean OpenCV's.
    """
    model = values.get("camera_model", "OPENCV")
    if values.get("is_fisheye") is True:
        model = "OPENCV_FISHEYE"
    if model not in _PERSPECTIVE + _FISHEYE:
        raise reader.fail(
            f"{where}, camera_model",
            f"one of {', '.join(_PERSPECTIVE + _FISHEYE)}",
            model,
            "undistort the images first",
        )
    k = [_number(reader, where, values, f"k{i}", 0.0) for i in range(1, 7)]
    p = [_number(reader, where, values, f"p{i}", 0.0) for i in (1, 2)]
    coefficients = {**{f"k{i + 1}": value for i, value in enumerate(k)}, "p1": p[0], "p2": p[1]}
    known = _COEFFICIENTS.get(model, tuple(coefficients))
    dropped = {name: value for name, value in coefficients.items() if value and name not in known}
    if dropped:
        raise reader.fail(
            where, f"only {' '.join(known) or 'zeros'} with camera_model {model}", dropped,
            "correct camera_model or remove them",
        )  # fmt: skip
    if model in _FISHEYE:
        return Distortion("kannala_brandt", tuple(k[:4]))
    if not any(k + p):
        return None
    if any(k[3:]) and model != "FULL_OPENCV":
        raise reader.fail(
            where, "at most k1 k2 k3 p1 p2", {"k4": k[3], "k5": k[4], "k6": k[5]},
            'undistort the images first, or say "camera_model": "FULL_OPENCV" if these are OpenCV\'s k4 k5 k6',
        )  # fmt: skip
    if any(k[3:]):
        return Distortion("brown_conrady", (k[0], k[1], *p, *k[2:]))
    return Distortion("brown_conrady", (k[0], k[1], *p, k[2]) if k[2] else (k[0], k[1], *p))


def _viewmat(reader: _Reader, where: str, rows: Any) -> Tensor:  # [4, 4] float64
    """World to camera from a camera-to-world matrix with OpenGL axes."""
    try:
        pose = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise reader.fail(f"{where}, transform_matrix", "4 rows of 4 numbers", rows, "write the file again") from error
    if pose.shape == (3, 4):
        pose = torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
    if pose.shape != (4, 4) or not torch.isfinite(pose).all() or float(pose.abs().max()) > 1e15:
        raise reader.fail(f"{where}, transform_matrix", "4 rows of 4 finite numbers", rows, "write the file again")
    if pose[3].tolist() != [0, 0, 0, 1]:
        raise reader.fail(
            f"{where}, transform_matrix", "0 0 0 1 as the last row", pose[3].tolist(), "is it transposed?"
        )
    pose = pose @ _FLIP
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = pose[:3, :3].T  # Camera refuses what is not a rotation
    viewmat[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return viewmat


def _points(reader: _Reader, top: dict[str, Any]) -> tuple[Tensor, Tensor, list[str]]:
    """The cloud that `ply_file_path` names, in the frame of the poses."""
    nothing = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    listed = top.get("ply_file_path")
    if listed is None:
        return *nothing, [
            "no points: this transforms.json names no ply_file_path; a field needs some to start from (`kfgs sfm` finds them)"
        ]
    file = reader.root / listed if isinstance(listed, str) and "\0" not in listed else None
    if file is None or not _normal(file).is_relative_to(_normal(reader.root)) or not is_file(file):
        return *nothing, [f"no points: ply_file_path {listed!r:.200} is no file inside {reader.root}"]
    try:
        columns = read_ply(file)
        points = points_from_columns(columns)
    except ValueError as error:
        raise SceneError(
            f"{error} (named by ply_file_path in {reader.path}; remove the entry to go without)"
        ) from error
    if not torch.isfinite(points).all():
        raise SceneError(f"{file}: expected finite coordinates, got NaN or infinity; write the point cloud again")
    colors = torch.full((len(points), 3), 128, dtype=torch.uint8)
    for i, name in enumerate(("red", "green", "blue")):
        if name in columns and columns[name].dtype.kind in "iu":
            colors[:, i] = torch.from_numpy(columns[name].clip(0, 255).astype("uint8"))
    return points, colors, []


def _splits(views: list[tuple[Camera, Path, str]], root: Path, top: dict[str, Any]) -> dict[str, list[int]]:
    """The splits that the files themselves make, else all views in train."""
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
