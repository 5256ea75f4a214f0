"""ScanNet's labelled vertices."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import reading
from .._files import as_path, read_json
from .._origin import in_world
from ..formats.ply import points_from_columns, read_ply
from ..scenes.files import some
from .truth import PointTruth

LABELS = "_vh_clean_2.labels.ply"


def load_scannet_points(path: str | Path) -> PointTruth:
    """Read the labelled vertices of a ScanNet scene.

    Instances are read where `*.aggregation.json` and `*.segs.json` lie beside the mesh, as ScanNet has them.

    Args:
        path: `scene0000_00_vh_clean_2.labels.ply`, or the folder with it.

    Returns:
        The vertices in the order of the mesh, NYU40 ids, 0 = none. OpenGaussian's Gaussian i is vertex i.

    Raises:
        FileNotFoundError: if there is no such mesh.
        ValueError: if it is damaged, or has no ids of NYU40.
    """
    file = _find(as_path(path))
    columns = read_ply(file)
    if "label" not in columns:
        raise ValueError(
            f"{file}: expected a vertex property 'label' (NYU40 ids), got {some(list(columns))}; give the mesh whose name ends "
            f"in {LABELS}, not the one with colours only"
        )
    labels = torch.from_numpy(columns["label"].astype(np.int64))
    if not bool(((labels >= 1) & (labels <= 40)).any()):
        got = labels.unique()[:5].tolist()
        raise ValueError(f"{file}: expected NYU40 ids of 1 to 40, got only {got}; are these labels of another table?")
    with reading(file, "a mesh with labelled vertices"):
        points = in_world(points_from_columns(columns))
    return PointTruth(points, labels, nyu40_names(), _instances(file, len(labels)))


def nyu40_names() -> dict[int, str]:
    """The names of NYU40's classes, which ScanNet's labels are, by id."""
    text = files("kfgs.evaluation").joinpath("data", "nyu40.json").read_text("utf-8")
    return {int(number): name for number, name in json.loads(text)["names"].items()}


def _find(path: Path) -> Path:
    if path.is_file():
        return path
    found = sorted(path.glob(f"*{LABELS}")) if path.is_dir() else []
    if len(found) != 1:
        got = ", ".join(file.name for file in found[:3]) or "none"
        raise FileNotFoundError(
            f"{path}: expected one <scene>{LABELS} there, got {got}; download it with ScanNet's script, or give the file"
        )
    return found[0]


def _instances(file: Path, count: int) -> Tensor | None:  # [P] int64
    """The object of each vertex by ScanNet's two files, if both are there; -1 = none."""
    scene = file.name.split("_vh_clean")[0]
    places = [file.with_name(f"{scene}{name}") for name in (".aggregation.json", "_vh_clean.aggregation.json")]
    groups = next((place for place in places if place.is_file()), None)
    segments = file.with_name(f"{scene}_vh_clean_2.0.010000.segs.json")
    if groups is None or not segments.is_file():
        return None
    of_vertex, listed = _field(segments, "segIndices"), _field(groups, "segGroups")
    try:
        index = np.array(of_vertex, dtype=np.int64)
        objects = {int(segment): int(group["objectId"]) for group in listed for segment in group["segments"]}
        np.array(list(objects.values()), dtype=np.int64)  # an OverflowError if one is too large
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise ValueError(
            f"{groups}: expected groups with 'objectId' and 'segments' ({error}); download it again"
        ) from error
    if index.shape != (count,):
        raise ValueError(
            f"{segments}: expected a segment for each of the {count} vertices of {file.name}, got {index.shape}; the files "
            "are of different scenes"
        )
    unique, inverse = np.unique(index, return_inverse=True)
    return torch.from_numpy(np.array([objects.get(int(segment), -1) for segment in unique])[inverse])


def _field(path: Path, name: str) -> Any:
    top = read_json(path)
    if not isinstance(top, dict) or not isinstance(top.get(name), list):
        raise ValueError(f"{path}: expected an object with a list {name!r}, got {str(top)[:80]}; download it again")
    return top[name]
