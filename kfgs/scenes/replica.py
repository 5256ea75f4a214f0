"""Replica, as NICE-SLAM and as Semantic-NeRF rendered it: a video with a file of poses.

**Convention**: `traj.txt` and `traj_w_c.txt` hold camera-to-world matrices, one per line, x right, y down, z forward, in
metres. The intrinsics of both count pixel centres from 0, so cx and cy grow by 0.5 here.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from .._files import as_path, real_path
from .files import MAX_SIDE, SceneError, read_scene_json
from .posed import Matrix, numbered_pictures, picture_size, points_from_depth, scene_of_poses
from .scene import Scene

_MILLIMETRES = 1000.0  # of Semantic-NeRF's depth pictures
_FIELD_OF_VIEW = math.pi / 2  # horizontal, of Semantic-NeRF's renders


def is_nice_slam(folder: Path) -> bool:
    """Whether this is a scene as NICE-SLAM published it."""
    return (folder / "results").is_dir() and (folder / "traj.txt").is_file()


def load_nice_slam(folder: str | Path) -> Scene:
    """Read a Replica scene in NICE-SLAM's layout.

    `results/frame000000.jpg`, `results/depth000000.png`, `traj.txt`, and `cam_params.json` in the folder or one level up.
    Points come from the depth pictures.

    Raises:
        FileNotFoundError: if a file is missing.
        SceneError: if one is damaged, or a picture has no pose.
    """
    folder = as_path(folder)
    K, size, scale = _cam_params(folder)
    views, notes = numbered_pictures(folder / "results", r"frame(\d+)\.(?:jpg|jpeg|png)", folder / "traj.txt")
    depths = [view.path.with_name(Path(view.name).stem.replace("frame", "depth") + ".png") for view in views]
    return scene_of_poses(folder, views, K, size, points_from_depth(views, depths, K, scale), notes)


def is_semantic_nerf(folder: Path) -> bool:
    """Whether this is a sequence of Replica as Semantic-NeRF rendered it."""
    return (folder / "rgb").is_dir() and (folder / "traj_w_c.txt").is_file()


def load_semantic_nerf(folder: str | Path) -> Scene:
    """Read a sequence of Semantic-NeRF's Replica renders.

    `rgb/rgb_0.png`, `depth/depth_0.png` (millimetres), `traj_w_c.txt`. The renders have no file of intrinsics: the field of
    view is 90 degrees across, the principal point is the middle of the picture.

    Raises:
        FileNotFoundError: if a file is missing.
        SceneError: if one is damaged, or a picture has no pose.
    """
    folder = as_path(folder)
    views, notes = numbered_pictures(folder / "rgb", r"rgb_(\d+)\.(?:png|jpg)", folder / "traj_w_c.txt")
    views = [view._replace(lens=_centred(picture_size(view.path))) for view in views]
    depths = [folder / "depth" / (Path(view.name).stem.replace("rgb", "depth") + ".png") for view in views]
    note = (
        "no file has the intrinsics of Semantic-NeRF's renders: 90 degrees across and a centred principal point assumed"
    )
    points = points_from_depth(views, depths, None, _MILLIMETRES)
    return scene_of_poses(folder, views, None, None, points, [*notes, note])


def _centred(size: tuple[int, int]) -> tuple[Matrix, tuple[int, int]]:
    """K and the size of a render of Semantic-NeRF."""
    width, height = size
    focal = width / 2 / math.tan(_FIELD_OF_VIEW / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), size


def _cam_params(folder: Path) -> tuple[Matrix, tuple[int, int], float]:
    """K, (width, height) and the scale of the depth pictures."""
    places = [folder / "cam_params.json", real_path(folder).parent / "cam_params.json"]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise FileNotFoundError(
            f"{places[1]}: no such file; expected the camera of the Replica scenes there or in {folder}: "
            '{"camera": {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}}'
        )
    top = read_scene_json(path, "copy it again from the data set")
    values = top.get("camera") if isinstance(top, dict) else None
    names = ("w", "h", "fx", "fy", "cx", "cy", "scale")
    numbers = [values.get(name) if isinstance(values, dict) else None for name in names]
    w, h, fx, fy, cx, cy, scale = (n if isinstance(n, int | float) and math.isfinite(n) else -1 for n in numbers)
    if min(w, h, fx, fy, scale) <= 0 or max(w, h) > MAX_SIDE or w % 1 or h % 1:
        raise SceneError(
            f'{path}: expected {{"camera": {{{", ".join(names)}}}}} with positive numbers, got {values!r:.200}; '
            "copy it again from the data set"
        )
    K = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]], dtype=np.float64)  # also of large whole numbers
    return K, (int(w), int(h)), float(scale)
