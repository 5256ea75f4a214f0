"""ScanNet scenes as its SensReader exports them: colour pictures with a pose file each.

**Convention**: `pose/N.txt` is camera to world, x right, y down, z forward, in metres, in the frame of the scene's mesh.
The intrinsics are used as they are: ScanNet does not say whether they count pixel centres from 0 or from 0.5.
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from .._files import as_path, file_stem
from .files import SceneError, list_images, some
from .posed import Matrix, PosedPicture, picture_size, points_from_depth, read_numbers, read_points, scene_of_poses
from .scene import Scene

_MILLIMETRES = 1000.0  # of ScanNet's depth pictures
MESH = "_vh_clean_2.ply"


def is_scannet(folder: Path) -> bool:
    """Whether this is a scene that ScanNet's SensReader exported."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def load_scannet(folder: str | Path) -> Scene:
    """Read a ScanNet scene: `color/0.jpg`, `pose/0.txt`, `intrinsic/intrinsic_color.txt`.

    Views whose pose is not finite (tracking was lost) are left out and noted. Points are all vertices of
    `<scene>_vh_clean_2.ply` if there is one, in its order; else they come from `depth/` and `intrinsic/intrinsic_depth.txt`.

    Raises:
        FileNotFoundError: if a file is missing.
        SceneError: if one is damaged, or no view has a pose.
    """
    folder = as_path(folder)
    names = list_images(folder / "color")
    with_pose = [name for name in names if (folder / "pose" / f"{file_stem(name)}.txt").is_file()]
    if not with_pose:
        raise SceneError(
            f"{folder / 'pose'}: expected N.txt for the pictures N.jpg of {folder / 'color'} ({some(names, 3) or 'none'}), "
            "got none that fits; export the scene again with ScanNet's SensReader"
        )
    views = []
    for name in with_pose:
        file = folder / "pose" / f"{file_stem(name)}.txt"
        views.append(PosedPicture(name, folder / "color" / name, _matrix(file), str(file)))
    K = _matrix(folder / "intrinsic" / "intrinsic_color.txt")[:3, :3]
    size, largest = max((picture_size(view.path), view.path) for view in views)  # others may be smaller copies
    if not (0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1]):
        raise SceneError(
            f"{folder / 'intrinsic/intrinsic_color.txt'}: expected a principal point inside {largest} "
            f"({size[0]}x{size[1]} pixels), got ({K[0, 2]:g}, {K[1, 2]:g}); give pictures of the size that was exported"
        )
    notes = []
    if len(with_pose) < len(names):
        lost = [name for name in names if name not in set(with_pose)]
        notes.append(f"{len(lost)} pictures have no file in pose/ and were left out: {some(lost)}")
    points, told = _points(folder, views)
    return scene_of_poses(folder, views, K, size, points, [*notes, *told])


def _matrix(path: Path) -> Matrix:  # [4, 4]
    matrix = read_numbers(path, "4 rows of 4 numbers")
    if matrix.shape != (4, 4):
        raise SceneError(f"{path}: expected 4 rows of 4 numbers, got {matrix.shape}; export the scene again")
    return matrix


def _points(folder: Path, views: list[PosedPicture]) -> tuple[tuple[Tensor, Tensor] | None, list[str]]:
    meshes = sorted(folder.glob(f"*{MESH}"))
    if meshes:
        try:
            points, colors, notes = read_points(meshes[0])
            return (points, colors), notes
        except ValueError as error:
            raise SceneError(f"{error}; copy the mesh again, or remove it to take points from the depth") from error
    intrinsic = folder / "intrinsic" / "intrinsic_depth.txt"
    if not intrinsic.is_file():
        return None, []
    depths = [folder / "depth" / f"{file_stem(view.name)}.png" for view in views]
    return points_from_depth(views, depths, _matrix(intrinsic)[:3, :3], _MILLIMETRES), []
