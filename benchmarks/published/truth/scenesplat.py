"""SceneSplat's labelled points: one array per property of a point, as Pointcept lays its scenes out.

The files are those of protocols.md f1. No sample could be had. Two readings are ours: a label is an index into the benchmark's
list of classes (`load_classes("scenesplat")`), and of ScanNet++'s several labels of a point the first column is the first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kfgs._arrays import read_array
from kfgs._check import check_choice
from kfgs._files import as_path
from kfgs.evaluation.truth import PointTruth, in_world

from ..class_lists import load_classes

SEGMENTS = {
    "scannet20": "segment20.npy",
    "scannet200": "segment200.npy",
    "scannetpp100": "segment.npy",
    "matterport21": "segment.npy",
    "holicity4": "segment.npy",
}
"""The file of labels of each benchmark."""


def load_scenesplat_points(path: str | Path, benchmark: str | None = None) -> PointTruth:
    """Read the labelled points of a scene of SceneSplat-Bench: `coord.npy`, `segment*.npy` and, if it is there, `instance.npy`.

    Args:
        path: the scene's folder, or the file of labels in it. A folder has `segment20.npy` (scannet20), `segment200.npy`
            (scannet200) or `segment.npy` (the others).
        benchmark: whose classes the labels are, a name of `SEGMENTS`; None: that of the file, if its name says it.

    Returns:
        Points in world units, indices of the benchmark's classes with -1 = none, instances if there are any. Only the first
        of ScanNet++'s several labels of a point is kept.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if the benchmark is unknown or cannot be told, or a file is damaged or does not fit; the message names it.
    """
    path = as_path(path)
    if benchmark is not None:
        check_choice("benchmark", benchmark, tuple(SEGMENTS))
    file = path if path.suffix == ".npy" else _find(path, benchmark)
    benchmark = benchmark or _benchmark_of(file)
    points = _read(file.with_name("coord.npy"), "coordinates [Q, 3]", "f")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(
            f"{file.with_name('coord.npy')}: expected finite coordinates [Q, 3], got {list(points.shape)} or NaN or infinity; "
            "copy the file again"
        )
    names: list[str] = load_classes("scenesplat")[benchmark]["classes"]
    labels = _labels(file, len(points), len(names), benchmark)
    objects = file.with_name("instance.npy")
    instances = _labels(objects, len(points), None, benchmark) if objects.is_file() else None
    return PointTruth(in_world(torch.from_numpy(points.astype(np.float64))), labels, dict(enumerate(names)), instances)


def _find(folder: Path, benchmark: str | None) -> Path:
    wanted = dict.fromkeys(SEGMENTS.values() if benchmark is None else [SEGMENTS[benchmark]])
    there = [folder / name for name in wanted if (folder / name).is_file()]
    if not there:
        got = ", ".join(sorted(file.name for file in folder.glob("*.npy"))) or "none"
        raise FileNotFoundError(
            f"{folder}: expected {' or '.join(wanted)} of SceneSplat{f' ({benchmark})' if benchmark else ''} there, got {got}; "
            "name the file of labels, or another benchmark"
        )
    if len(there) > 1:
        raise ValueError(
            f"{folder}: expected one file of labels, got {', '.join(file.name for file in there)}; name the file, or a benchmark"
        )
    return there[0]


def _benchmark_of(file: Path) -> str:
    found = [name for name, segment in SEGMENTS.items() if segment == file.name]
    if len(found) != 1:
        raise ValueError(
            f"benchmark: expected one of {', '.join(found or SEGMENTS)}, whose classes the labels in {file} are, got None; "
            "pass its name"
        )
    return found[0]


def _labels(file: Path, count: int, classes: int | None, benchmark: str) -> Tensor:  # [Q] int64
    """The first column of whole numbers from -1, below `classes` if there is a limit."""
    values = _read(file, f"whole numbers, one for each of the {count} points", "iu")
    wide = values.ndim == 2 and (values.shape[1] == 1 or (values.shape[1] > 1 and benchmark == "scannetpp100"))
    if len(values) != count or not (values.ndim == 1 or wide):
        raise ValueError(
            f"{file}: expected [{count}] whole numbers, one for each point of coord.npy, got {list(values.shape)}; are the files "
            "of one scene?"
        )
    found = (values[:, 0] if wide else values).astype(np.int64)
    low, high = int(found.min()), int(found.max())
    if low < -1 or (classes is not None and high >= classes):
        limit = f"to {classes - 1} (a class of {benchmark})" if classes is not None else "upwards"
        raise ValueError(
            f"{file}: expected numbers from -1 (none) {limit}, got {low} to {high}; are these labels of another benchmark?"
        )
    return torch.from_numpy(found)


def _read(file: Path, expected: str, kinds: str) -> NDArray[np.generic]:
    """An array of one of the kinds of NumPy's `dtype.kind`."""
    values = read_array(file, expected, "copy the file again")
    if values.dtype.kind not in kinds or values.ndim == 0:
        raise ValueError(f"{file}: expected {expected}, got {values.dtype}; copy the file again")
    return values
