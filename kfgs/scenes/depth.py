"""Points of surfaces from depth pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..cameras.camera import Camera
from ..cameras.projection import unproject_depth
from .files import SceneError, is_file, open_picture, read_alpha, read_image
from .masks import folder_masks, picture_folder, read_mask
from .posed import Matrix, PosedPicture, mend_pose

MILLIMETRE = 1e-3  # metres: the step of most depth pictures
DEPTH_VIEWS = 25  # depth pictures that are read: enough to see a room from all sides, a second to decode
DEPTH_POINTS = 100_000  # points from all of them: what structure from motion gives for a room, and more


def read_depth(path: Path) -> NDArray[Any]:  # [H, W]
    """The whole numbers of a depth PNG; 0 is unknown."""
    with open_picture(path, "a depth PNG", "copy it again") as picture:
        depth, mode = np.asarray(picture), picture.mode
    if depth.ndim != 2 or mode == "P":
        got = "colours of a palette" if mode == "P" else str(depth.shape)
        raise SceneError(
            f"{path}: expected a depth PNG with one channel of numbers, got {got}; is this a picture for people?"
        )
    return depth


def points_from_depth(
    views: Sequence[PosedPicture],
    unit: float = MILLIMETRE,
    K: Matrix | None = None,  # [3, 3]
) -> tuple[Tensor, Tensor] | None:  # [P, 3] float64, [P, 3] uint8
    """About `DEPTH_POINTS` points of surfaces with their colours, from `DEPTH_VIEWS` evenly chosen depth pictures.

    Pixels that are masked or transparent in the colour picture give none. Views without a pose, with a lens, or without a depth
    picture are left out.

    Args:
        views: the pictures.
        unit: world units per step of the depth pictures.
        K: intrinsics of the depth pictures. None takes those of each view, resized: pictures and depth then show the same. A
            colour is that of the same place in the colour picture.

    Returns:
        The points, or None if there is no depth.
    """
    usable = [v for v in views if v.depth is not None and is_file(v.depth) and v.distortion is None]
    pairs = [(view, pose) for view in usable if (pose := mend_pose(view.pose)[0]) is not None]
    if not pairs:
        return None
    chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, DEPTH_VIEWS).round().astype(int))]
    names = [view.name for view, _ in chosen]
    masks = folder_masks(names, picture_folder(names[0], chosen[0][0].path))[0] or [None] * len(chosen)
    points, colors = [], []
    for (view, pose), folder_mask in zip(chosen, masks, strict=True):
        assert view.depth is not None
        depth, image = read_depth(view.depth).astype(np.float64) * unit, read_image(view.path).numpy()
        height, width = depth.shape
        step = max(int(np.sqrt(height * width * len(chosen) / DEPTH_POINTS)), 1)
        own = np.diag([width / view.size[0], height / view.size[1], 1.0]) @ view.K if K is None else K
        y, x = (axis.reshape(-1) for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        rows, columns = y * image.shape[0] // height, x * image.shape[1] // width  # in the colour picture
        mask, alpha, known = view.mask or folder_mask, read_alpha(view.path), depth[y, x] > 0
        if mask is not None:
            known &= read_mask(mask, image.shape[:2]).numpy()[rows, columns]
        if alpha is not None:
            known &= (alpha > 0.5).numpy()[rows, columns]
        camera = Camera(torch.eye(4), torch.from_numpy(own), width, height)
        local = unproject_depth(camera, torch.from_numpy(depth)).numpy()[y[known], x[known]]
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        colors.append(image[rows[known], columns[known]])
    shades = torch.from_numpy((np.concatenate(colors) * 255).round().astype(np.uint8))
    return torch.from_numpy(np.concatenate(points)), shades
