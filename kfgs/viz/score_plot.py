"""The scores of a question (Sec. 3.4) as a histogram: where gamma cuts them, and where gamma comes from."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from .._check import check_shapes
from ..labels import Selection
from .arrays import as_array
from .matches import REST, TAKEN
from .palette import palette
from .plots import INK, _figure, _save

Array = np.ndarray[Any, Any]
BINS = 80
STEEP = 5.0  # where the highest bin of the selected is so much lower than that of the rest, counts are drawn in logs
CLASSES = 5  # of so many at most, those with the most selected, is a line drawn: more cannot be told apart
WIDE = 88  # letters of a line over the picture


def plot_scores(
    selection: Selection,
    path: str | Path,
    *,
    labels: Tensor | None = None,  # [N] int64, -1 = none
) -> None:
    """Draw how many Gaussians have which score, the selected ones in blue, the rest in grey, and gamma.

    Colours are those of `plot_distances`; bins meet at gamma. The title says how many are selected and how gamma came
    about. Counts are logarithmic where the selected would hardly be seen otherwise: where their highest bin is less than
    a fifth as high as that of the rest.

    Args:
        selection: what a query returned; without a threshold nothing is marked.
        path: a .png file.
        labels: classes of the same Gaussians. Each class that was selected from (the 5 most, at most) gets a line in its
            colour, and says how many of its own were.

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
    figure = _figure(7.0, 4.0)
    axes = figure.add_subplot()
    for count, name, color in zip(counts, ("not selected", "selected"), (REST, TAKEN), strict=True):
        axes.bar(edges[:-1], count, np.diff(edges), align="edge", color=color, label=f"{name} {count.sum():,}")
    if labels is not None:
        for name, color, count in _by_class(scores, mask, as_array(labels), edges):
            axes.stairs(count, edges, color=color, linewidth=3.0, zorder=3)  # told from bars of any colour by its core
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
    _save(figure, path)


def score_bins(scores: Array, threshold: float | None) -> Array:  # [N] -> [B + 1]
    """Edges of equally wide bins over all scores, about `BINS` of them; one edge is the threshold exactly."""
    low, high = float(scores.min()), float(scores.max())
    if threshold is not None:
        low, high = min(low, threshold), max(high, threshold)
    width = max(high - low, 1e-3) / BINS  # all scores equal: a thousandth around them
    zero = low if threshold is None else threshold
    first, last = np.floor((low - zero) / width), np.ceil((high - zero) / width)
    return zero + width * np.arange(first - 1, last + 2)  # one empty bin on either side: no score is lost in rounding


def _by_class(scores: Array, mask: Array, labels: Array, edges: Array) -> list[tuple[str, Any, Array]]:
    """Name, colour and counts of the classes with the most selected, in class order."""
    palette(labels)  # whole numbers from -1, or it says so
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
