"""Scenes with a `poses_bounds.npy`, the layout of LLFF, which 3D-OVS has.

**Convention**: a row has a 3x5 matrix and two depths. The matrix is [down, right, back, centre, (height, width, focal
length)], camera to world; the size is that of the pictures the poses were made for.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .._arrays import read_array
from .._files import as_path
from .files import SceneError, list_images, natural_key
from .posed import PosedPicture, picture_size, scene_of_poses
from .scene import Scene

POSES = "poses_bounds.npy"


def is_llff(folder: Path) -> bool:
    """Whether this is a scene with LLFF's file of poses."""
    return (folder / POSES).is_file()


def load_llff(folder: str | Path, images: str | Path | None = None) -> Scene:
    """Read `poses_bounds.npy` and as many pictures: `images/`, or `images_4/` and the like.

    Pictures smaller than the poses say are fine if they have the same shape: the focal length is scaled. The principal
    point is the middle of the picture. There are no points.

    Args:
        folder: the scene.
        images: the folder of the pictures; None: `images`, else the first of `images_2`, `images_4`, `images_8`.

    Raises:
        FileNotFoundError: if a file or folder is missing.
        SceneError: if the poses are damaged, or differ in number or shape from the pictures.
    """
    folder = as_path(folder)
    path = folder / POSES
    rows = _read(path)
    source = as_path(images) if images is not None else _pictures(folder)
    names = list_images(source)
    if len(names) != len(rows):
        raise SceneError(
            f"{path}: expected one row per picture in {source} ({len(names)}), got {len(rows)}; give the folder whose "
            "pictures the poses were made for"
        )
    views = []
    for i, (name, row) in enumerate(zip(sorted(names, key=natural_key), rows, strict=True)):
        pose = np.eye(4)
        pose[:3] = np.stack([row[:, 1], row[:, 0], -row[:, 2], row[:, 3]], 1)
        views.append(PosedPicture(name, source / name, pose, f"{path}, row {i}"))
    height, width, focal = rows[0, :, 4]
    size = picture_size(views[0].path)
    factor = size[0] / width
    if not (focal > 0 and abs(size[1] - height * factor) <= 1.5):
        raise SceneError(
            f"{views[0].path}: expected the shape {width:g}x{height:g} that {path} says, or a smaller picture of that shape, "
            f"got {size[0]}x{size[1]}; were the pictures cropped or turned?"
        )
    K = np.array([[focal * factor, 0, size[0] / 2], [0, focal * size[1] / height, size[1] / 2], [0, 0, 1]])
    return scene_of_poses(folder, views, K, size)


def _read(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:  # [V, 3, 5]
    try:
        values = read_array(path, "an array [V, 17]", "copy it again")
    except ValueError as error:
        raise SceneError(str(error)) from error
    if values.ndim != 2 or values.shape[1] != 17 or len(values) == 0 or values.dtype.kind != "f":
        got = f"{values.dtype} {values.shape}"
        raise SceneError(f"{path}: expected floats [V, 17] as LLFF writes them, got {got}; copy it again")
    matrices = values[:, :15].astype(np.float64).reshape(-1, 3, 5)
    if not (matrices[0, :, 4] > 0).all():
        raise SceneError(
            f"{path}: expected height, width and focal length above 0 in the fifth column, got {matrices[0, :, 4].tolist()}; "
            "copy it again"
        )
    return matrices


def _pictures(folder: Path) -> Path:
    found = [p for p in folder.glob("images*") if p.is_dir() and re.fullmatch(r"images(_\d+)?", p.name)]
    if not found:
        raise FileNotFoundError(f"{folder / 'images'}: no such folder; expected the pictures of {folder / POSES} there")
    return min(found, key=lambda p: natural_key(p.name))
