"""Labelled points of the toy room's surfaces."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch

from ..._files import as_path, read_json
from ..truth import PointTruth


def load_surface_points(path: str | Path) -> PointTruth:
    """Read `surface.npz` and `classes.json`, as `make_toy_room` writes them.

    Args:
        path: the scene.

    Raises:
        FileNotFoundError: if one of the two is missing.
        ValueError: if one is damaged.
    """
    file = as_path(path) / "surface.npz"
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such file; expected points of all surfaces there")
    names = read_json(file.with_name("classes.json"))
    try:
        with np.load(file, allow_pickle=False) as arrays:
            points, labels = arrays["points"], arrays["labels"].astype(np.int64)
        return PointTruth(torch.from_numpy(points), torch.from_numpy(labels), dict(enumerate(names)))
    except (ValueError, KeyError, OSError, EOFError, AttributeError, TypeError, BadZipFile) as error:
        raise ValueError(
            f"{file}: expected the arrays 'points' and 'labels', but it cannot be read ({error}); make the room again"
        ) from error
