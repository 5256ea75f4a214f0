"""Find the ground truth of a scene by its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .._arrays import read_arrays, reading
from .._files import as_path, read_json
from ..scenes.files import list_images
from ..scenes.load import is_scene
from .label_pictures import load_labels
from .replica import load_replica_points, load_semantic_nerf_labels
from .scannet import load_scannet_points
from .truth import LabelTruth, PointTruth

Place = tuple[str, Callable[[Path], Any]]
"""A pattern of files in a folder, and the reader of a folder that has some."""


def find_labels(path: str | Path) -> LabelTruth:
    """The label pictures of a scene, a folder of them, or a COCO JSON.

    Looked for in this order: `labels_scored/`, `labels/`, `semantic_class/`, `annotations.json`, PNGs in the folder itself.
    If there are none, a FileNotFoundError lists these.
    """
    places: list[Place] = [
        ("labels_scored/*.png", lambda at: load_labels(at / "labels_scored")),
        ("labels/*.png", lambda at: load_labels(at / "labels")),
        ("semantic_class/*.png", load_semantic_nerf_labels),
        ("annotations.json", lambda at: load_labels(at / "annotations.json")),
        ("*.png", load_labels),
    ]
    return read_first(as_path(path), places, "label pictures", load_labels)


def find_points(path: str | Path) -> PointTruth:
    """The labelled points of a scene: of Replica, of ScanNet, or of kfgs's toy room; or the file of a mesh.

    If there are none, a FileNotFoundError lists the files.
    """
    path = as_path(path)
    places: list[Place] = [
        ("habitat/mesh_semantic.ply", load_replica_points),
        ("mesh_semantic.ply", load_replica_points),
        ("*_vh_clean_2.labels.ply", load_scannet_points),
        ("surface.npz", _read_surface),
    ]
    as_file = load_scannet_points if path.name.endswith(".labels.ply") else load_replica_points
    return read_first(path, places, "labelled points", as_file)


def read_first(path: Path, places: list[Place], what: str, as_file: Callable[[Path], Any]) -> Any:
    """Read with the first reader whose files are there."""
    if path.is_file():
        return as_file(path)
    for pattern, read in places:
        if path.is_dir() and _has(path, pattern):
            return read(path)
    tried = ", ".join(pattern for pattern, _ in places)
    problem = "found none" if path.is_dir() else "which is not a folder"
    raise FileNotFoundError(f"truth: expected {what} in {path} ({tried}), {problem}; name the folder that has them")


def _has(folder: Path, pattern: str) -> bool:
    """Whether a folder has files of a pattern. Of a folder of pictures those below count too, with any case of the ending."""
    below, _, name = pattern.rpartition("/")
    if name == "*.png" and "*" not in below and (below or not is_scene(folder)):
        return any(file.lower().endswith(".png") for file in list_images(folder / below))
    return next(folder.glob(pattern), None) is not None


def _read_surface(folder: Path) -> PointTruth:
    """The labelled surfaces of a toy room: `surface.npz` and `classes.json`, as `make_toy_room` writes them."""
    file = folder / "surface.npz"
    expected, advice = "the arrays 'points' and 'labels', points of all surfaces", "make the room again"
    arrays = read_arrays(file, expected, advice)
    names = read_json(folder / "classes.json")
    with reading(file, expected, advice):
        points, labels = arrays["points"], arrays["labels"].astype(np.int64)
        return PointTruth(torch.from_numpy(points), torch.from_numpy(labels), dict(enumerate(names)))
