"""Folders with a pose for each picture: Replica (two renderings) and ScanNet.

**Convention**: poses in files are camera to world, x right, y down, z forward.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .._files import file_stem, read_json, real_path
from .files import MAX_NUMBER, MAX_SIDE, SceneError, list_images, picture_size, scene_error, some
from .posed import PosedPicture, points_from_depth, read_numbers, read_points, scene_of_poses
from .scene import Scene

AGAIN = "copy it again from the data set"
SQUARE, MESH = "4 rows of 4 numbers", "_vh_clean_2.ply"  # of ScanNet


def load_nice_slam(folder: Path) -> Scene:
    """Replica by NICE-SLAM: `results/frame000000.jpg`, `results/depth000000.png`, `traj.txt`, `cam_params.json`.

    The last may be one level up. Its intrinsics count pixel centres from 0, so cx and cy grow by 0.5 here.
    """
    places = [folder / "cam_params.json", real_path(folder).parent / "cam_params.json"]
    path = next((place for place in places if place.is_file()), places[1])
    example = '{"camera": {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}}'
    names = ("w", "h", "fx", "fy", "scale", "cx", "cy")
    with scene_error(after=f"; {AGAIN}"):
        top = read_json(path, f"the camera of the Replica scenes, {example}, in {folder} or")
    try:
        width, height, fx, fy, scale, cx, cy = values = [top["camera"][name] for name in names]
        numbers = all(type(value) in (int, float) and abs(value) < MAX_NUMBER for value in values)  # NaN fails
        if not (numbers and width % 1 == height % 1 == 0 and min(values[:5]) > 0 and max(width, height) <= MAX_SIDE):
            raise ValueError(f"{values}")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        expected = f"a 'camera' with {', '.join(names)} (the scale of the depth pictures) as positive numbers"
        raise SceneError(f"{path}: expected {expected}, got something else ({error!r:.200}); {AGAIN}") from error
    views, notes = _numbered(folder / "results", r"frame(\d+)\.(?:jpg|jpeg|png)", folder / "traj.txt")
    for view in views:
        view.K, view.size = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]]), (int(width), int(height))
        view.depth = view.path.with_name(Path(view.name).stem.replace("frame", "depth") + ".png")
    return scene_of_poses(folder, views, points_from_depth(views, 1 / scale), notes)


def load_semantic_nerf(folder: Path) -> Scene:
    """Replica by Semantic-NeRF: `rgb/rgb_0.png`, `depth/depth_0.png` (millimetres), `traj_w_c.txt`.

    No file has the intrinsics: the field of view is 90 degrees across, the principal point is the middle of the picture.
    """
    views, notes = _numbered(folder / "rgb", r"rgb_(\d+)\.(?:png|jpg)", folder / "traj_w_c.txt")
    for view in views:
        width, height = view.size = picture_size(view.path)
        view.K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
        view.depth = folder / "depth" / (Path(view.name).stem.replace("rgb", "depth") + ".png")
    notes.append("no file has the intrinsics: 90 degrees across, the principal point centred, as Semantic-NeRF renders")
    return scene_of_poses(folder, views, points_from_depth(views), notes)


def _numbered(folder: Path, pattern: str, poses: Path) -> tuple[list[PosedPicture], list[str]]:
    """The pictures of a folder whose number says which line of a file is their pose, and a note about other lines."""
    rows = read_numbers(poses, "lines of 16 numbers, one camera-to-world matrix per picture", 16)
    matches = [match for name in list_images(folder) if (match := re.fullmatch(pattern, name, re.IGNORECASE))]
    if not matches:
        example = pattern.replace(r"(\d+)", "NUMBER").split("\\")[0]
        raise SceneError(f"{folder}: expected pictures named {example}..., got none; copy those of {poses} there")
    numbers = [int(match[1]) for match in matches]
    if max(numbers) >= len(rows):
        got = f"{len(rows)} lines for numbers up to {max(numbers)} (the first line is for number 0)"
        raise SceneError(f"{poses}: expected a line per picture of {folder}, got {got}; copy the whole folder again")
    views = [
        PosedPicture(match[0], folder / match[0], rows[number].reshape(4, 4), f"{poses}, line {number + 1}")
        for match, number in zip(matches, numbers, strict=True)
    ]
    missing = len(rows) - len(set(numbers))
    return views, [f"{missing} of {len(rows)} poses in {poses} have no picture"] if missing else []


def load_scannet(folder: Path) -> Scene:
    """ScanNet: `color/0.jpg`, `pose/0.txt`, `intrinsic/intrinsic_color.txt`, whose intrinsics are used as they are.

    Views whose pose is not finite (tracking was lost) are left out and noted. Points are all vertices of
    `<scene>_vh_clean_2.ply` if there is one, in its order; else they come from `depth/` and `intrinsic/intrinsic_depth.txt`.
    """
    names = list_images(folder / "color")
    files = {name: folder / "pose" / f"{file_stem(name)}.txt" for name in names}
    lost = [name for name in names if not files[name].is_file()]
    if len(lost) == len(names):
        expected = f"N.txt for the pictures N.jpg of {folder / 'color'} ({some(names, 3) or 'none'})"
        advice = "export the scene again with ScanNet's SensReader"
        raise SceneError(f"{folder / 'pose'}: expected {expected}, got none that fits; {advice}")
    file, views = folder / "intrinsic" / "intrinsic_color.txt", list[PosedPicture]()
    K = read_numbers(file, SQUARE, 4, 4)[:3, :3]
    size, largest = max((picture_size(folder / "color" / name), name) for name in names)  # others may be smaller copies
    if not (0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1]):
        got = f"({K[0, 2]:g}, {K[1, 2]:g}); give pictures of the size that was exported"
        raise SceneError(f"{file}: expected a principal point inside {largest} ({size[0]}x{size[1]} pixels), got {got}")
    for name in names:
        if name not in lost:
            pose = read_numbers(files[name], SQUARE, 4, 4)
            view = PosedPicture(name, folder / "color" / name, pose, str(files[name]), K, size)
            view.depth = folder / "depth" / f"{file_stem(name)}.png"
            views.append(view)
    notes = [f"{len(lost)} pictures have no file in pose/ and were left out: {some(lost)}"] if lost else []
    points = None
    mesh, depth = min(folder.glob(f"*{MESH}"), default=None), folder / "intrinsic" / "intrinsic_depth.txt"
    if mesh is not None:
        places, colors, told = read_points(mesh, "copy the mesh again, or remove it to take points from the depth")
        points, notes = (places, colors), notes + told
    elif depth.is_file():
        points = points_from_depth(views, K=read_numbers(depth, SQUARE, 4, 4)[:3, :3])
    return scene_of_poses(folder, views, points, notes)


class Layout(NamedTuple):
    """How a data set's folder is recognised and read."""

    name: str
    files: tuple[str, str]
    read: Callable[[Path], Scene]
    video: bool  # neighbouring views show the same


LAYOUTS = (
    Layout("Replica (NICE-SLAM)", ("results", "traj.txt"), load_nice_slam, True),
    Layout("Replica (Semantic-NeRF)", ("rgb", "traj_w_c.txt"), load_semantic_nerf, True),
    Layout("ScanNet", ("color", "pose"), load_scannet, False),
)


def find_layout(folder: Path) -> Layout | None:
    """The layout of a folder, if it has one."""
    return next((layout for layout in LAYOUTS if all((folder / file).exists() for file in layout.files)), None)
