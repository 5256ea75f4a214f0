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
from .palette import PALETTE, palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]
Array = np.ndarray[Any, Any]
STEPS = ("step", "iteration", "epoch")  # what may run along the bottom
CLOCK = ("seconds",)  # a nearly straight line, which tells nothing about how training went
COUNTS = {"size", "added", "pruned", "count", "gaussians"}  # recorded numbers that are whole, drawn from zero
LINES = PALETTE[[4, 5, 2, 6, 1, 0]] / 255  # the darker ones of Okabe and Ito read well as lines
INK = (0.08, 0.08, 0.08)
DPI = 110


def plot_codebook_history(history: Sequence[Row], path: str | Path) -> None:
    """Draw how the codebook grew (Sec. 3.3.1): its size, and what else each round of growth or epoch recorded.

    Args:
        history: `CodebookFit.history`: one row per round of growth, or per epoch of the paper's method (with a loss).
        path: a .png file.

    Raises:
        ValueError: if the history is empty or has no numbers.
    """
    _plot_rows(history, path, first="size", title="Codebook")


def plot_training(history: Sequence[Row], path: str | Path, *, leave_out: Sequence[str] = CLOCK) -> None:
    """Draw every number that a training recorded against its step: the loss first, one panel each.

    Args:
        history: rows with `step` (or `iteration`, or `epoch`) and numbers, for instance `FieldFit.history`.
        path: a .png file.
        leave_out: numbers not to draw; () draws all.

    Raises:
        ValueError: if the history is empty or has no numbers.
    """
    rows = [{key: value for key, value in row.items() if key not in leave_out} for row in history]
    _plot_rows(rows, path, first="loss", title="Training")


def plot_confusion(
    matrix: Tensor | Array,  # [C, C] counts
    names: Sequence[str],  # C
    path: str | Path,
    *,
    misses: Tensor | Array | None = None,  # [C] counts
) -> None:
    """Draw a confusion matrix: rows are true classes, in per cent of each row; classes that never occur are left out.

    Args:
        matrix: counts of (truth, prediction), for instance `ConfusionMatrix.matrix`.
        names: class names.
        path: a .png file.
        misses: pixels of each class that were predicted as none (`ConfusionMatrix.misses`); where there are any, they
            get a last column and count in their row.

    Raises:
        ValueError: if the matrix is not square, or names or misses are not one per class.
    """
    check_shapes(("matrix", matrix, "C C"), ("misses", misses, "C"))
    counts = _numbers(matrix)
    _check_names(names, len(counts), "matrix")
    missed = np.zeros(len(counts)) if misses is None else _numbers(misses)
    kept = np.flatnonzero(counts.sum(axis=0) + counts.sum(axis=1) + missed)
    labels = [names[int(i)] for i in kept]
    counts = counts[np.ix_(kept, kept)]
    if missed.any():
        counts = np.column_stack([counts, missed[kept]])
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = max(4.0, 0.42 * len(kept) + 2)
    figure = _figure(side + 0.8, side)
    axes = figure.add_subplot()
    image = axes.imshow(share, cmap="cividis", vmin=0, vmax=100)  # cividis reads the same for colour-blind eyes
    axes.set_xticks(range(share.shape[1]), [*labels, "no class"][: share.shape[1]], rotation=90)
    axes.set_yticks(range(len(kept)), labels)
    axes.set(xlabel="predicted class", ylabel="true class", title="Confusion (% of the true class)")
    for (i, j), value in np.ndenumerate(share):
        if value >= 1:
            color = "black" if value > 55 else "white"
            axes.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=8, color=color)
    figure.colorbar(image, ax=axes, fraction=0.046)
    _save(figure, path)


def plot_iou(
    iou: Tensor | Array,  # [C] in [0, 1], NaN where a class does not occur
    names: Sequence[str],  # C
    path: str | Path,
    *,
    reference: Tensor | Array | None = None,  # [C] as iou
    reference_name: str = "reference",
    title: str = "Intersection over union by class (%)",
) -> None:
    """Draw the IoU of each class as a bar in its colour, the best first, with the mean as a line; in per cent.

    The mean is over the classes that occur, as in `ConfusionMatrix.miou`; classes that do not (NaN) are left out, and
    said to be. Equal classes stay in class order.

    Args:
        iou: for instance `ConfusionMatrix.iou()` or `SegmentationReport.iou`.
        names: class names.
        path: a .png file.
        reference: what to compare with, marked on each bar: the 2-D teacher's own IoU, or another method's.
        reference_name: what the legend calls it.
        title: over the picture.

    Raises:
        ValueError: if names or reference are not one per class, a value lies outside [0, 1], or no class occurs.
    """
    check_shapes(("iou", iou, "C"), ("reference", reference, "C"))
    values = 100 * _shares("iou", iou)
    _check_names(names, len(values), "iou")
    shown = np.flatnonzero(~np.isnan(values))
    if len(shown) == 0:
        raise ValueError(f"iou: expected a class that occurs, got {len(values)} NaN; was anything scored?")
    shown = shown[np.argsort(-values[shown], kind="stable")]
    figure = _figure(7.2, 0.3 * len(shown) + 1.5)
    axes, rows = figure.add_subplot(), np.arange(len(shown))
    axes.barh(rows, values[shown], color=palette(shown) / 255, edgecolor=INK, linewidth=0.6, height=0.75)
    for row, value in enumerate(values[shown]):
        axes.text(101, row, f"{value:.1f}", va="center", fontsize=9)
    mean = float(values[shown].mean())
    axes.axvline(mean, color="white", linewidth=2.6, alpha=0.8)  # seen on dark bars as well
    axes.axvline(mean, color=INK, linestyle="--", linewidth=1.3, label=f"mIoU {mean:.1f}")
    if reference is not None:
        theirs = 100 * _shares("reference", reference)
        label = f"{reference_name} (mIoU {np.nanmean(theirs):.1f})" if (~np.isnan(theirs)).any() else reference_name
        axes.scatter(theirs[shown], rows, marker="D", s=26, color="white", edgecolor=INK, zorder=3, label=label)
    axes.set_yticks(rows, [names[int(i)] for i in shown])
    absent = len(values) - len(shown)
    note = f" (classes that do not occur: {absent} of {len(values)})" if absent else ""
    axes.set(xlim=(0, 107), ylim=(len(shown) - 0.4, -0.6), title=title, xlabel=f"IoU in %{note}")
    axes.set_xticks(range(0, 101, 20))
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    _save(figure, path)


def _plot_rows(history: Sequence[Row], path: str | Path, *, first: str, title: str) -> None:
    """One panel per recorded number; counts start at zero."""
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
        if key in COUNTS:
            _from_zero(axes, y)
    figure.suptitle(title)
    _save(figure, path)


def _curve(axes: Axes, x: Sequence[float], y: Sequence[float], panel: int, **options: Any) -> None:
    marker = "o" if len(x) < 40 else None
    style = {"color": LINES[panel % len(LINES)], "marker": marker, "markersize": 3, "linewidth": 1.5}
    axes.plot(x, y, clip_on=False, zorder=3, **style | options)  # zeros are seen on the frame
    axes.grid(alpha=0.3)
    if all(float(value).is_integer() for value in x):
        axes.locator_params(axis="x", integer=True)


def _from_zero(axes: Axes, y: Sequence[float]) -> None:
    """Whole numbers upwards from zero, with room above the highest, also where all of them are zero."""
    axes.set_ylim(0, 1.06 * max(1, *y))
    axes.locator_params(axis="y", integer=True)


def _numbers(values: Tensor | Array) -> Array:
    """As float64 in numpy."""
    return (values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)).astype(
        np.float64
    )


def _shares(name: str, values: Tensor | Array) -> Array:
    """Fractions, NaN allowed."""
    shares = _numbers(values)
    if (wrong := shares[(shares < 0) | (shares > 1)]).size:
        raise ValueError(f"{name}: expected fractions in [0, 1] or NaN, got {wrong[0]:g}; divide per cents by 100")
    return shares


def _check_names(names: Sequence[str], count: int, source: str) -> None:
    if len(names) != count:
        raise ValueError(
            f"names: expected {count} class names (from {source}), got {len(names)}; pass one name for each class"
        )


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
