"""Make a scene from a COLMAP model and its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from .._files import Names
from ..cameras.camera import Camera, Distortion, DistortionModel
from .colmap_model import CAMERA_MODELS, ColmapImage, ColmapModel, read_model
from .files import SceneError, find_pictures, list_images, natural_key, some
from .posed import NO_POINTS, NOTHING, as_large_as_pictures, assemble_scene, mending_notes
from .scene import Scene

# COLMAP's model: (our lens, its number of coefficients). COLMAP's own order after the intrinsics is ours in each case:
# brown_conrady k1 k2 p1 p2 [k3 k4 k5 k6], kannala_brandt k1 k2 k3 k4; what COLMAP leaves out at the end is zero.
LENSES: dict[str, tuple[DistortionModel | None, int]] = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE"), (None, 0)),
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("brown_conrady", 4)),
    "FULL_OPENCV": ("brown_conrady", 8),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), ("kannala_brandt", 4)),
    **dict.fromkeys(("SIMPLE_FISHEYE", "FISHEYE"), ("kannala_brandt", 4)),
}
PANORAMA = "cut perspective views out of the panoramas, and give these with their poses"  # no undistorter flattens them


def convert_intrinsics(model: str, params: Sequence[float]) -> tuple[torch.Tensor, Distortion | None]:
    """K [3, 3] float64 and the lens of a COLMAP camera; a perspective lens with all coefficients zero is a pinhole."""
    if model not in LENSES:
        advice = "undistort the images first (`colmap image_undistorter`)"
        raise SceneError(
            f"camera: expected one of the COLMAP models {', '.join(LENSES)}, got {model}; "
            f"{PANORAMA if model == 'EQUIRECTANGULAR' else advice}"
        )
    kind, length = LENSES[model]
    fx, fy, cx, cy, *lens = [params[0], *params] if CAMERA_MODELS[model].startswith("f ") else params
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if kind is None or (kind == "brown_conrady" and not any(lens)):
        return K, None
    return K, Distortion(kind, tuple(float(k) for k in lens) + (0.0,) * (length - len(lens)))


def load_colmap(path: Path, images: Path) -> Scene:
    """Read a COLMAP model and pair it with its image files in a folder, to whose sizes the cameras are resized."""
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder; expected the images of {path} there")
    model = read_model(path)
    views, notes = _posed(model)
    files, there = find_pictures(images, [view.name for view in views]), list_images(images)
    names = {name: file.relative_to(images).as_posix() for name, file in files.items()}
    found = [replace(view, name=names[view.name]) for view in views if view.name in names]
    missing = [view.name for view in views if view.name not in names]
    if not found:
        raise SceneError(
            f"{images}: expected the images of {path}, none of its {len(views)} posed images ({some(missing, 3)}) "
            f"is there; give the right image folder ({Names(there).advice(missing[0]) if missing else notes[0]})"
        )
    found.sort(key=lambda view: natural_key(view.name))
    paths = [images / view.name for view in found]
    cameras, resized = as_large_as_pictures(_cameras(path, model, found), paths, images)
    notes += resized
    other = [f"{name} is {file}" for name, file in names.items() if name != file]
    if other:
        notes.append(f"{len(other)} images of {images} were found by a name that is spelled otherwise: {some(other)}")
    known = {view.name for view in (*found, *model.images.values())}
    extra = [name for name in there if name not in known]
    if missing:
        near = f" ({Names(extra).advice(missing[0])})" if extra else ""
        notes.append(f"{len(missing)} of {len(views)} posed images have no file in {images}: {some(missing)}{near}")
    if extra:
        notes.append(f"{len(extra)} image files in {images} have no pose in the model: {some(extra)}")
    if len(model.points) == 0:
        notes.append(NO_POINTS)
    return assemble_scene(cameras, paths, torch.from_numpy(model.points), torch.from_numpy(model.colors), notes)


def colmap_cameras(path: Path) -> Scene:
    """The views of a model's images with a pose, whose image files need not be there, without points."""
    model = read_model(path)
    views, notes = _posed(model)
    cameras = _cameras(path, model, [replace(view, name=view.name.replace("\\", "/")) for view in views])
    if not cameras:
        raise SceneError(f"{path}: expected cameras with poses, got none; run COLMAP again (`kfgs sfm`)")
    return assemble_scene(cameras, [Path(camera.name) for camera in cameras], *NOTHING, notes)


def _posed(model: ColmapModel) -> tuple[list[ColmapImage], list[str]]:
    """The images with a pose, in natural order of names, and notes about the others and all that is broken."""
    views = sorted(model.images.values(), key=lambda image: natural_key(image.name))
    lost = [image.name for image in views if image.pose is None]
    return [image for image in views if image.pose is not None], [*mending_notes(lost, {}), *model.notes]


def _cameras(path: Path, model: ColmapModel, images: list[ColmapImage]) -> list[Camera]:
    cameras = []
    for image in images:
        lens = model.cameras[image.camera_id]
        try:
            K, distortion = convert_intrinsics(lens.model, lens.params)
            pose = torch.from_numpy(image.pose)
            cameras.append(Camera(pose, K.float(), lens.width, lens.height, image.name, distortion))
        except ValueError as error:
            raise SceneError(f"{path}, image {image.name}, camera {image.camera_id}: {error}") from error
    return cameras
