"""Curves and tables as PNG files, drawn with matplotlib (which pyvista brings) away from its global state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from .._check import check_shapes
from .._files import atomic_path
from .palette import PALETTE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]
STEPS = ("step", "iteration", "epoch")  # what may run along the bottom
DPI = 110


def plot_codebook_history(history: Sequence[Row], path: str | Path) -> None:
    """Draw how the codebook grew (Sec. 3.3.1): its size, its loss (Eq. 6) and what else each epoch recorded.

    Args:
        history: `CodebookFit.history`: one row per epoch.
        path: a .png file.

    Raises:
        ValueError: if the history is empty or has no numbers.
    """
    _plot_rows(history, path, first="size", title="Codebook", floor={"size"})


def plot_training(history: Sequence[Row], path: str | Path) -> None:
    """Draw every number that a training recorded against its step: the loss first, one panel each.

    Args:
        history: rows with `step` (or `iteration`, or `epoch`) and numbers, for instance `FieldFit.history`.
        path: a .png file.

    Raises:
        ValueError: if the history is empty or has no numbers.
    """
    _plot_rows(history, path, first="loss", title="Training", floor={"count", "gaussians"})


def plot_confusion(
    matrix: Tensor | np.ndarray[Any, Any],  # [C, C] counts
    names: Sequence[str],  # C
    path: str | Path,
) -> None:
    """Draw a confusion matrix: rows are true classes, in per cent of each row; classes that never occur are left out.

    Raises:
        ValueError: if the matrix is not square or names are missing.
    """
    check_shapes(("matrix", matrix, "C C"))
    counts = matrix.detach().cpu().numpy() if isinstance(matrix, torch.Tensor) else np.asarray(matrix)
    if len(names) != len(counts):
        raise ValueError(f"names: expected {len(counts)} class names (from matrix), got {len(names)}")
    kept = np.flatnonzero(counts.sum(axis=0) + counts.sum(axis=1))
    counts = counts[np.ix_(kept, kept)].astype(np.float64)
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = max(4.0, 0.42 * len(kept) + 2)
    figure = _figure(side + 0.8, side)
    axes = figure.add_subplot()
    image = axes.imshow(share, cmap="cividis", vmin=0, vmax=100)  # cividis reads the same for colour-blind eyes
    labels = [names[int(i)] for i in kept]
    axes.set_xticks(range(len(kept)), labels, rotation=90)
    axes.set_yticks(range(len(kept)), labels)
    axes.set(xlabel="predicted class", ylabel="true class", title="Confusion (% of the true class)")
    for (i, j), value in np.ndenumerate(share):
        if value >= 1:
            axes.text(
                j, i, f"{value:.0f}", ha="center", va="center", fontsize=7, color="black" if value > 55 else "white"
            )
    figure.colorbar(image, ax=axes, fraction=0.046)
    _save(figure, path)


def _plot_rows(history: Sequence[Row], path: str | Path, *, first: str, title: str, floor: set[str]) -> None:
    """One panel per recorded number; panels whose name is in `floor` start at zero."""
    if not history:
        raise ValueError("history: expected at least one row, got none; was anything trained?")
    step = next((name for name in STEPS if name in history[0]), None)
    keys = [key for key in dict.fromkeys(key for row in history for key in row) if key not in STEPS]
    keys = [key for key in keys if any(_is_number(row.get(key)) for row in history)]
    if not keys:
        raise ValueError(f"history: expected rows with numbers to draw, got keys {sorted(history[0])}")
    keys.sort(key=lambda key: key != first)  # stable: the others keep their order
    columns = min(3, len(keys))
    lines = -(-len(keys) // columns)
    figure = _figure(4.2 * columns, 2.9 * lines + 0.4)
    for panel, key in enumerate(keys):
        x = [i if step is None else row[step] for i, row in enumerate(history) if _is_number(row.get(key))]
        y = [row[key] for row in history if _is_number(row.get(key))]
        axes = figure.add_subplot(lines, columns, panel + 1)
        _curve(axes, x, y, panel)
        axes.set(xlabel=step or "row", title=key)
        if key in floor:
            axes.set_ylim(bottom=0)
    figure.suptitle(title)
    _save(figure, path)


def _curve(axes: Axes, x: Sequence[float], y: Sequence[float], panel: int) -> None:
    color = PALETTE[[4, 5, 2, 6, 1, 0][panel % 6]] / 255  # the darker ones of Okabe and Ito read well as lines
    axes.plot(x, y, color=tuple(color), marker="o" if len(x) < 40 else None, markersize=3, linewidth=1.5)
    axes.grid(alpha=0.3)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("plots need matplotlib, which pyvista brings; run: pip install matplotlib") from error
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: str | Path) -> None:
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"path: expected a name that ends in .png, got {Path(path).name!r}; rename it")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", bbox_inches="tight")  # else the label beside a square picture is cut
