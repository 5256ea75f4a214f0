"""Write a selection as files: numbers as JSON, Gaussians as PLY; either all files or none."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from .._card import short_repr
from .._files import write_json
from ..cameras import Camera
from ..formats import SplatFile, write_splats
from ..formats.splat_file import SCORE
from ..gaussians import Gaussians
from ..labels import Selection, connected_parts
from ..viz.frusta import evenly
from .picked import SIDE_WORDS, Side

MOST_PARTS = 16  # parts listed: as many as `connected_parts` renders in one pass of a view
MOST_VIEWS = 30  # views compared, evenly chosen


class SelectedSide(NamedTuple):
    """The selection in one cloud."""

    cloud: Gaussians
    selection: Selection
    labels: Tensor  # [N]
    scores: Tensor  # [N], NaN where a Gaussian has none

    def __repr__(self) -> str:
        return short_repr(self)


def save_sides(
    sides: Mapping[Side, SelectedSide],
    details: dict[str, Any],
    names: Sequence[str],
    cameras: Sequence[Camera],
    folder: Path,
) -> list[Path]:
    """Write a selection; see `Exploration.save_selection`."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".selection.", dir=folder.parent) as name:
        made = Path(name)
        write_json(made / "selection.json", details | {"parts": {side: _parts(sides[side], cameras) for side in sides}})
        for side, chosen in sides.items():
            write_splats(made / f"selection_{side}.ply", _splats(chosen, names))
        paths = [folder / path.name for path in sorted(made.iterdir())]
        folder.mkdir(exist_ok=True)
        for side in SIDE_WORDS:  # remove files of an older selection
            for path in folder.glob(f"selection_{side}.ply*"):
                if path not in paths:
                    path.unlink()
        for path in paths:
            os.replace(made / path.name, path)
    return paths


def _parts(side: SelectedSide, cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """The connected parts as JSON, each with its best view as an index into `cameras`."""
    places = evenly(len(cameras), MOST_VIEWS).tolist() if cameras else []
    views = [cameras[place] for place in places]
    parts = [part.to_json() for part in connected_parts(side.cloud, side.selection, views or None, most=MOST_PARTS)]
    for part in parts:
        if part["best_view"] is not None:
            part["best_view"]["index"] = places[part["best_view"]["index"]]
    return parts


def _splats(side: SelectedSide, names: Sequence[str]) -> SplatFile:
    """The selected Gaussians with labels, names and, if every one has a score, scores."""
    mask = side.selection.mask
    cloud = side.cloud.detach().to("cpu").replace(labels=side.labels).select(mask)
    scores = side.scores[mask].numpy()
    extra = {SCORE: scores.astype(np.float32)} if np.isfinite(scores).all() else {}
    return SplatFile(cloud, extra, tuple(names))
