"""Ground truth of data sets, and results of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import nn

from kfgs.formats.ply import write_ply

from .corpus import SEED, Add

N = 8


def make(folder: Path, add: Add) -> None:
    """Label pictures, masks, labelled points; runs of other programs."""
    _labels(folder / "labels", add)
    _coco(folder / "coco", add)
    _lerf(folder / "lerf/ramen", add)
    _points(folder, add)
    _programs(folder, add)


def _labels(place: Path, add: Add) -> None:
    (place / "labels").mkdir(parents=True)
    values = (np.arange(48).reshape(6, 8) % 3).astype(np.uint8)
    Image.fromarray(values).save(place / "labels/a.png")
    (place / "classes.json").write_text(json.dumps(["wall", "chair", "plant"]))
    add("labels", place, "labels/a.png", "classes.json", opens=".")
    masks = place.with_name("ovs3d")
    (masks / "segmentations/00").mkdir(parents=True)
    (masks / "segmentations/classes.txt").write_text("chair\nred plant\n")
    for name in ("chair", "red plant"):
        Image.fromarray(np.where(values > 0, 255, 0).astype(np.uint8)).save(masks / f"segmentations/00/{name}.png")
    add("masks", masks, "segmentations/classes.txt", "segmentations/00/chair.png", opens=".")


def _coco(place: Path, add: Add) -> None:
    place.mkdir()
    square = [[1, 1, 5, 1, 5, 4, 1, 4]]
    runs = {"size": [6, 8], "counts": [5, 10, 33]}
    annotations = [
        {"id": 1, "image_id": 1, "category_id": 1, "segmentation": square, "bbox": [1, 1, 4, 3], "iscrowd": 0},
        {"id": 2, "image_id": 1, "category_id": 2, "segmentation": runs, "bbox": [0, 0, 3, 3], "iscrowd": 1},
    ]
    whole = {
        "images": [{"id": 1, "file_name": "a.png", "width": 8, "height": 6}],
        "categories": [{"id": 1, "name": "chair"}, {"id": 2, "name": "plant"}],
        "annotations": annotations,
    }
    (place / "annotations.json").write_text(json.dumps(whole))
    add("masks", place, "annotations.json")
    add("labels", place, "annotations.json")


def _lerf(place: Path, add: Add) -> None:
    from published.class_lists import load_classes

    place.mkdir(parents=True)
    for number in load_classes("lerf_ovs")["frames"]["ramen"]:
        one = {"category": "egg", "bbox": [2, 1, 5, 3], "segmentation": [[2, 1], [5, 1], [5, 3]], "group": 0}
        info = {"name": f"frame_{number:05d}.jpg", "width": 12, "height": 10}
        (place / f"frame_{number:05d}.json").write_text(json.dumps({"info": info, "objects": [one]}))
    add("masks", place, "frame_00024.json", opens=".")


def _points(folder: Path, add: Add) -> None:
    scan = folder / "scannet"
    scan.mkdir()
    axes = {axis: np.arange(6, dtype=np.float32) for axis in "xyz"}
    colors = {name: np.zeros(6, np.uint8) for name in ("red", "green", "blue", "alpha")}
    stem = "scene0000_00"
    write_ply(
        scan / f"{stem}_vh_clean_2.labels.ply", axes | colors | {"label": np.array([0, 1, 1, 5, 28, 40], np.uint16)}
    )
    (scan / f"{stem}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": [7, 7, 9, 9, 3, 5]}))
    groups = [{"id": 0, "objectId": 0, "segments": [7], "label": "wall"}, {"objectId": 1, "segments": [3, 9]}]
    (scan / f"{stem}.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    files = [f"{stem}_vh_clean_2.labels.ply", f"{stem}_vh_clean_2.0.010000.segs.json", f"{stem}.aggregation.json"]
    add("points", scan, *files, opens=".")


def _raw() -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(SEED)
    shapes = {"xyz": (N, 3), "dc": (N, 1, 3), "rest": (N, 3, 3), "scales": (N, 3), "quats": (N, 4), "opacity": (N, 1)}
    return {name: torch.randn(*shape, generator=g) for name, shape in shapes.items()}


def _capture(path: Path, features: list[torch.Tensor]) -> None:
    """A tuple in the order of the training scripts: SH degree, parameters, features, statistics, optimiser, extent."""
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(3))])
    values = [1, *(nn.Parameter(value) for value in _raw().values())]
    values[7:7] = [nn.Parameter(value) for value in features]
    values += [torch.zeros(N), torch.zeros(N, 1), torch.zeros(N, 1), optimizer.state_dict(), 5.0]
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save((tuple(values), 30000), path)


def _programs(folder: Path, add: Add) -> None:
    g = torch.Generator().manual_seed(SEED + 1)
    place = folder / "feature3dgs"
    raw, column = _raw(), {}
    column |= {axis: raw["xyz"][:, i] for i, axis in enumerate("xyz")} | {"opacity": raw["opacity"][:, 0]}
    column |= {f"f_dc_{i}": raw["dc"][:, 0, i] for i in range(3)} | {
        f"scale_{i}": raw["scales"][:, i] for i in range(3)
    }
    column |= {f"rot_{i}": raw["quats"][:, i] for i in range(4)} | {f"semantic_{i}": raw["xyz"][:, i] for i in range(3)}
    ply = "point_cloud/iteration_30000/point_cloud.ply"
    (place / ply).parent.mkdir(parents=True)
    write_ply(place / ply, {name: value.contiguous().numpy() for name, value in column.items()})
    add("foreign", place, ply, opens=".")
    place = folder / "langsplat2/ramen_1"
    _capture(place / "chkpnt10000.pth", [torch.randn(N, 6, generator=g), torch.randn(1, 6, 16, generator=g)])
    add("foreign", place, "chkpnt10000.pth", opens=".")
    place = folder / "occam"
    _capture(place / "chkpnt30000_langfeat_1.pth", [torch.randn(N, 16, generator=g)])
    add("foreign", place, "chkpnt30000_langfeat_1.pth", opens=".")
