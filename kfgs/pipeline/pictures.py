"""Pictures of how a run went: the codebook's growth and the field's training."""

from __future__ import annotations

from pathlib import Path

from ..viz import plot_codebook_history, plot_training
from .fit import FitResult, load_history


def write_training_pictures(result: FitResult) -> list[Path]:
    """Draw the histories of a run's codebook and field into its folder; return the pictures written."""
    draw = {"codebook": plot_codebook_history, "field": plot_training}
    written = []
    for stage in result.stages:
        if stage.name in draw:  # `decouple` has no codebook
            written.append(result.folder / f"{stage.name}.png")
            draw[stage.name](load_history(stage), written[-1])
    return written
