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
from ..cameras.resample import fits_aspect
from .files import SceneError, list_images, natural_key
from .posed import PosedPicture, picture_size, scene_of_poses
from .scene import Scene

POSES = "poses_bounds.npy"


def is_llff(folder: Path) -> bool:
    """Whether this is a scene with LLFF's file of poses."""
    return (folder / POSES).is_file()


def load_llff(folder: str | Path, images: str | Path | None = None) -> Scene:
    """Read `poses_bounds.npy` and as many pictures: `images/`, or `images_4/` and the like.

    A picture smaller than its row says is fine if it has the same shape: the focal length is scaled. The principal point is
    the middle of the picture. There are no points.

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
        (height, width, focal), size = row[:, 4], picture_size(source / name)
        if not np.isfinite(row).all():
            views.append(
                PosedPicture(name, source / name, pose * np.nan, f"{path}, row {i}", (np.eye(3), size))
            )  # left out
            continue
        if not fits_aspect((size[1], size[0]), (height, width)):
            raise SceneError(
                f"{source / name}: expected the shape {width:g}x{height:g} that {path}, row {i}, says, got "
                f"{size[0]}x{size[1]}; was the picture cropped or turned? give the one that the poses were made for"
            )
        K = np.diag([focal * (size[0] / width), focal * size[1] / height, 1.0])
        K[:2, 2] = size[0] / 2, size[1] / 2
        views.append(PosedPicture(name, source / name, pose, f"{path}, row {i}", (K, size)))
    return scene_of_poses(folder, views, None, None)


def _read(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:  # [V, 3, 5]
    try:
        values = read_array(path, "an array [V, 17]", "copy it again")
    except ValueError as error:
        raise SceneError(str(error)) from error
    if values.ndim != 2 or values.shape[1] != 17 or len(values) == 0 or values.dtype.kind != "f":
        got = f"{values.dtype} {values.shape}"
        raise SceneError(f"{path}: expected floats [V, 17] as LLFF writes them, got {got}; copy it again")
    matrices = values[:, :15].astype(np.float64).reshape(-1, 3, 5)
    if (matrices[..., 4] <= 0).any():
        raise SceneError(
            f"{path}: expected height, width and focal length above 0 in the fifth column, got "
            f"{matrices[..., 4].min(0).tolist()}; copy it again"
        )
    return matrices


def _pictures(folder: Path) -> Path:
    found = [p for p in folder.glob("images*") if p.is_dir() and re.fullmatch(r"images(_\d+)?", p.name)]
    if not found:
        raise FileNotFoundError(f"{folder / 'images'}: no such folder; expected the pictures of {folder / POSES} there")
    return min(found, key=lambda p: natural_key(p.name))
