"""A selection as files: numbers as JSON, Gaussians as PLY, all of them or none."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..._files import write_json
from ...formats import SplatFile, write_splats
from ...formats.splat_file import SCORE
from ...labels import connected_parts
from ..frusta import evenly

MOST_PARTS = 16  # listed: as many as `connected_parts` draws in one rendering of a view
MOST_VIEWS = 30  # compared, evenly chosen

if TYPE_CHECKING:
    from .exploration import Exploration
    from .picked import Side


def save_parts(state: Exploration, folder: Path) -> list[Path]:
    """Write a selection; see `Exploration.save_selection`."""
    chosen = [side for side in state.sides if state.selected(side).any()]
    if not chosen:
        words = (
            "no question is asked" if state.asked is None else f"score > {state.gamma:.4g} for {state.asked.words!r}"
        )
        raise ValueError(f"selection: expected at least one Gaussian, got none ({words}); ask first, or lower gamma")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".selection.", dir=folder.parent) as name:
        made = Path(name)
        facts: dict[str, Any] = state.facts()
        facts["parts"] = {side: _parts(state, side) for side in chosen}
        write_json(made / "selection.json", facts)
        for side in chosen:
            write_splats(made / f"selection_{side}.ply", _splats(state, side))
        paths = [folder / path.name for path in sorted(made.iterdir())]
        folder.mkdir(exist_ok=True)
        for side in state.sides:  # of an older selection
            for path in folder.glob(f"selection_{side}.ply*"):
                if path not in paths:
                    path.unlink()
        for path in paths:
            os.replace(made / path.name, path)
    return paths


def _parts(state: Exploration, side: Side) -> list[dict[str, Any]]:
    """The connected parts, each with the view that shows it best: a place among all cameras of the exploration."""
    places = evenly(len(state.cameras), MOST_VIEWS).tolist() if state.cameras else []
    views = [state.cameras[place] for place in places]
    parts = [
        part.to_json()
        for part in connected_parts(state.cloud(side), state.selection(side), views or None, most=MOST_PARTS)
    ]
    for part in parts:
        if part["best_view"] is not None:
            part["best_view"]["index"] = places[part["best_view"]["index"]]
    return parts


def _splats(state: Exploration, side: Side) -> SplatFile:
    """The selected Gaussians with labels, names and, where every one has one, scores."""
    mask, labels = state.selected(side), torch.from_numpy(state.labels(side))
    cloud = state.cloud(side).detach().to("cpu").replace(labels=labels).select(torch.from_numpy(mask))
    scores = state.scores(side)[mask]
    extra = {SCORE: scores.astype(np.float32)} if np.isfinite(scores).all() else {}
    return SplatFile(cloud, extra, tuple(state.meaning.names))
