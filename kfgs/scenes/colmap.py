"""COLMAP models to scenes: pycolmap reads the files once `check_model` has found them whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras.camera import Camera, Distortion
from ._pycolmap import quiet_pycolmap, wrapped
from .colmap_check import check_model
from .errors import SceneError
from .files import list_images
from .names import natural_key, some
from .scene import Scene

# COLMAP's model: (our lens, its number of coefficients). COLMAP's own order after the intrinsics is ours in each case:
# brown_conrady k1 k2 p1 p2 [k3 k4 k5 k6], kannala_brandt k1 k2 k3 k4; what COLMAP leaves out at the end is zero.
_LENSES: dict[str, tuple[str | None, int]] = {
    "SIMPLE_PINHOLE": (None, 0),
    "PINHOLE": (None, 0),
    "SIMPLE_RADIAL": ("brown_conrady", 4),
    "RADIAL": ("brown_conrady", 4),
    "OPENCV": ("brown_conrady", 4),
    "FULL_OPENCV": ("brown_conrady", 8),
    "OPENCV_FISHEYE": ("kannala_brandt", 4),
    "SIMPLE_RADIAL_FISHEYE": ("kannala_brandt", 4),
    "RADIAL_FISHEYE": ("kannala_brandt", 4),
    "SIMPLE_FISHEYE": ("kannala_brandt", 4),
    "FISHEYE": ("kannala_brandt", 4),
}
_ONE_FOCAL_LENGTH = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
)
SUPPORTED_MODELS = tuple(_LENSES)


def convert_intrinsics(model: str, params: list[float]) -> tuple[torch.Tensor, Distortion | None]:
    """K [3, 3] float64 and the lens of a COLMAP camera.

    All models of kfgs are exact: SIMPLE_RADIAL and RADIAL are Brown-Conrady with zeros behind k1 (k2), the FISHEYE
    family without thin prisms is Kannala-Brandt with zeros behind. A perspective lens with all coefficients zero is a
    pinhole.

    Args:
        model: COLMAP's name.
        params: its parameters, in COLMAP's order.

    Raises:
        SceneError: if the model has no exact form here (FOV, THIN_PRISM_FISHEYE, EUCM, ...).
    """
    if model not in _LENSES:
        raise SceneError(
            f"camera: expected one of the COLMAP models {', '.join(_LENSES)}, got {model}; undistort the images first: "
            "`kfgs.scenes.undistort_scene(images, model, out)` or `colmap image_undistorter`"
        )
    kind, length = _LENSES[model]
    if model in _ONE_FOCAL_LENGTH:
        params = params[:1] + params
    fx, fy, cx, cy, *lens = params
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if kind is None or (kind == "brown_conrady" and not any(lens)):
        return K, None
    coefficients = tuple(float(k) for k in lens) + (0.0,) * (length - len(lens))
    return K, Distortion(kind, coefficients)  # type: ignore[arg-type]  # the table holds only these two names


def read_reconstruction(path: str | Path) -> Any:
    """Check a COLMAP model and read it: a `pycolmap.Reconstruction`.

    Raises:
        FileNotFoundError: if there is no such folder.
        SceneError: if the model is damaged or incomplete, or pycolmap cannot make sense of it.
        ImportError: if pycolmap is not installed.
    """
    check_model(path)
    advice = "write the model again with COLMAP"
    with quiet_pycolmap() as pycolmap, wrapped(f"{path}: expected a COLMAP model that pycolmap can read", advice):
        return pycolmap.Reconstruction(str(path))


def load_colmap(path: str | Path, images: str | Path) -> Scene:
    """Read a COLMAP model and pair it with its image files.

    Args:
        path: the model's folder (cameras, images, points3D; binary or text; with or without rigs and frames).
        images: the folder that the model's image names are relative to.

    Returns:
        The scene in natural order of names, points in order of their COLMAP ids, every view in the `train` split.
        `notes` say which images have no pose or no file, and were left out.

    Raises:
        FileNotFoundError: if a folder is missing.
        SceneError: if the model is damaged, a lens has no exact form in kfgs, or no image has both a pose and a file.
    """
    path, folder = Path(path), Path(images)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; expected the images of {path} there")
    model = read_reconstruction(path)
    with wrapped(f"{path}: expected a COLMAP model with poses", "write the model again with COLMAP"):
        views = sorted(model.images.values(), key=lambda image: natural_key(image.name))
        poses = {image.name: pose for image in views if (pose := _pose(image)) is not None}
        posed = [image for image in views if image.name in poses]
        cameras = {camera_id: _intrinsics(path, camera_id, model.cameras[camera_id]) for camera_id in model.cameras}
        points, colors = _points(model)
        paths = [folder / image.name for image in posed]
        found = [i for i, file in enumerate(paths) if file.is_file()]
        matched = [_camera(posed[i].name, poses[posed[i].name], *cameras[posed[i].camera_id]) for i in found]
    lost = [image.name for image in views if image.name not in poses]
    missing = [posed[i].name for i in sorted(set(range(len(posed))) - set(found))]
    if not found:
        raise SceneError(
            f"{folder}: expected the images of {path}, none of its {len(posed)} posed images "
            f"({some([image.name for image in posed], 3)}) is there; give the right image folder"
        )
    notes = [f"{len(lost)} images of the model have no pose and were left out: {some(lost)}"] if lost else []
    if missing:
        notes.append(f"{len(missing)} of {len(posed)} posed images have no file in {folder}: {some(missing)}")
    notes += _unposed_files(folder, {image.name for image in views})
    if len(points) == 0:
        notes.append("the model has no points: give the field points of your own to start from")
    splits = {"train": list(range(len(found))), "test": []}
    return Scene(matched, [paths[i] for i in found], points, colors, splits, tuple(notes)).with_near()


def _intrinsics(path: Path, camera_id: int, camera: Any) -> tuple[torch.Tensor, Distortion | None, int, int]:
    try:
        K, distortion = convert_intrinsics(camera.model_name, [float(p) for p in camera.params])
    except ValueError as error:
        raise SceneError(f"{path}, camera {camera_id}: {error}") from error
    return K, distortion, int(camera.width), int(camera.height)


def _pose(image: Any) -> NDArray[np.float64] | None:
    """World to camera [3, 4], or None where the frame, or the camera within its rig, has not been placed."""
    if not image.has_pose:
        return None
    try:
        return np.array(image.cam_from_world().matrix())
    except RuntimeError:  # "bad optional access": has_pose looks at the frame only
        return None


def _camera(
    name: str, pose: NDArray[np.float64], K: torch.Tensor, distortion: Distortion | None, width: int, height: int
) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(pose)
    return Camera(viewmat.float(), K.float(), width, height, name, distortion)


def _points(model: Any) -> tuple[torch.Tensor, torch.Tensor]:
    table: Mapping[int, Any] = model.points3D
    ordered = [table[i] for i in sorted(table)]
    xyz = np.array([point.xyz for point in ordered], dtype=np.float32).reshape(-1, 3)
    rgb = np.array([point.color for point in ordered], dtype=np.uint8).reshape(-1, 3)
    return torch.from_numpy(xyz), torch.from_numpy(rgb)


def _unposed_files(folder: Path, names: set[str]) -> list[str]:
    extra = [name for name in list_images(folder) if name not in names]
    return [f"{len(extra)} image files in {folder} have no pose in the model: {some(extra)}"] if extra else []
