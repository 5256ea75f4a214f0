"""Find the ground truth of a scene by its files, for each kind of truth that protocols take."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ..._files import as_path
from ..truth import LabelTruth, MaskTruth, PointTruth
from .coco import load_coco_masks
from .label_folder import load_labels
from .legaussians import load_legaussians
from .lerf_ovs import load_lerf_ovs
from .ovs3d import load_3dovs
from .replica import load_replica_points, load_semantic_nerf_labels
from .scannet import load_scannet_points
from .scenesplat import load_scenesplat_points
from .surface_points import load_surface_points

Reader = Callable[[Path], Any]


def find_labels(path: str | Path) -> LabelTruth:
    """The label pictures of a scene, a folder of them, or a COCO JSON.

    Looked for, in this order: `labels_scored/`, `labels/`, `semantic_class/`, `annotations.json`, and PNGs in the folder itself.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if a file is damaged.
    """
    path = as_path(path)
    places: list[tuple[str, Reader]] = [
        ("labels_scored/*.png", lambda at: load_labels(at / "labels_scored")),
        ("labels/*.png", lambda at: load_labels(at / "labels")),
        ("semantic_class/*.png", load_semantic_nerf_labels),
        ("annotations.json", lambda at: load_labels(at / "annotations.json")),
        ("*.png", load_labels),
    ]
    return _first(path, places, "label pictures", load_labels)


def find_masks(path: str | Path) -> MaskTruth:
    """The masks of a scene: of 3D-OVS, of LEGaussians, of LERF-OVS, or in a COCO JSON.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if a file is damaged.
    """
    path = as_path(path)
    places: list[tuple[str, Reader]] = [
        ("segmentations/classes.txt", load_3dovs),
        ("classes.txt", load_3dovs),
        ("segmentations/*/*.png", load_legaussians),
        (f"../label/{path.name}/*.json", load_lerf_ovs),
        ("label/**/*.json", load_lerf_ovs),
        ("annotations.json", lambda at: load_coco_masks(at / "annotations.json")),
        ("*.json", load_lerf_ovs),
        ("*/*.png", load_legaussians),
    ]
    return _first(path, places, "masks", load_coco_masks, last=2 if _is_scene(path) else 0)


def find_points(path: str | Path, benchmark: str | None = None) -> PointTruth:
    """The labelled points of a scene: of Replica, of ScanNet, of SceneSplat-Bench, or of kfgs's toy room.

    Args:
        path: the scene's folder, or the file of its labels.
        benchmark: of SceneSplat-Bench, whose classes the labels are, see `load_scenesplat_points`; no other data set needs it.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if a file is damaged, or the classes of SceneSplat's labels are unknown.
    """
    path = as_path(path)
    places: list[tuple[str, Reader]] = [
        ("habitat/mesh_semantic.ply", load_replica_points),
        ("mesh_semantic.ply", load_replica_points),
        ("*_vh_clean_2.labels.ply", load_scannet_points),
        ("coord.npy", partial(load_scenesplat_points, benchmark=benchmark)),
        ("surface.npz", load_surface_points),
    ]
    as_file: Reader = load_scannet_points if path.name.endswith(".labels.ply") else load_replica_points
    if path.suffix == ".npy":
        as_file = partial(load_scenesplat_points, benchmark=benchmark)
    return _first(path, places, "labelled points", as_file)


def _first(path: Path, places: list[tuple[str, Reader]], what: str, as_file: Reader, last: int = 0) -> Any:
    """Read with the first reader whose files are there; the last ones are for folders of truth alone."""
    if path.is_file():
        return as_file(path)
    for pattern, read in places[: len(places) - last]:
        above, found = (path.parent, pattern[3:]) if pattern.startswith("../") else (path, pattern)
        if path.is_dir() and next(above.glob(found), None) is not None:
            return read(path)
    tried = ", ".join(dict.fromkeys(pattern for pattern, _ in places))
    problem = "found none" if path.is_dir() else "which is no such folder"
    raise FileNotFoundError(f"truth: expected {what} in {path} ({tried}), {problem}; name the folder that has them")


def _is_scene(path: Path) -> bool:
    """Whether a folder has pictures and poses: its loose JSONs and PNGs are then no ground truth."""
    return any((path / name).exists() for name in ("images", "sparse", "transforms.json", "results", "color", "rgb"))
