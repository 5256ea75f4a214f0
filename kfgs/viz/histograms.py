"""Histograms for Sec. 3.4: scores of a query with gamma, and distances of a transfer with lambda."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from .._check import as_array, check_range, check_shapes
from .._typed import typed
from ..labels import Selection
from .figures import INK, LINES, Array, axes_for, finish
from .palette import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 80
TAKEN, REST = tuple(LINES[0]), (0.75, 0.75, 0.75)  # bar colours: selected or within lambda, and the rest
STEEP = 5.0  # counts are logarithmic if the highest bin of the rest is so many times that of the selected
CLASSES = 5  # the most classes with a line: more cannot be told apart
WIDE = 88  # letters per line of the title
CLOSEST = 100  # the axis begins at the median distance divided by this, or later


@typed
def plot_scores(
    selection: Selection,
    path: str | Path | None = None,
    *,
    labels: Tensor | None = None,  # [N] int64, -1 = none
    ax: Axes | None = None,
) -> Figure:
    """Draw a histogram of scores: selected Gaussians in blue, the rest in grey, and gamma as a line between bins.

    The title says how many are selected and where gamma comes from. Counts are logarithmic if the highest bin of the
    selected is less than a fifth of the highest bin of the rest.

    Args:
        selection: the result of a query; without a threshold there is no gamma.
        path: a .png file to write; None writes none.
        labels: classes of the same Gaussians. The 5 classes with the most selected Gaussians get a line in their colour;
            the legend says how many of each are selected.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if there are no Gaussians, labels are not one for each, or the file is no .png.
        TypeError: if the labels are not integers.
    """
    check_shapes(("selection.scores", selection.scores, "N"), ("labels", labels, "N"))
    scores, mask = as_array(selection.scores.double()), as_array(selection.mask)
    if scores.size == 0:
        raise ValueError("selection: expected the scores of at least one Gaussian, got none; ask a cloud that has some")
    edges = score_bins(scores, selection.threshold)
    counts = [np.histogram(scores[part], edges)[0] for part in (~mask, mask)]
    axes = axes_for(ax, 7.0, 4.0)
    for count, name, color in zip(counts, ("not selected", "selected"), (REST, TAKEN), strict=True):
        axes.bar(edges[:-1], count, np.diff(edges), align="edge", color=color, label=f"{name} {count.sum():,}")
    if labels is not None:
        for name, color, count in _by_class(scores, mask, as_array(labels), edges):
            axes.stairs(count, edges, color=color, linewidth=3.0, zorder=3)  # its dark core sets it apart from bars
            axes.stairs(count, edges, color=INK, linewidth=1.0, zorder=3)
            axes.plot([], [], color=color, linewidth=3.0, label=name)
    if selection.threshold is not None:
        axes.axvline(selection.threshold, color="black", linewidth=1.5, label=f"gamma = {selection.threshold:.4g}")
    axes.set(xlabel="score", ylabel="Gaussians")
    if counts[1].any() and counts[0].max() > STEEP * counts[1].max():
        axes.set_yscale("log")
        axes.set(ylim=(0.7, 2 * counts[0].max()), ylabel="Gaussians (logarithmic)")
    axes.set_title(_title(selection), fontsize=10)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    return finish(axes, path)


def score_bins(scores: Array, threshold: float | None) -> Array:  # [N] -> [B + 1]
    """Edges of about `BINS` equal bins over all scores; one edge is exactly the threshold."""
    low, high = float(scores.min()), float(scores.max())
    if threshold is not None:
        low, high = min(low, threshold), max(high, threshold)
    width = max(high - low, 1e-3) / BINS  # 1e-3: also if all scores are equal
    zero = low if threshold is None else threshold
    first, last = np.floor((low - zero) / width), np.ceil((high - zero) / width)
    return zero + width * np.arange(first - 1, last + 2)  # an empty bin on either side, so rounding loses no score


def plot_distances(
    distances: Tensor | Array,  # [N] world units; infinite: no source in range
    distance: float,
    path: str | Path | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw a histogram of the distances to the sources, on a logarithmic axis, with lambda as a line between bins.

    To see distances beyond lambda, pass those of a transfer with a larger lambda. Distances below a hundredth of the
    median, also 0, are drawn in the lowest bin.

    Args:
        distances: `Transfer.distances`.
        distance: lambda, world units.
        path: a .png file to write; None writes none.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if there are no distances, one is negative or not a number, or lambda is not positive.
    """
    values = as_array(distances, "distances")
    check_shapes(("distances", values, "N"))
    check_range("distance", distance, 0, closed=(False, False))
    if values.size == 0 or not (values >= 0).all():
        raise ValueError(
            f"distances: expected at least one, none negative or NaN, got {values.size} with "
            f"{int((~(values >= 0)).sum())} of them wrong; pass Transfer.distances"
        )
    found = values[np.isfinite(values)].astype(np.float64)
    positive = found[found > 0]
    nearest = max(float(positive.min()), float(np.median(positive)) / CLOSEST) if positive.size else distance
    low = min(nearest, distance / 10)
    high = max(float(found.max()) if found.size else distance, 2 * distance)
    step = np.log(high / low) / BINS
    first, last = np.floor(np.log(low / distance) / step), np.ceil(np.log(high / distance) / step)
    edges = distance * np.exp(step * np.arange(first, last + 1))  # one of them is lambda exactly
    counts, _ = np.histogram(np.clip(found, edges[0], edges[-1]), edges)
    axes = axes_for(ax, 7.0, 4.0)
    near = edges[:-1] < distance
    widths = np.diff(edges)
    for part, color, name in ((near, TAKEN, "within lambda"), (~near, REST, "beyond")):
        axes.bar(edges[:-1][part], counts[part], widths[part], align="edge", color=color, label=name)
    axes.axvline(distance, color="black", linewidth=1.5, label=f"lambda = {distance:.4g}")
    axes.set(xscale="log", xlabel="distance to the source (world units)", ylabel="destinations")
    closer = 100 * float((values < distance).mean())
    axes.set_title(
        f"{closer:.1f} % closer than lambda; {values.size - found.size:,} of {values.size:,} without a source"
    )
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return finish(axes, path)


def _by_class(scores: Array, mask: Array, labels: Array, edges: Array) -> list[tuple[str, Any, Array]]:
    """Name, colour and counts of the classes with the most selected, in class order."""
    palette(labels)  # raises unless labels are integers from -1
    kinds, selected = np.unique(labels[mask], return_counts=True)
    most = np.sort(np.argsort(-selected, kind="stable")[:CLASSES])
    found = []
    for k, n in zip(kinds[most], selected[most], strict=True):
        name = "no class" if k < 0 else f"class {k}"
        count = np.histogram(scores[labels == k], edges)[0]
        found.append((f"{name}: {n:,} of {(labels == k).sum():,}", tuple(palette(k) / 255), count))
    return found


def _title(selection: Selection) -> str:
    share = f"{len(selection):,} of {len(selection.mask):,} selected ({len(selection) / len(selection.mask):.1%})"
    return "\n".join([share, *textwrap.wrap(selection.how, WIDE)[:3]])
