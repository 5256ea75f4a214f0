"""From cameras with one pose per picture to a scene, what all readers share: poses as programs write them, and points."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.linalg import inverse_transformation
from numpy.typing import NDArray
from torch import Tensor

from .._files import read_text
from .._notes import Repair
from .._origin import ORIGIN, choose_origin, describe_origin, recounted
from ..cameras.camera import ROTATION_TOLERANCE, Camera, Distortion
from ..cameras.projection import unproject_depth
from ..cameras.resample import fits_aspect
from ..formats.ply import points_from_columns, read_ply, to_number
from . import files
from .files import MAX_NUMBER, SceneError, natural_key, picture_size, some
from .scene import Scene

NO_POINTS = "no points: `kfgs fit` and `kfgs color` triangulate some from the poses before they train"
MILLIMETRE = 1e-3  # metres: the step of most depth pictures
DEPTH_VIEWS = 25  # depth pictures that are read: enough to see a room from all sides, a second to decode
DEPTH_POINTS = 100_000  # points from all of them: what structure from motion gives for a room, and more
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

    It becomes None if it has numbers that are not finite or plausible, or no rotation at all; what is far from a rotation
    stays, and `Camera` refuses it. The second value is the scale that was removed, None if the pose is unchanged.
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


def _as_large_as_pictures(cameras: Sequence[Camera], paths: Sequence[Path]) -> tuple[list[Camera], list[str]]:
    """Each camera in the size of its own picture, which may be a resized copy (`images_4`), and a note if some are."""
    fitting = []
    for camera, path in zip(cameras, paths, strict=True):
        width, height = picture_size(path)
        if not fits_aspect((height, width), camera.size):
            expected = f"a picture in the shape of {camera.width}x{camera.height} pixels, as its camera says"
            advice = "replace it by the picture that the camera was made for, or by a copy at another size"
            raise SceneError(f"{path}: expected {expected}, got {width}x{height}; {advice}")
        fitting.append(camera if (height, width) == camera.size else camera.resized(height, width))
    other = [i for i, camera in enumerate(cameras) if camera is not fitting[i]]
    if not other:
        return fitting, []
    where = files.picture_folder(cameras[0].name, paths[0]).name
    ratio = cameras[other[0]].width / fitting[other[0]].width
    how = f"{paths[other[0]].name} is {max(ratio, 1 / ratio):.3g} times {'smaller' if ratio > 1 else 'larger'}"
    count = f"{len(other)} of {len(paths)} pictures have other sizes than the model says"
    return fitting, [f"{where}: {count} ({how}); cameras were resized to them"]


def scene_of_poses(
    path: Path,
    views: Sequence[PosedPicture],
    points: tuple[Tensor, Tensor] | None = None,  # [P, 3] of the world, [P, 3] uint8
    notes: Sequence[str] = (),
    *,
    pictures: bool = True,
) -> Scene:
    """A scene of pictures with poses, all in the `train` split; views without a pose (not finite) are left out and noted.

    Cameras get the size of their pictures, whose files need not be there without `pictures`.
    """
    cameras, kept, lost, scaled = list[Camera](), list[PosedPicture](), list[str](), dict[str, float]()
    for view in sorted(views, key=lambda view: natural_key(view.name)):
        pose, scale = mend_pose(view.pose)
        if pose is None:
            lost.append(view.name)
            continue
        if scale is not None:
            scaled[view.name] = scale
        with files.scene_error(f"{view.origin}: ", "; correct this pose"):
            if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
                row = "0 0 0 1 as its last row (if that is its last column, transpose it)"
                raise ValueError(f"pose: expected {row}, got {pose[3].tolist()}")
            viewmat = inverse_transformation(torch.from_numpy(pose)[None])[0]
            cameras.append(Camera(viewmat, torch.from_numpy(view.K).float(), *view.size, view.name, view.distortion))
        kept.append(view)
    if not cameras:
        got = f"none in {len(views)} ({some(lost, 3)}); estimate them (`kfgs sfm`)"
        raise SceneError(f"{path}: expected poses and lenses of finite numbers, got {got}")
    paths, masks, told = [view.path for view in kept], [view.mask for view in kept], list(notes)
    if pictures:
        cameras, resized = _as_large_as_pictures(cameras, paths)
        told += resized
    told += [NO_POINTS] if points is None else []
    if lost:
        told.append(Repair(f"{len(lost)} views have no pose or lens of finite numbers and were left out: {some(lost)}"))
    if scaled:
        low, high = f"{min(scaled.values()):.6g}", f"{max(scaled.values()):.6g}"
        sizes = f"({low if low == high else f'{low} to {high}'}) or a rounded rotation"
        told.append(Repair(f"{len(scaled)} poses have a scale {sizes}, which was removed: {some(list(scaled))}"))
    places, colors = points or (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    origin = choose_origin(torch.stack([camera.center for camera in cameras]), places)
    local = [camera.with_origin(origin).to(torch.float32) for camera in cameras]
    told += describe_origin(origin, "cameras and points")
    splits = {"train": list(range(len(local))), "test": []}
    with files.scene_error(f"{path}: "):  # names that do not differ
        scene = Scene(local, paths, recounted(places, ORIGIN, origin).float(), colors, splits, tuple(told))
    return replace(scene.with_near(), masks=masks if any(masks) else None)


def read_numbers(path: Path, expected: str, columns: int, rows: int | None = None) -> Matrix:  # [rows, columns]
    """The numbers of a text file, row by row; `rows` None: at least one."""
    with files.scene_error(f"{path}: expected {expected}, got something else (", "); copy or export it again"):
        lines = read_text(path, expected).splitlines()
        numbers = [[to_number(word) for word in line.replace(",", " ").split()] for line in lines if line.strip()]
        if {len(row) for row in numbers} != {columns} or rows not in (None, len(numbers)):
            raise ValueError(f"{len(numbers)} rows of {sorted({len(row) for row in numbers})} numbers")
    return np.array(numbers, dtype=np.float64)


def read_points(path: Path, advice: str) -> tuple[Tensor, Tensor, list[str]]:  # [P, 3] float64, [P, 3] uint8
    """The vertices of a PLY and their colours, grey if it has none; and a note if some are left out as they are not finite."""
    with files.scene_error(after=f"; {advice}"):
        columns = read_ply(path)
        points = points_from_columns(path, columns)
    colors = torch.full((len(points), 3), 128, dtype=torch.uint8)
    for i, name in enumerate(("red", "green", "blue")):
        if name in columns and columns[name].dtype.kind in "iu":
            colors[:, i] = torch.from_numpy(columns[name].clip(0, 255).astype("uint8"))
    good = torch.isfinite(points).all(1)
    note = f"{int((~good).sum())} of {len(points)} points of {path.name} are not finite and were left out"
    return points[good], colors[good], [] if good.all() else [Repair(note)]


def read_depth(path: Path) -> NDArray[Any]:  # [H, W]
    """The whole numbers of a depth PNG; 0 is unknown."""
    with files.open_picture(path, "a depth PNG", "copy it again") as picture:
        depth, mode = np.asarray(picture), picture.mode
    if depth.ndim != 2 or mode == "P":
        got = "colours of a palette" if mode == "P" else str(depth.shape)
        raise SceneError(f"{path}: expected a depth PNG of one channel, got {got}; is this a picture for people?")
    return depth


def points_from_depth(
    views: Sequence[PosedPicture],
    unit: float = MILLIMETRE,
    K: Matrix | None = None,  # [3, 3]
) -> tuple[Tensor, Tensor] | None:  # [P, 3] float64, [P, 3] uint8
    """About `DEPTH_POINTS` points of surfaces with their colours, from `DEPTH_VIEWS` evenly chosen depth pictures.

    Pixels that are masked or transparent in the colour picture give none. Views without a pose, with a lens, or without a depth
    picture are left out; None if that are all. `unit` is world units per step. `K` are the intrinsics of the depth pictures;
    None takes those of each view, resized: picture and depth then show the same. A colour is that of the same place there.
    """
    usable = [v for v in views if v.depth is not None and os.path.isfile(v.depth) and v.distortion is None]
    pairs = [(view, pose) for view in usable if (pose := mend_pose(view.pose)[0]) is not None]
    if not pairs:
        return None
    chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, DEPTH_VIEWS).round().astype(int))]
    names = [view.name for view, _ in chosen]
    masks = files.folder_masks(names, files.picture_folder(names[0], chosen[0][0].path))[0] or [None] * len(chosen)
    points, colors = [], []
    for (view, pose), folder_mask in zip(chosen, masks, strict=True):
        assert view.depth is not None
        depth, image = read_depth(view.depth).astype(np.float64) * unit, files.read_image(view.path).numpy()
        height, width = depth.shape
        step = max(int(np.sqrt(height * width * len(chosen) / DEPTH_POINTS)), 1)
        own = np.diag([width / view.size[0], height / view.size[1], 1.0]) @ view.K if K is None else K
        y, x = (axis.reshape(-1) for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        rows, columns = y * image.shape[0] // height, x * image.shape[1] // width  # in the colour picture
        mask, alpha, known = view.mask or folder_mask, files.read_alpha(view.path), depth[y, x] > 0
        if mask is not None:
            known &= files.read_mask(mask, image.shape[:2]).numpy()[rows, columns]
        if alpha is not None:
            known &= (alpha > 0.5).numpy()[rows, columns]
        camera = Camera(torch.eye(4), torch.from_numpy(own), width, height)
        local = unproject_depth(camera, torch.from_numpy(depth)).numpy()[y[known], x[known]]
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        colors.append(image[rows[known], columns[known]])
    shades = torch.from_numpy((np.concatenate(colors) * 255).round().astype(np.uint8))
    return torch.from_numpy(np.concatenate(points)), shades
