"""From files with one pose per picture to a scene: what the readers of such folders share."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._card import short_repr
from .._check import ORIGIN
from .._files import read_text
from .._notes import Repair
from .._origin import choose_origin, describe_origin, to_local
from ..cameras.camera import Camera
from ..cameras.resample import fits_aspect
from ..formats.ply import points_from_columns, read_ply
from .files import SceneError, is_file, list_images, natural_key, open_picture, read_alpha, read_image, some
from .masks import folder_masks, picture_folder, read_mask
from .poses import mend_pose, mending_notes
from .scene import Scene

MILLIMETRE = 1e-3  # metres: the step of most depth pictures
DEPTH_VIEWS = 25  # depth pictures that are read for points: enough to see a room from all sides, a second to decode
DEPTH_POINTS = 100_000  # points from all of them: what structure from motion gives for a room, and more

NO_POINTS = "no points: `kfgs fit` and `kfgs color` triangulate some from the poses before they train"

Matrix = NDArray[np.float64]


class PosedPicture(NamedTuple):
    """A picture, and where it was taken from."""

    name: str  # of the view, with suffix
    path: Path
    pose: Matrix  # [4, 4] camera to world, x right, y down, z forward
    origin: str  # the file, and the line, that the pose is from; for messages
    lens: tuple[Matrix, tuple[int, int]] | None = None  # its own K [3, 3] and (width, height); None: that of the scene
    mask: Path | None = None  # that the scene's file names; None: that of a folder `masks`

    def __repr__(self) -> str:
        return short_repr(self)


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture, from its header.

    Raises:
        SceneError: if it is no picture.
    """
    with open_picture(path, "a picture", "copy it again") as picture:
        return picture.size


def as_large_as_pictures(
    cameras: Sequence[Camera], paths: Sequence[Path], folder: Path | None = None
) -> tuple[list[Camera], list[str]]:
    """Each camera in the size of its own picture, which may be a resized copy (`images_4`), and a note if some are.

    Raises:
        SceneError: if a picture has another shape than its camera.
    """
    fitting, factors = [], Counter[str]()
    for camera, path in zip(cameras, paths, strict=True):
        width, height = picture_size(path)
        if not fits_aspect((height, width), camera.size):
            raise SceneError(
                f"{path}: expected a picture in the shape of {camera.width}x{camera.height} pixels, as its camera says, got "
                f"{width}x{height}; replace it by the picture that the camera was made for, or by a copy at another size"
            )
        if (height, width) != camera.size:
            small = camera.width / width
            factors[f"{small:.3g} times smaller" if small >= 1 else f"{1 / small:.3g} times larger"] += 1
        fitting.append(camera if (height, width) == camera.size else camera.resized(height, width))
    if not factors:
        return fitting, []
    where = folder.name if folder is not None and paths[0].is_relative_to(folder) else "images"
    count = "" if factors.total() == len(paths) else f"{factors.total()} of {len(paths)} "
    said = some([factor for factor, _ in factors.most_common()], 3)
    return fitting, [f"{where}: {count}pictures are {said} than the model says; cameras were resized to them"]


def read_numbers(path: Path, expected: str) -> Matrix:  # [rows, columns]
    """The numbers of a text file, row by row.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it holds something else, or rows of several lengths.
    """
    try:
        lines = read_text(path, expected).splitlines()
        rows = [[float(word) for word in line.replace(",", " ").split()] for line in lines if line.strip()]
        if not rows or len({len(row) for row in rows}) != 1:
            raise ValueError(f"{len(rows)} rows of {sorted({len(row) for row in rows})} numbers")
    except ValueError as error:
        raise SceneError(f"{path}: expected {expected}, got something else ({error}); correct it") from error
    return np.array(rows, dtype=np.float64)


def read_poses(path: Path) -> Matrix:  # [V, 4, 4]
    """Camera-to-world matrices, one of 16 numbers (or 12) per line.

    Raises:
        FileNotFoundError: if there is no such file.
        SceneError: if it holds something else.
    """
    rows = read_numbers(path, "lines of 16 numbers, one camera-to-world matrix per picture")
    if rows.shape[1] == 12:
        rows = np.concatenate([rows, np.tile([[0.0, 0, 0, 1]], (len(rows), 1))], 1)
    if rows.shape[1] != 16:
        raise SceneError(
            f"{path}: expected lines of 16 numbers, one camera-to-world matrix per picture, got lines of {rows.shape[1]}; "
            "copy the file again"
        )
    return rows.reshape(-1, 4, 4)


def numbered_pictures(folder: Path, pattern: str, poses: Path) -> tuple[list[PosedPicture], list[str]]:
    """The pictures of a folder whose number says which line of a file is their pose, counted from 0.

    Args:
        folder: the pictures.
        pattern: a regular expression of their names; its first group is the number.
        poses: the file of poses.

    Returns:
        The pictures in order, and notes about poses without a picture.

    Raises:
        FileNotFoundError: if there is no file of poses.
        SceneError: if it is damaged, there is no picture, or a picture has no line.
    """
    matrices = read_poses(poses)
    matches = [match for name in list_images(folder) if (match := re.fullmatch(pattern, name, re.IGNORECASE))]
    if not matches:
        example = pattern.replace(r"(\d+)", "NUMBER").split("\\")[0]
        raise SceneError(
            f"{folder}: expected pictures named {example}..., got none; copy the pictures of {poses} there"
        )
    numbers = [int(match[1]) for match in matches]
    if max(numbers) >= len(matrices):
        raise SceneError(
            f"{poses}: expected a line for each picture of {folder}, got {len(matrices)} lines for numbers up to "
            f"{max(numbers)} (the first line is for number 0); copy the whole folder again"
        )
    views = [
        PosedPicture(match[0], folder / match[0], matrices[number], f"{poses}, line {number + 1}")
        for match, number in zip(matches, numbers, strict=True)
    ]
    missing = len(matrices) - len(set(numbers))
    return views, [f"{missing} of {len(matrices)} poses in {poses} have no picture"] if missing else []


def scene_of_poses(
    folder: Path,
    views: Sequence[PosedPicture],
    K: Matrix | None,  # [3, 3]; None if each view has its own lens
    size: tuple[int, int] | None,  # (width, height)
    points: tuple[Tensor, Tensor] | None = None,  # [P, 3] of the world, [P, 3] uint8
    notes: Sequence[str] = (),
) -> Scene:
    """A scene of pictures with poses; views without a pose (not finite) are left out and noted.

    Cameras are resized to their pictures (`as_large_as_pictures`).

    Raises:
        SceneError: if no view has a pose, a pose is no rigid motion, or a picture has another shape than its camera.
    """
    views = sorted(views, key=lambda view: natural_key(view.name))
    mended = [mend_pose(view.pose) for view in views]
    posed = [view._replace(pose=pose) for view, (pose, _) in zip(views, mended, strict=True) if pose is not None]
    lost = [view.name for view, (pose, _) in zip(views, mended, strict=True) if pose is None]
    scaled = {view.name: scale for view, (_, scale) in zip(views, mended, strict=True) if scale is not None}
    if not posed:
        raise SceneError(
            f"{folder}: expected poses of finite numbers, none of {len(views)} is; estimate them (`kfgs sfm`)"
        )
    cameras = []
    for view in posed:
        viewmat = np.eye(4)
        viewmat[:3, :3] = view.pose[:3, :3].T  # Camera refuses what is not a rotation
        viewmat[:3, 3] = -view.pose[:3, :3].T @ view.pose[:3, 3]
        try:
            if not np.allclose(view.pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
                raise ValueError(f"pose: expected 0 0 0 1 as its last row, got {view.pose[3].tolist()}")
            own_K, own_size = view.lens or (K, size)
            assert own_K is not None
            assert own_size is not None
            lens = torch.from_numpy(own_K).float(), *own_size
            cameras.append(Camera(torch.from_numpy(viewmat), *lens, view.name))
        except ValueError as error:
            raise SceneError(f"{view.origin}: {error}; correct this pose") from error
    paths = [view.path for view in posed]
    cameras, resized = as_large_as_pictures(cameras, paths)
    said = mending_notes(lost, scaled)
    if points is None:
        points = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
        said.append(NO_POINTS)
    return assemble_scene(cameras, paths, *points, [*notes, *resized, *said])


def assemble_scene(
    cameras: list[Camera], paths: list[Path], points: Tensor, colors: Tensor, notes: Sequence[str]
) -> Scene:
    """A scene of cameras and points [P, 3] in float64 of the world; every view is in the `train` split."""
    cameras, places, far = near_zero(cameras, points)
    splits = {"train": list(range(len(cameras))), "test": []}
    return Scene(cameras, paths, places, colors, splits, (*notes, *far)).with_near()


def near_zero(cameras: list[Camera], points: Tensor) -> tuple[list[Camera], Tensor, list[str]]:
    """Cameras and points [P, 3], read in float64, as a scene has them: float32 from one origin; and a note if it is far."""
    origin = choose_origin(torch.stack([camera.center for camera in cameras]), points) if cameras else ORIGIN
    local = [camera.with_origin(origin).to(torch.float32) for camera in cameras]
    return local, to_local(points, origin), describe_origin(origin, "cameras and points")


def read_points(path: Path) -> tuple[Tensor, Tensor, list[str]]:  # [P, 3] float64, [P, 3] uint8
    """The vertices of a PLY and their colours, grey if it has none; and a note if some are left out as they are not finite.

    Raises:
        ValueError: if it is damaged.
    """
    columns = read_ply(path)
    points = points_from_columns(columns)
    colors = torch.full((len(points), 3), 128, dtype=torch.uint8)
    for i, name in enumerate(("red", "green", "blue")):
        if name in columns and columns[name].dtype.kind in "iu":
            colors[:, i] = torch.from_numpy(columns[name].clip(0, 255).astype("uint8"))
    good = torch.isfinite(points).all(1)
    if good.all():
        return points, colors, []
    note = f"{int((~good).sum())} of {len(points)} points of {path.name} are not finite and were left out"
    return points[good], colors[good], [Repair(note)]


def read_depth(path: Path) -> NDArray[Any]:  # [H, W]
    """The whole numbers of a depth PNG; 0 is unknown.

    Raises:
        SceneError: if it is no picture with one channel, or its numbers are indices of a palette.
    """
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
    depths: Sequence[Path],
    K: Matrix | None,  # [3, 3] of the depth pictures; None: that of each view, resized to its depth picture
    scale: float,
) -> tuple[Tensor, Tensor] | None:  # [P, 3] float64, [P, 3] uint8
    """About `DEPTH_POINTS` points of surfaces with their colours, from `DEPTH_VIEWS` evenly chosen depth pictures.

    Pixels that are masked or transparent in the colour picture give none.

    Args:
        views: the pictures; those without a pose are left out.
        depths: their depth pictures; a missing file is left out.
        K: intrinsics of the depth pictures. None takes those of each view (`lens`), resized: pictures and depth then show
            the same. A colour is that of the same place in the colour picture.
        scale: numbers in the file per world unit.

    Returns:
        The points, or None if there is no depth.
    """
    found = [(v, d) for v, d in zip(views, depths, strict=True) if np.isfinite(v.pose).all() and is_file(d)]
    if not found:
        return None
    chosen = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, DEPTH_VIEWS).round().astype(int))]
    names = [view.name for view, _ in chosen]
    masks = folder_masks(names, picture_folder(names[0], chosen[0][0].path))[0] or [None] * len(chosen)
    points, colors = [], []
    for (view, file), beside in zip(chosen, masks, strict=True):
        depth, image = read_depth(file).astype(np.float64) / scale, read_image(view.path).numpy()
        height, width = depth.shape
        step = max(int(np.sqrt(height * width * len(chosen) / DEPTH_POINTS)), 1)
        own = K if K is not None else _resized(view, (width, height))
        y, x = (axis.reshape(-1) for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        rows, columns = y * image.shape[0] // height, x * image.shape[1] // width  # in the colour picture
        z, mask, alpha = depth[y, x], view.mask or beside, read_alpha(view.path)
        for kept in (
            None if mask is None else read_mask(mask, image.shape[:2]),
            None if alpha is None else alpha > 0.5,
        ):
            z = z if kept is None else z * kept.numpy()[rows, columns]
        rows, columns = rows[z > 0], columns[z > 0]
        x, y, z = x[z > 0], y[z > 0], z[z > 0]
        local = np.stack([(x + 0.5 - own[0, 2]) / own[0, 0] * z, (y + 0.5 - own[1, 2]) / own[1, 1] * z, z], 1)
        points.append(local @ view.pose[:3, :3].T + view.pose[:3, 3])
        colors.append(image[rows, columns])
    places, shades = np.concatenate(points), np.concatenate(colors)
    return torch.from_numpy(places), torch.from_numpy((shades * 255).round().astype(np.uint8))


def points_of_cameras(
    frames: Sequence[tuple[Camera, Path, Path, Path | None]], unit: float
) -> tuple[Tensor, Tensor, list[str]] | None:
    """Points from the depth pictures of cameras without lens, and a note; None if there are none.

    Args:
        frames: camera, picture, depth picture, and mask of the picture.
        unit: world units per step of the depth pictures.

    Raises:
        SceneError: if `unit` is not above 0, or a depth picture is none.
    """
    views = [
        (
            PosedPicture(camera.name, path, torch.linalg.inv(camera.viewmat.double()).numpy(), str(depth), lens, mask),
            depth,
        )
        for camera, path, depth, mask in frames
        if camera.distortion is None and (lens := (camera.K.double().numpy(), (camera.width, camera.height)))
    ]
    if not unit > 0:
        raise SceneError(f"integer_depth_scale: expected a number above 0, got {unit:g}; correct it")
    found = points_from_depth([view for view, _ in views], [depth for _, depth in views], None, 1 / unit)
    return found and (found[0].float(), found[1], [f"points from the depth pictures of {len(views)} views"])


def _resized(view: PosedPicture, size: tuple[int, int]) -> Matrix:  # [3, 3]
    """The intrinsics of a view for a picture of another size (width, height)."""
    assert view.lens is not None
    K, (width, height) = view.lens
    return np.diag([size[0] / width, size[1] / height, 1.0]) @ K
