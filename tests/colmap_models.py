"""Tiny COLMAP models written by pycolmap itself (both layouts) or as text by hand, for the tests of kfgs.scenes."""

from pathlib import Path

import numpy as np
import torch
from kornia.io import write_image

from kfgs.scenes.colmap import import_pycolmap, quiet_pycolmap

pycolmap = import_pycolmap()

CAMERAS = "1 PINHOLE 64 48 50 55 31 25\n"
IMAGES = "1 1 0 0 0 0 0 0 1 a.png\n1 2 7 3 4 -1\n2 0.6 0.8 0 0 1 2 3 1 b.png\n5 6 7\n"
POINTS = "7 1 2 3 10 20 30 0.5 1 0 2 0\n"


def write_text_model(folder: Path, **tables: str) -> Path:
    """The model above as .txt files, some tables exchanged (`rigs`, `frames` are written only when given)."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in ({"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS} | tables).items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def build_model(names: list[str], *, model: str = "PINHOLE", params: list[float] | None = None) -> object:
    """A pycolmap.Reconstruction of 64x48 images that see five points."""
    rec = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=64, height=48, params=params or [50, 55, 31, 25], camera_id=1)
    rec.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(names, 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i)
        image.points2D = [pycolmap.Point2D(np.array([3.0 + k, 4.0 * i])) for k in range(6)]
        half = 0.1 * i
        turn = pycolmap.Rotation3d(np.array([np.sin(half), 0, 0, np.cos(half)]))  # xyzw
        rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, np.array([0.5 * i, -0.25, 2.0])))
    for k in range(5):
        track = pycolmap.Track()
        for i in range(1, len(names) + 1):
            track.add_element(i, k)
        rec.add_point3D(np.array([k, 0.5 * k, 4.0]), track, np.array([10 * k, 20, 30], np.uint8))
    return rec


def write_model(folder: Path, names: list[str], *, text: bool = False, rigs: bool = True, **options: object) -> Path:
    """Write `build_model` with pycolmap; without `rigs` it is the old three-file layout."""
    folder.mkdir(parents=True, exist_ok=True)
    rec = build_model(names, **options)
    rec.write_text(str(folder)) if text else rec.write(str(folder))
    if not rigs:
        for name in ("rigs", "frames"):
            (folder / f"{name}.{'txt' if text else 'bin'}").unlink()
    return folder


def read_with_pycolmap(folder: Path) -> object:
    """A pycolmap.Reconstruction of a model on disk."""
    with quiet_pycolmap():
        return pycolmap.Reconstruction(str(folder))


def write_picture(path: Path, height: int = 48, width: int = 64) -> Path:
    """A PNG whose red grows with x and green with y."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = torch.stack([columns * 3, rows * 4, torch.full_like(rows, 9)]).clamp(max=255).to(torch.uint8)
    write_image(str(path), image)
    return path
