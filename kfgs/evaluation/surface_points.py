"""Labelled points of the toy room's surfaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from .._arrays import read_arrays
from .._files import as_path, read_json
from .truth import PointTruth


def load_surface_points(path: str | Path) -> PointTruth:
    """Read `surface.npz` and `classes.json`, as `make_toy_room` writes them.

    Args:
        path: the scene.

    Raises:
        FileNotFoundError: if one of the two is missing.
        ValueError: if one is damaged.
    """
    file = as_path(path) / "surface.npz"
    expected, advice = "the arrays 'points' and 'labels', points of all surfaces", "make the room again"
    arrays = read_arrays(file, expected, advice)
    names = read_json(file.with_name("classes.json"))
    try:
        points, labels = arrays["points"], arrays["labels"].astype(np.int64)
        return PointTruth(torch.from_numpy(points), torch.from_numpy(labels), dict(enumerate(names)))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: expected {expected}, but it cannot be read ({error}); {advice}") from error
