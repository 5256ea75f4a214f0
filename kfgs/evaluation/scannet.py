"""ScanNet's labelled vertices."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch

from .._files import as_path
from ..formats.ply import points_from_columns, read_ply
from ..scenes.files import some
from .truth import PointTruth, in_world

LABELS = "_vh_clean_2.labels.ply"


def load_scannet_points(path: str | Path) -> PointTruth:
    """Read the labelled vertices of a ScanNet scene.

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
    points = in_world(points_from_columns(file, columns))
    return PointTruth(points, labels, nyu40_names())


def nyu40_names() -> dict[int, str]:
    """The names of NYU40's classes, which ScanNet's labels are, by id."""
    text = files("kfgs.evaluation").joinpath("data", "nyu40.json").read_text("utf-8")
    return {int(number): name for number, name in json.loads(text)["names"].items()}


def _find(path: Path) -> Path:
    if path.is_file():
        return path
    files = sorted(path.glob(f"*{LABELS}")) if path.is_dir() else []
    if len(files) != 1:
        got = ", ".join(file.name for file in files[:3]) or "none"
        raise FileNotFoundError(
            f"{path}: expected one <scene>{LABELS} there, got {got}; download it with ScanNet's script, or give the file"
        )
    return files[0]
