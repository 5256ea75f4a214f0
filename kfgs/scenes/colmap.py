"""Make a scene from a COLMAP model and its images; and pycolmap, imported late, without its log.

Pillow's C module must be loaded **before** pycolmap. In the other order (pycolmap 4.2.1, Pillow 13.0.0, Linux wheels)
the first PNG that Pillow writes corrupts the heap and aborts the process. `files`, which is imported here, loads Pillow.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.linalg import inverse_transformation

from .._files import Names
from ..cameras.camera import Distortion, DistortionModel
from .colmap_model import CAMERA_MODELS, ColmapModel, read_model
from .files import SceneError, find_pictures, list_images, natural_key, scene_error, some
from .posed import Matrix, PosedPicture, scene_of_poses
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
# Exceptions of pycolmap for unusable input (a failed CHECK is a ValueError, a missing id an IndexError).
FAILURES = (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OSError)
PANORAMA = "cut perspective views out of the panoramas, and give these with their poses"  # no undistorter flattens them


def convert_intrinsics(model: str, params: Sequence[float]) -> tuple[Matrix, Distortion | None]:
    """K [3, 3] float64 and the lens of a COLMAP camera; a perspective lens with all coefficients zero is a pinhole."""
    if model not in LENSES:
        advice = PANORAMA if model == "EQUIRECTANGULAR" else "undistort the images first (`colmap image_undistorter`)"
        raise SceneError(f"camera: expected one of the COLMAP models {', '.join(LENSES)}, got {model}; {advice}")
    kind, length = LENSES[model]
    fx, fy, cx, cy, *lens = [params[0], *params] if CAMERA_MODELS[model].startswith("f ") else params
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
    if kind is None or (kind == "brown_conrady" and not any(lens)):
        return K, None
    return K, Distortion(kind, tuple(float(k) for k in lens) + (0.0,) * (length - len(lens)))


def load_colmap(path: Path, images: Path | None) -> Scene:
    """Read a COLMAP model and pair it with its image files in a folder, to whose sizes the cameras are resized.

    Without a folder, the views alone, of all images with a pose, and no points.
    """
    if images is not None and not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder; expected the images of {path} there")
    model = read_model(path)
    if images is None:
        views = [replace(view, name=view.name.replace("\\", "/")) for view in _views(path, model)]
        return scene_of_poses(path, views, notes=model.notes, pictures=False)
    names = sorted((image.name for image in model.images.values() if image.pose is not None), key=natural_key)
    files = find_pictures(images, names)
    views, there = _views(path, model, files), list_images(images)
    missing = [name for name in names if name not in files]
    if not files:
        lost = f"none of its {len(names)} posed images ({some(missing, 3)}) is there"
        near = Names(there).advice(missing[0]) if missing else f"{len(views)} images have no pose or no usable lens"
        raise SceneError(f"{images}: expected the images of {path}, {lost}; give the right image folder ({near})")
    given = {name: file.relative_to(images).as_posix() for name, file in files.items()}
    extra = sorted(set(there) - set(given.values()) - {view.name for view in views}, key=natural_key)
    other = [f"{name} is {file}" for name, file in given.items() if name != file]
    near = f" ({Names(extra).advice(missing[0])})" if missing and extra else ""
    told = {
        f"{len(other)} images of {images} were found by a name that is spelled otherwise: {some(other)}": other,
        f"{len(missing)} of {len(names)} posed images have no file in {images}: {some(missing)}{near}": missing,
        f"{len(extra)} image files in {images} have no pose in the model: {some(extra)}": extra,
    }
    for view in views:
        view.name = given.get(view.name, view.name)
        view.path = images / view.name
    points = (torch.from_numpy(model.points), torch.from_numpy(model.colors)) if len(model.points) else None
    notes = [*model.notes, *(note for note, lost_names in told.items() if lost_names)]
    return scene_of_poses(path, views, points, notes)


def _views(path: Path, model: ColmapModel, files: Container[str] | None = None) -> list[PosedPicture]:
    """The images of a model in natural order of their names; those with a pose that are not in `files` are left out."""
    views = []
    for image in sorted(model.images.values(), key=lambda image: natural_key(image.name)):
        if image.pose is not None and files is not None and image.name not in files:
            continue
        lens, where = model.cameras[image.camera_id], f"{path}, image {image.name}, camera {image.camera_id}"
        view = PosedPicture(image.name, Path(image.name), None, where, size=(lens.width, lens.height))
        if image.pose is not None:
            with scene_error(f"{where}: "):
                view.K, view.distortion = convert_intrinsics(lens.model, lens.params)
            view.pose = inverse_transformation(torch.from_numpy(image.pose)[None])[0].numpy()
        views.append(view)
    return views


def import_pycolmap() -> Any:
    """The module, loaded at the first call. Raises an ImportError if it is not installed, with the install line."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        advice = f"run `pip install 'pycolmap>=4.0'` ({error})"
        raise ImportError(f"pycolmap: needed to estimate cameras, but it cannot be imported; {advice}") from error
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)  # pycolmap's log library would print a stack
    return pycolmap


@contextmanager
def quiet_pycolmap(what: str = "pycolmap: expected input that it can use", advice: str = "check it") -> Iterator[Any]:
    """Pycolmap without its log. Its failures become a SceneError that begins with `what` and ends with `advice`."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3  # fatal
    try:
        yield pycolmap
    except SceneError:
        raise
    except FAILURES as error:
        lines = str(error).strip().splitlines()
        raise SceneError(f"{what} ({type(error).__name__}: {lines[0] if lines else 'no text'}); {advice}") from error
    finally:
        pycolmap.logging.minloglevel = before
