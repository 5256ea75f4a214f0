"""Pictures of how a run went: the codebook's growth and the field's training."""

from __future__ import annotations

from pathlib import Path

from ..viz import plot_codebook_history, plot_training
from .fit import load_history


def write_training_pictures(folder: str | Path) -> list[Path]:
    """Draw the histories of a run folder's newest stages; return the pictures written."""
    folder = Path(folder)
    written = []
    for stage, draw in (("codebook", plot_codebook_history), ("field", plot_training)):
        if not list((folder / "stages").glob(f"{stage}-*")):
            continue  # `decouple` has no codebook
        path = folder / f"{stage}.png"
        draw(load_history(folder, stage), path)
        written.append(path)
    return written
