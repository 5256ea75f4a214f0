"""Polycam's raw captures, which are ARKit's: `keyframes/` with a camera file for each picture, and depth from LiDAR.

**Convention**: `t_00` to `t_23` of a camera file are the first three rows of a camera-to-world matrix with OpenGL axes (x
right, y up, z backward), in metres, in ARKit's world (y up). `fx`, `fy`, `cx`, `cy` are in pixels of `width` x `height`. Depth
pictures are in millimetres and may be smaller than the pictures. So programs say that read such captures; none was at hand.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .._files import as_path, file_stem
from .files import MAX_NUMBER, MAX_SIDE, SceneError, list_images, read_scene_json, some
from .posed import MILLIMETRE, PosedPicture, points_from_depth, scene_of_poses
from .scene import Scene

_KINDS = (
    ("corrected_cameras", "corrected_images"),
    ("cameras", "images"),
)  # after and before Polycam's bundle adjustment
_DEPTHS = ("corrected_depth", "depth")
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_AGAIN = "export the capture again (raw data, developer mode)"


def is_polycam(folder: Path) -> bool:
    """Whether this is a raw capture, or its folder `keyframes`."""
    return _find(folder) is not None


def load_polycam(folder: str | Path) -> Scene:
    """Read a raw capture: poses that Polycam corrected (`corrected_cameras/`), else ARKit's own (`cameras/`).

    Points come from the depth pictures, if there are some.

    Raises:
        SceneError: if a file is damaged, or no picture has a camera.
    """
    folder = as_path(folder)
    found = _find(folder)
    assert found is not None
    cameras, images = found
    names = list_images(images)
    views = [_view(cameras / f"{file_stem(name)}.json", images, name) for name in names if _has(cameras, name)]
    if not views:
        raise SceneError(
            f"{cameras}: expected a file NAME.json for each of {some(names, 3) or 'no pictures'}, got none; {_AGAIN}"
        )
    lost = [name for name in names if not _has(cameras, name)]
    notes = [f"{len(lost)} pictures have no file in {cameras.name}/ and were left out: {some(lost)}"] if lost else []
    if cameras.name == "cameras":
        notes.append("poses are ARKit's own: this capture has no corrected_cameras/")
    folders = (cameras.parent / name for name in _DEPTHS)
    depths = next((place for place in folders if place.is_dir()), None)
    points = None
    if depths is not None:
        points = points_from_depth(
            views, [depths / f"{file_stem(view.name)}.png" for view in views], None, 1 / MILLIMETRE
        )
    return scene_of_poses(folder, views, None, None, points, notes)


def _find(folder: Path) -> tuple[Path, Path] | None:
    """The folders of camera files and of pictures."""
    for place in (folder / "keyframes", folder):
        for cameras, images in _KINDS:
            if next((place / cameras).glob("*.json"), None) is not None and (place / images).is_dir():
                return place / cameras, place / images
    return None


def _has(cameras: Path, name: str) -> bool:
    return (cameras / f"{file_stem(name)}.json").is_file()


def _view(file: Path, images: Path, name: str) -> PosedPicture:
    content = read_scene_json(file, _AGAIN)
    values: dict[str, Any] = content if isinstance(content, dict) else {}
    keys = ("width", "height", "fx", "fy", "cx", "cy", *(f"t_{i}{j}" for i in range(3) for j in range(4)))
    if any(type(values.get(key)) is float and not math.isfinite(values[key]) for key in keys):
        return PosedPicture(name, images / name, np.full((4, 4), np.nan), str(file), (np.eye(3), (1, 1)))  # left out
    good = [type(values.get(key)) in (int, float) and abs(values[key]) < MAX_NUMBER for key in keys]
    width, height, fx, fy = (values.get(key, 0) for key in keys[:4])
    if not all(good) or not (
        0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width % 1 == height % 1 == 0 and min(fx, fy) > 0
    ):
        odd = next((key for key, fine in zip(keys, good, strict=True) if not fine), "width, height, fx or fy")
        raise SceneError(
            f"{file}: expected {', '.join(keys[:6])} and t_00 to t_23 as numbers, got {odd} = {values.get(odd)!r:.40}; {_AGAIN}"
        )
    pose = np.eye(4)
    pose[:3] = [[values[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
    K = np.array([[fx, 0, values["cx"]], [0, fy, values["cy"]], [0, 0, 1]], dtype=np.float64)
    return PosedPicture(name, images / name, pose @ _OPENGL, str(file), (K, (int(width), int(height))))
