"""From cameras with one pose per picture to a scene: what all readers share, and poses as programs write them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._files import read_text
from .._notes import Repair
from .._origin import choose_origin, describe_origin, to_local
from ..cameras.camera import ROTATION_TOLERANCE, Camera, Distortion
from ..cameras.resample import fits_aspect
from ..formats.ply import points_from_columns, read_ply
from .files import MAX_NUMBER, SceneError, natural_key, picture_size, some
from .scene import Scene

NO_POINTS = "no points: `kfgs fit` and `kfgs color` triangulate some from the poses before they train"
SKEW = 0.02  # largest difference of a rotation's singular values, relative: rotations that are rounded to two digits

Matrix = NDArray[np.float64]


@dataclass
class PosedPicture:
    """A picture, and where it was taken from."""

    name: str  # of the view, with suffix
    path: Path
    pose: Matrix | None  # [4, 4] camera to world, x right, y down, z forward; None: unknown
    origin: str  # the file, and the line, that the pose is from; for messages
    K: Matrix = field(default_factory=lambda: np.eye(3))
    size: tuple[int, int] = (1, 1)  # width, height
    distortion: Distortion | None = None
    mask: Path | None = None  # that the scene's file names; None: that of a folder `masks`
    depth: Path | None = None  # whole numbers, which show the same as the picture


def mend_pose(pose: Matrix | None) -> tuple[Matrix | None, float | None]:  # [4, 4]
    """A pose whose rotation has a scale or is rounded, with the nearest rotation (by SVD). The translation stays.

    Returns:
        The pose, or None if it has numbers that are not finite or plausible, or no rotation at all; and the scale that was
        removed, or None if it is unchanged. A matrix that is far from a rotation stays as it is, and `Camera` refuses it.
    """
    if pose is None or not (np.abs(pose) <= MAX_NUMBER).all():  # NaN fails
        return None, None
    R = pose[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() <= ROTATION_TOLERANCE:  # `Camera` accepts it
        return pose, None
    U, sizes, Vt = np.linalg.svd(R)
    if sizes[2] <= 1e-9 * sizes[0] or sizes[0] == 0:
        return None, None
    if sizes[0] - sizes[2] > SKEW * sizes[1] or np.linalg.det(R) < 0:
        return pose, None
    mended = pose.copy()
    mended[:3, :3] = U @ Vt
    return mended, float(sizes.mean())


def _as_large_as_pictures(
    cameras: Sequence[Camera], paths: Sequence[Path], folder: Path | None = None
) -> tuple[list[Camera], list[str]]:
    """Each camera in the size of its own picture, which may be a resized copy (`images_4`), and a note if some are."""
    fitting = []
    for camera, path in zip(cameras, paths, strict=True):
        width, height = picture_size(path)
        if not fits_aspect((height, width), camera.size):
            raise SceneError(
                f"{path}: expected a picture in the shape of {camera.width}x{camera.height} pixels, as its camera says, got "
                f"{width}x{height}; replace it by the picture that the camera was made for, or by a copy at another size"
            )
        fitting.append(camera if (height, width) == camera.size else camera.resized(height, width))
    other = [i for i, camera in enumerate(cameras) if camera is not fitting[i]]
    if not other:
        return fitting, []
    where = folder.name if folder is not None and paths[0].is_relative_to(folder) else "images"
    ratio = cameras[other[0]].width / fitting[other[0]].width
    how = f"{ratio:.3g} times smaller" if ratio > 1 else f"{1 / ratio:.3g} times larger"
    count = f"{len(other)} of {len(paths)} pictures have other sizes than the model says"
    return fitting, [f"{where}: {count} ({paths[other[0]].name} is {how}); cameras were resized to them"]


def scene_of_poses(
    path: Path,
    views: Sequence[PosedPicture],
    points: tuple[Tensor, Tensor] | None = None,  # [P, 3] of the world, [P, 3] uint8
    notes: Sequence[str] = (),
    images: Path | None = None,
    *,
    pictures: bool = True,
) -> Scene:
    """A scene of pictures with poses, all in the `train` split; views without a pose (not finite) are left out and noted.

    Cameras get the size of their pictures, whose files need not be there without `pictures`. `images` is a folder that the user
    gave, for a note.
    """
    cameras, kept, lost, scaled = list[Camera](), list[PosedPicture](), list[str](), dict[str, float]()
    for view in sorted(views, key=lambda view: natural_key(view.name)):
        pose, scale = mend_pose(view.pose)
        if pose is None:
            lost.append(view.name)
            continue
        if scale is not None:
            scaled[view.name] = scale
        try:
            if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
                raise ValueError(f"pose: expected 0 0 0 1 as its last row, got {pose[3].tolist()}")
            viewmat, K = torch.from_numpy(inverse_pose(pose)), torch.from_numpy(view.K).float()
            cameras.append(Camera(viewmat, K, *view.size, view.name, view.distortion))
        except ValueError as error:
            raise SceneError(f"{view.origin}: {error}; correct this pose") from error
        kept.append(view)
    if not cameras:
        raise SceneError(
            f"{path}: expected poses and lenses of finite numbers, got none in {len(views)} ({some(lost, 3)}); estimate them "
            "(`kfgs sfm`)"
        )
    paths, masks, resized = [view.path for view in kept], [view.mask for view in kept], list[str]()
    if pictures:
        cameras, resized = _as_large_as_pictures(cameras, paths, images)
    told = [*notes, *resized, *([NO_POINTS] if points is None else [])]
    if lost:
        told.append(Repair(f"{len(lost)} views have no pose or lens of finite numbers and were left out: {some(lost)}"))
    if scaled:
        low, high = f"{min(scaled.values()):.6g}", f"{max(scaled.values()):.6g}"
        sizes, names = low if low == high else f"{low} to {high}", some(list(scaled))
        told.append(
            Repair(f"{len(scaled)} poses have a scale ({sizes}) or a rounded rotation, which was removed: {names}")
        )
    places, colors = points or (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    origin = choose_origin(torch.stack([camera.center for camera in cameras]), places)
    local = [camera.with_origin(origin).to(torch.float32) for camera in cameras]
    told, splits = (
        [*told, *describe_origin(origin, "cameras and points")],
        {"train": list(range(len(local))), "test": []},
    )
    try:
        scene = Scene(local, paths, to_local(places, origin), colors, splits, tuple(told))
    except SceneError as error:  # names that do not differ
        raise SceneError(f"{path}: {error}") from error
    return replace(scene.with_near(), masks=masks if any(masks) else None)


def inverse_pose(pose: Matrix) -> Matrix:  # [4, 4] -> [4, 4]
    """The inverse of a rigid motion. `Camera` refuses what is not a rotation."""
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def read_numbers(path: Path, expected: str) -> Matrix:  # [rows, columns]
    """The numbers of a text file, row by row."""
    try:
        lines = read_text(path, expected).splitlines()
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in lines if line.strip()]
        if not rows or len({len(row) for row in rows}) != 1:
            raise ValueError(f"{len(rows)} rows of {sorted({len(row) for row in rows})} numbers")
    except ValueError as error:
        raise SceneError(f"{path}: expected {expected}, got something else ({error}); correct it") from error
    return np.array(rows, dtype=np.float64)


def read_points(path: Path) -> tuple[Tensor, Tensor, list[str]]:  # [P, 3] float64, [P, 3] uint8
    """The vertices of a PLY and their colours, grey if it has none; and a note if some are left out as they are not finite."""
    try:
        columns = read_ply(path)
        points = points_from_columns(path, columns)
    except ValueError as error:
        raise SceneError(str(error)) from error
    colors = torch.full((len(points), 3), 128, dtype=torch.uint8)
    for i, name in enumerate(("red", "green", "blue")):
        if name in columns and columns[name].dtype.kind in "iu":
            colors[:, i] = torch.from_numpy(columns[name].clip(0, 255).astype("uint8"))
    good = torch.isfinite(points).all(1)
    note = f"{int((~good).sum())} of {len(points)} points of {path.name} are not finite and were left out"
    return points[good], colors[good], [] if good.all() else [Repair(note)]
