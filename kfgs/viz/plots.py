"""Plots with matplotlib: training curves, IoU by class, and quality against storage.

Every function returns its figure, draws into `ax` if given, and writes a PNG file only if given a path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from .._check import as_array, check_shapes
from .._typed import typed
from .figures import (
    INK,
    LINES,
    Array,
    Row,
    add_legend_below,
    axes_for,
    check_class_names,
    count_from_zero,
    draw_curve,
    finish,
    is_number,
    panels_for,
)
from .palette import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEPS = ("step", "iteration", "epoch")  # keys for the x axis
CLOCK = ("seconds",)  # not drawn by default: a nearly straight line
COUNTS = {"size", "added", "pruned", "count", "gaussians"}  # whole numbers, drawn from zero


@typed
def plot_codebook_history(
    history: Sequence[Row], path: str | Path | None = None, *, ax: Sequence[Axes] | Array | None = None
) -> Figure:
    """Draw how the codebook grew (Sec. 3.3.1): its size and all other recorded numbers that are not always 0.

    Args:
        history: `CodebookFit.history`: one row per round of growth, or per epoch of the paper's method (with a loss).
        path: a .png file to write; None writes none.
        ax: axes to draw into, one for each recorded number; None makes a figure.

    Raises:
        ValueError: if the history is empty or has no numbers, or there are too few axes.
    """
    return _plot_rows(history, path, ax, first="size", title="Codebook")


@typed
def plot_training(
    history: Sequence[Row],
    path: str | Path | None = None,
    *,
    leave_out: Sequence[str] = CLOCK,
    ax: Sequence[Axes] | Array | None = None,
) -> Figure:
    """Draw every number that a training recorded over its steps, one panel each, the loss first.

    Numbers that are always 0 are named in the title only.

    Args:
        history: rows with `step` (or `iteration`, or `epoch`) and numbers, for instance `FieldFit.history`.
        path: a .png file to write; None writes none.
        leave_out: numbers not to draw; () draws all.
        ax: axes to draw into, one for each number; None makes a figure.

    Raises:
        ValueError: if the history is empty or has no numbers, or there are too few axes.
    """
    rows = [{key: value for key, value in row.items() if key not in leave_out} for row in history]
    return _plot_rows(rows, path, ax, first="loss", title="Training")


def plot_iou(
    iou: Tensor | Array,  # [C] in [0, 1], NaN where a class does not occur
    names: Sequence[str],  # C
    path: str | Path | None = None,
    *,
    reference: Tensor | Array | None = None,  # [C] as iou
    reference_name: str = "reference",
    title: str = "Intersection over union by class (%)",
    ax: Axes | None = None,
) -> Figure:
    """Draw the IoU of each class as a bar in its colour, best first, with the mean as a line; in per cent.

    Classes that do not occur (NaN) are left out of the bars and the mean, as in `ConfusionMatrix.miou`; the axis label says
    how many. Ties stay in class order.

    Args:
        iou: for instance `ConfusionMatrix.iou()` or `SegmentationReport.iou`.
        names: class names.
        path: a .png file to write; None writes none.
        reference: IoU to compare with, marked on each bar: of the 2-D teacher, or of another method.
        reference_name: its name in the legend.
        title: over the picture.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if names or reference are not one per class, a value lies outside [0, 1], or no class occurs.
    """
    check_shapes(("iou", iou, "C"), ("reference", reference, "C"))
    values = 100 * _shares("iou", iou)
    check_class_names(names, len(values), "iou")
    shown = np.flatnonzero(~np.isnan(values))
    if len(shown) == 0:
        raise ValueError(f"iou: expected a class that occurs, got {len(values)} NaN; was anything scored?")
    shown = shown[np.argsort(-values[shown], kind="stable")]
    axes, rows = axes_for(ax, 7.2, 0.3 * len(shown) + 1.5), np.arange(len(shown))
    axes.barh(rows, values[shown], color=palette(shown, names) / 255, edgecolor=INK, linewidth=0.6, height=0.75)
    for row, value in enumerate(values[shown]):
        axes.text(101, row, f"{value:.1f}", va="center", fontsize=9)
    mean = float(values[shown].mean())
    axes.axvline(mean, color="white", linewidth=2.6, alpha=0.8)  # makes the line visible on dark bars
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
    add_legend_below(axes, own=ax is None)
    return finish(axes, path)


@typed
def plot_quality_storage(
    points: Mapping[str, tuple[float, float]],
    path: str | Path | None = None,
    *,
    reference: Mapping[str, tuple[float, float]] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw segmentation quality against size: mIoU in per cent over MiB (logarithmic), with the name of each point.

    Args:
        points: name to (storage in MiB, mIoU in [0, 1]).
        path: a .png file to write; None writes none.
        reference: published points, drawn hollow: for instance rows of Table 1, whose "MB" are MiB.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if there is no point, a size is not positive and finite, or an mIoU lies outside [0, 1].
    """
    groups = [(points, LINES[0], "o", "measured"), (reference or {}, "none", "s", "reference")]
    if not points and not reference:
        raise ValueError("points: expected at least one name with (MiB, mIoU), got none; pass what was measured")
    axes = axes_for(ax, 7.6, 5.2)
    places: list[tuple[str, float, float]] = []
    for group, color, marker, label in groups:
        if not group:
            continue
        rows = [(name, *_quality_point(name, pair)) for name, pair in group.items()]
        _, x, y = zip(*rows, strict=True)
        axes.scatter(x, y, s=55, color=color, edgecolor=INK, linewidth=1.1, marker=marker, label=label, zorder=3)
        places += rows
    axes.set_xscale("log")
    axes.margins(x=0.3, y=0.12)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set(xlabel="storage in MiB", ylabel="mIoU in %", title="Quality against storage")
    axes.grid(alpha=0.3, which="both")
    if points and reference:
        add_legend_below(axes, own=ax is None)
    figure = finish(axes, None)
    figure.draw_without_rendering()  # computes the layout, and so the positions of the points
    if ax is None:
        figure.set_layout_engine("none")
    _name_points(axes, places)
    return finish(axes, path)


def _plot_rows(
    history: Sequence[Row], path: str | Path | None, ax: Sequence[Axes] | Array | None, *, first: str, title: str
) -> Figure:
    """One panel per recorded number that is not always 0; the axes of counts start at zero."""
    if not history:
        raise ValueError("history: expected at least one row, got none; was anything trained?")
    step = next((name for name in STEPS if name in history[0]), None)
    keys = [key for key in dict.fromkeys(key for row in history for key in row) if key not in STEPS]
    keys = [key for key in keys if any(is_number(row.get(key)) for row in history)]
    if not keys:
        raise ValueError(f"history: expected rows with numbers to draw, got keys {sorted(history[0])}")
    living = [key for key in keys if any(is_number(row.get(key)) and row[key] for row in history)]
    dead = [f"{key} is always 0" for key in keys if living and key not in living]
    keys = living or keys
    keys.sort(key=lambda key: key != first)  # stable: the others keep their order
    columns = 2 if len(keys) == 4 else min(3, len(keys))
    lines = -(-len(keys) // columns)
    panels, own = panels_for(ax, len(keys), columns, 4.2 * columns, 2.9 * lines + 0.4)
    for panel, (axes, key) in enumerate(zip(panels, keys, strict=True)):
        x = [i if step is None else row[step] for i, row in enumerate(history) if is_number(row.get(key))]
        y = [row[key] for row in history if is_number(row.get(key))]
        draw_curve(axes, x, y, panel)
        axes.set(xlabel=step or "row", title=key)
        if key in COUNTS:
            count_from_zero(axes, y)
    if own:
        panels[0].figure.suptitle("; ".join([title, *dead]))
    return finish(panels[0], path)


def _shares(name: str, values: Tensor | Array) -> Array:
    """Fractions, NaN allowed."""
    shares = as_array(values, name).astype(np.float64)
    if (wrong := shares[(shares < 0) | (shares > 1)]).size:
        raise ValueError(f"{name}: expected fractions in [0, 1] or NaN, got {wrong[0]:g}; divide per cents by 100")
    return shares


def _quality_point(name: str, pair: tuple[float, float]) -> tuple[float, float]:
    """(MiB, per cent) of one point, checked."""
    mib, miou = pair
    if not (0 < mib < float("inf") and 0 <= miou <= 1):
        raise ValueError(
            f"points[{name!r}]: expected (MiB above 0, mIoU in [0, 1]), got ({mib!r}, {miou!r}); "
            "give sizes in MiB and mIoU as a fraction, in this order"
        )
    return float(mib), 100 * float(miou)


def _name_points(axes: Axes, places: Sequence[tuple[str, float, float]]) -> None:
    """Write each name beside its point, on the side where it covers the fewest points and earlier names."""
    spots = axes.transData.transform([(x, y) for _, x, y in places])
    frame = axes.get_window_extent()
    taken: list[Any] = []
    sides = [((8, 0), "left", "center"), ((-8, 0), "right", "center"), ((0, 8), "center", "bottom")]
    sides += [((0, -8), "center", "top"), ((8, 9), "left", "bottom"), ((8, -9), "left", "top")]
    for name, x, y in places:
        tried = []
        for offset, ha, va in sides:
            text = axes.annotate(name, (x, y), offset, textcoords="offset points", ha=ha, va=va, fontsize=9)
            box = text.get_window_extent()
            covered = sum(box.overlaps(other) for other in taken) + int(box.count_contains(spots))
            outside = box.x0 < frame.x0 or box.x1 > frame.x1
            tried.append((covered + 2 * outside, text, box))
            text.set_visible(False)
        _, text, box = min(tried, key=lambda entry: entry[0])  # the first of equally good ones
        text.set_visible(True)
        taken.append(box)
        for _, other, _ in tried:
            if other is not text:
                other.remove()
