"""Three plots with matplotlib: histories, IoU by class, scores of a query.

Every function returns its figure, and writes it as a PNG file if given a path that ends in .png.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from .._check import as_array, check_shapes
from .._files import atomic_path
from ..labels import Selection
from .colors import Array
from .palette import palette
from .pictures import check_suffix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]  # of a recorded history: numbers by name
NUMBER = int | float
# Okabe and Ito's darker colours, which are readable as lines
LINES = np.array([[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [230, 159, 0]]) / 255
INK, REST = (0.08, 0.08, 0.08), (0.75, 0.75, 0.75)
STEPS = ("step", "iteration", "epoch", "round")  # keys for the x axis
COUNTS = {"size", "added", "pruned", "count", "gaussians"}  # whole numbers, drawn from zero
BINS, STEEP = 80, 5.0  # counts are logarithmic if the highest bin of the rest is this many times that of the selected


def plot_history(history: Sequence[Row] | Mapping[str, Sequence[Row]], path: str | Path | None = None) -> Figure:
    """Draw every number that a training or a codebook's growth (Figure 6) recorded, one panel each, loss or size first.

    Numbers that are always 0 are left out, and so are `seconds`, a nearly straight line.

    Args:
        history: rows with `step` (or `iteration`, `epoch`, `round`) and numbers: `FieldFit.history`,
            `Codebook.report.history`; or several histories by name, which get a line each.
        path: the file.

    Raises:
        ValueError: if there are no rows with numbers.
    """
    named = history if isinstance(history, Mapping) else {"": history}
    rows = [row for part in named.values() for row in part]
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if key not in (*STEPS, "seconds")]
    keys = [key for key in keys if any(isinstance(row.get(key), NUMBER) and row[key] for row in rows)]
    if not keys:
        raise ValueError(f"history: expected rows with numbers to draw, got {len(rows)} without; was anything trained?")
    keys.sort(key=lambda key: key not in ("loss", "size"))  # stable: the others keep their order
    columns = 2 if len(keys) == 4 else min(3, len(keys))
    lines = -(-len(keys) // columns)
    figure = new_figure(4.2 * columns, 2.9 * lines + 0.4)
    for panel, key in enumerate(keys):
        axes = figure.add_subplot(lines, columns, panel + 1)
        for i, (name, part) in enumerate(named.items()):
            step = next((word for word in STEPS if part and word in part[0]), "row")
            points = [(row.get(step, at), row[key]) for at, row in enumerate(part) if isinstance(row.get(key), NUMBER)]
            x, y = zip(*points, strict=True) if points else ((), ())
            color = LINES[(panel if len(named) == 1 else i) % len(LINES)]
            # not clipped: zeros show over the frame
            axes.plot(x, y, color=color, marker="o" if len(x) < 40 else None, markersize=3, label=name, clip_on=False)
            axes.set(xlabel=step, title=key)
        axes.grid(alpha=0.3)
        if key in COUNTS:
            axes.set_ylim(0, 1.06 * max(1, *(row[key] for row in rows if isinstance(row.get(key), NUMBER))))
    if len(named) > 1:
        _legend_below(axes)
    return finish(figure, path)


def plot_iou(
    iou: Tensor | Array,  # [C] in [0, 1], NaN where a class does not occur
    names: Sequence[str],  # C
    path: str | Path | None = None,
    *,
    reference: Tensor | Array | None = None,  # [C] as iou
    reference_name: str = "reference",
) -> Figure:
    """Draw the IoU of each class as a bar in its colour, best first, with the mean as a line; in per cent.

    Classes that do not occur (NaN) are left out of the bars and the mean, as in `ConfusionMatrix.miou`. Ties stay in class
    order.

    Args:
        iou: for instance `ConfusionMatrix.iou()` or `SegmentationReport.iou`.
        names: class names.
        path: the file.
        reference: IoU to compare with, marked on each bar: of the 2-D teacher, or of another method.
        reference_name: its name in the legend.

    Raises:
        ValueError: if names or reference are not one per class, a value lies outside [0, 1], or no class occurs.
    """
    check_shapes(("iou", iou, "C"), ("reference", reference, "C"), ("names", np.array(names), "C"))
    values = 100 * _shares("iou", iou)
    shown = np.flatnonzero(~np.isnan(values))
    if len(shown) == 0:
        raise ValueError(f"iou: expected a class that occurs, got {len(values)} NaN; was anything scored?")
    shown = shown[np.argsort(-values[shown], kind="stable")]
    figure, rows = new_figure(7.2, 0.3 * len(shown) + 1.5), np.arange(len(shown))
    axes = figure.add_subplot()
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
    axes.set(xlim=(0, 107), ylim=(len(shown) - 0.4, -0.6), xticks=range(0, 101, 20))
    axes.set(title="Intersection over union by class", xlabel=f"IoU in % ({len(shown)} of {len(values)} classes occur)")
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    _legend_below(axes)
    return finish(figure, path)


def plot_scores(selection: Selection, path: str | Path | None = None) -> Figure:
    """Draw a histogram of scores: selected Gaussians in blue, the rest in grey, and gamma as a line between bins.

    The title says how many are selected and where gamma comes from. Counts are logarithmic if the highest bin of the
    selected is less than a fifth of the highest bin of the rest.

    Raises:
        ValueError: if there are no Gaussians.
    """
    scores, mask = as_array(selection.scores.double()), as_array(selection.mask)
    if scores.size == 0:
        raise ValueError("selection: expected the scores of at least one Gaussian, got none; ask a cloud that has some")
    gamma = selection.threshold
    known = scores if gamma is None else np.append(scores, gamma)
    width, zero = max(float(np.ptp(known)), 1e-3) / BINS, float(known.min()) if gamma is None else gamma
    first, last = np.floor((known.min() - zero) / width), np.ceil((known.max() - zero) / width)
    edges = zero + width * np.arange(first - 1, last + 2)  # an empty bin on either side, so rounding loses no score
    counts = [np.histogram(scores[part], edges)[0] for part in (~mask, mask)]
    figure = new_figure(7.0, 4.0)
    axes = figure.add_subplot()
    for count, name, color in zip(counts, ("not selected", "selected"), (REST, tuple(LINES[0])), strict=True):
        axes.bar(edges[:-1], count, width, align="edge", color=color, label=f"{name} {count.sum():,}")
    if gamma is not None:
        axes.axvline(gamma, color="black", linewidth=1.5, label=f"gamma = {gamma:.4g}")
    axes.set(xlabel="score", ylabel="Gaussians")
    if counts[1].any() and counts[0].max() > STEEP * counts[1].max():
        axes.set_yscale("log")
        axes.set(ylim=(0.7, 2 * counts[0].max()), ylabel="Gaussians (logarithmic)")
    share = f"{len(selection):,} of {len(mask):,} selected ({len(selection) / len(mask):.1%})"
    axes.set_title("\n".join([share, *textwrap.wrap(selection.how, 88)[:3]]), fontsize=10)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    return finish(figure, path)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure without matplotlib's global state; sizes in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def finish(figure: Figure, path: str | Path | None) -> Figure:
    """The figure, written as a PNG file, whole or not at all, if there is a path."""
    if path is not None:
        with atomic_path(check_suffix(path, ".png")) as temporary:
            # tight: otherwise labels next to square pictures are cut
            figure.savefig(temporary, format="png", bbox_inches="tight")
    return figure


def _legend_below(axes: Axes) -> None:
    axes.figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)


def _shares(name: str, values: Tensor | Array) -> Array:
    """Fractions, NaN allowed."""
    shares = as_array(values, name).astype(np.float64)
    if (wrong := shares[(shares < 0) | (shares > 1)]).size:
        raise ValueError(f"{name}: expected fractions in [0, 1] or NaN, got {wrong[0]:g}; divide per cents by 100")
    return shares
