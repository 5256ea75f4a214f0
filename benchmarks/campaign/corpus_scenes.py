"""Scenes in every layout, their pictures in every mode, and lists of splits."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from kfgs.formats.ply import write_ply
from kfgs.toy import ToyConfig, make_toy_room

from .corpus import SEED, Add

ROOM = ToyConfig(
    seed=SEED, train_views=3, test_views=1, size=(16, 20), feature_size=(8, 10), feature_dim=16,
    surface_points=100, sparse_points=20,
)  # fmt: skip
POSE = np.array([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]])


def make(folder: Path, add: Add) -> None:
    """COLMAP binary and text, transforms.json, the data sets' layouts, pictures."""
    room = make_toy_room(folder / "room", ROOM)
    model = [f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")]
    add("scene", room, *model, "split.json", "images/view_000.png", opens=".")
    add("points", room, "surface.npz", "classes.json", opens=".")
    add("labels", room, "labels/view_000.png", opens=".")
    _text_model(room, folder / "text", add)
    _transforms(folder / "nerfstudio", add)
    _data_sets(folder, add)
    _pictures(folder / "pictures", add)


def _text_model(room: Path, place: Path, add: Add) -> None:
    import pycolmap

    shutil.copytree(room / "images", place / "images")
    (place / "sparse/0").mkdir(parents=True)
    pycolmap.Reconstruction(str(room / "sparse/0")).write_text(str(place / "sparse/0"))
    (place / "sparse/0/test.txt").write_text("view_001\n")
    add(
        "scene",
        place,
        *(f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D", "rigs", "frames", "test")),
        opens=".",
    )


def _line(pose: np.ndarray) -> str:
    return " ".join(f"{value:.8e}" for value in pose.reshape(-1)) + "\n"


def _picture(path: Path, mode: str = "RGB", size: tuple[int, int] = (20, 16), **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.arange(size[0] * size[1] * 4, dtype=np.uint32).reshape(size[1], size[0], 4)
    if mode == "I;16":
        picture = Image.fromarray((ramp[..., 0] * 30).astype(np.uint16))
    elif mode == "F":
        picture = Image.fromarray(ramp[..., 0].astype(np.float32))
    else:
        picture = Image.fromarray((ramp[..., :3] % 256).astype(np.uint8)).convert(mode)
    picture.save(path, **options)


def _transforms(place: Path, add: Add) -> None:
    for name in ("a", "b"):
        _picture(place / f"images/{name}.png")
    look = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": look} for name in ("a", "b")]
    top = {"w": 20, "h": 16, "fl_x": 15.0, "fl_y": 15.5, "cx": 10.0, "cy": 8.0, "k1": 0.01, "camera_model": "OPENCV"}
    write_ply(place / "points.ply", {axis: np.arange(5, dtype=np.float32) for axis in "xyz"})
    whole = top | {"ply_file_path": "points.ply", "train_filenames": ["images/a.png"], "frames": frames}
    (place / "transforms.json").write_text(json.dumps(whole))
    add("scene", place, "transforms.json", "points.ply", opens=".")
    blender = place.with_name("blender")
    _picture(blender / "train/r_0.png", "RGBA")
    frame = {"file_path": "./train/r_0", "transform_matrix": look, "rotation": 0.01}
    (blender / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.69, "frames": [frame]}))
    add("scene", blender, "transforms_train.json", opens=".")


def _data_sets(folder: Path, add: Add) -> None:
    slam = folder / "slam/room0"
    for i in range(2):
        _picture(slam / f"results/frame{i:06d}.jpg")
        _picture(slam / f"results/depth{i:06d}.png", "I;16")
    (slam / "traj.txt").write_text(_line(POSE) * 2)
    camera = {"w": 20, "h": 16, "fx": 15.0, "fy": 15.5, "cx": 9.5, "cy": 7.5, "scale": 6553.5}
    (slam.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    add("scene", slam.parent, "room0/traj.txt", "cam_params.json", "room0/results/depth000000.png", opens="room0")
    nerf = folder / "semantic_nerf"
    for i in range(2):
        _picture(nerf / f"rgb/rgb_{i}.png")
        _picture(nerf / f"depth/depth_{i}.png", "I;16")
    (nerf / "traj_w_c.txt").write_text(_line(POSE) * 2)
    add("scene", nerf, "traj_w_c.txt", opens=".")
    scan = folder / "scannet"
    _picture(scan / "color/0.jpg")
    _picture(scan / "depth/0.png", "I;16")
    K = np.array([[15.0, 0, 10, 0], [0, 15.5, 8, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for name, value in (("pose/0", POSE), ("intrinsic/intrinsic_color", K), ("intrinsic/intrinsic_depth", K)):
        (scan / name).parent.mkdir(exist_ok=True)
        np.savetxt(scan / f"{name}.txt", value)
    add("scene", scan, "pose/0.txt", "intrinsic/intrinsic_color.txt", opens=".")


def _pictures(place: Path, add: Add) -> None:
    kinds: list[tuple[str, str, dict[str, object]]] = [
        *((f"{mode.lower().replace(';', '')}.png", mode, {}) for mode in ("RGB", "RGBA", "L", "LA", "P", "1", "I;16")),
        *((f"{mode.lower()}.jpg", mode, {}) for mode in ("RGB", "L", "CMYK")),
        ("progressive.jpg", "RGB", {"progressive": True}),
        *((f"{mode.lower().replace(';', '')}.tiff", mode, {}) for mode in ("RGB", "L", "P", "I;16", "F", "CMYK")),
        *((f"{how}.tiff", "RGB", {"compression": f"tiff_{how}"}) for how in ("lzw", "adobe_deflate")),
        ("lossless.webp", "RGBA", {"lossless": True}),
        ("lossy.webp", "RGB", {}),
        ("a.gif", "P", {}),
        ("a.bmp", "RGB", {}),
    ]
    for name, mode, options in kinds:
        _picture(place / name, mode, **options)
        add("picture", place, name)
    for name in ("l.png", "p.png", "i16.png", "l.tiff"):
        add("label map", place, name)
