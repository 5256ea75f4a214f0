"""Remove lens distortion that kfgs cannot represent exactly, with COLMAP's undistorter."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from PIL import Image

from .._files import as_path, atomic_folder, check_output
from .colmap import PANORAMA
from .colmap_model import read_whole_model
from .files import MASKS, SceneError, list_images
from .masks import folder_masks, write_colmap_masks
from .pycolmap_import import quiet_pycolmap, scene_errors, whole_model

WHITE = (
    250  # of 255: what is darker in an undistorted mask took something from a masked pixel; the rest is JPEG's noise
)


def undistort_scene(images: str | Path, model: str | Path, out: str | Path) -> Path:
    """Write a scene with pinhole cameras: `out/images` and `out/sparse/0`, undistorted by pycolmap.

    For lenses that `load_scene` refuses (FOV, THIN_PRISM_FISHEYE, EUCM, ...). `Scene.undistorted` handles all others without
    new files. Pixels that take anything from masked or transparent ones are black in `out/masks`.

    Args:
        images: the distorted images.
        model: their COLMAP model.
        out: the scene folder to write, new or empty.

    Returns:
        `out`.

    Raises:
        FileNotFoundError: if a folder is missing.
        SceneError: if `out` holds files, the model is damaged, or pycolmap fails on it or on the images.
    """
    images, model, out = as_path(images), as_path(model), as_path(out)
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder; expected the images of {model} there")
    check_output("out", out, "a folder")
    if out.exists() and any(out.iterdir()):
        raise SceneError(
            f"{out}: expected a new or empty folder for the undistorted scene, got one in use; choose another"
        )
    if any(camera.model == "EQUIRECTANGULAR" for camera in read_whole_model(model).cameras.values()):
        raise SceneError(f"{model}: expected lenses that can be undistorted, got EQUIRECTANGULAR; {PANORAMA}")
    advice = "check the images, or run `colmap image_undistorter` yourself"
    with (
        whole_model(model) as safe,
        quiet_pycolmap() as pycolmap,
        scene_errors(f"{model}: expected a scene that pycolmap can undistort", advice),
        tempfile.TemporaryDirectory(prefix="kfgs-undistort-") as scratch,
        atomic_folder(out) as folder,
    ):
        straight, names = Path(scratch) / "straight", list_images(images)
        pycolmap.undistort_images(str(straight), str(safe), str(images))
        if not any(file.is_file() for file in (straight / "images").rglob("*")):
            raise SceneError(
                f"{images}: expected the images of {model}, none could be undistorted; give the right folder"
            )
        shutil.copytree(straight / "images", folder / "images")
        shutil.copytree(straight / "sparse", folder / "sparse" / "0")
        masks = folder_masks(names, images)[0] or [None] * len(names)
        photos = {name: (images / name, mask) for name, mask in zip(names, masks, strict=True)}
        taken = Path(scratch) / "taken"
        if write_colmap_masks(taken, photos, ending="") is not None:  # as if they were the photos
            pycolmap.undistort_images(str(Path(scratch) / "masks"), str(safe), str(taken))
            for name in list_images(Path(scratch) / "masks" / "images"):
                with Image.open(Path(scratch) / "masks" / "images" / name) as picture:
                    kept = picture.convert("L").point(lambda grey: 255 * (grey > WHITE))
                place = folder / MASKS / f"{name}.png"
                place.parent.mkdir(parents=True, exist_ok=True)
                kept.save(place)
    return out
