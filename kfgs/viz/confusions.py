"""Plots of confused classes with matplotlib: the whole matrix, or the pairs that are confused most.

As in `plots`, a function returns its figure, draws into `ax` if given, and writes a PNG file only if given a path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from .._check import as_array, check_shapes
from .figures import INK, Array, axes_for, check_class_names, finish
from .palette import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_confusion(
    matrix: Tensor | Array,  # [C, C] counts
    names: Sequence[str],  # C
    path: str | Path | None = None,
    *,
    misses: Tensor | Array | None = None,  # [C] counts
    ax: Axes | None = None,
) -> Figure:
    """Draw a confusion matrix in per cent of each row. Rows are true classes; classes that never occur are left out.

    Args:
        matrix: counts of (truth, prediction), for instance `ConfusionMatrix.matrix`.
        names: class names.
        path: a .png file to write; None writes none.
        misses: pixels of each class predicted as "no class" (`ConfusionMatrix.misses`); if there are any, they get a last
            column and count in their row.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if the matrix is not square, or names or misses are not one per class.
    """
    counts = _counts(matrix, names, misses)
    classes, missed = counts[:, :-1], counts[:, -1]
    kept = np.flatnonzero(classes.sum(axis=0) + counts.sum(axis=1))
    labels = [names[int(i)] for i in kept]
    counts = counts[np.ix_(kept, [*kept, len(names)] if missed.any() else kept)]
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    side = max(4.0, 0.42 * len(kept) + 2)
    axes = axes_for(ax, side + 0.8, side)
    image = axes.imshow(share, cmap="cividis", vmin=0, vmax=100)  # cividis reads the same for colour-blind eyes
    axes.set_xticks(range(share.shape[1]), [*labels, "no class"][: share.shape[1]], rotation=90)
    axes.set_yticks(range(len(kept)), labels)
    axes.set(xlabel="predicted class", ylabel="true class", title="Confusion (% of the true class)")
    for (i, j), value in np.ndenumerate(share):
        if value >= 1:
            color = "black" if value > 55 else "white"
            axes.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=8, color=color)
    axes.figure.colorbar(image, ax=axes, fraction=0.046)
    return finish(axes, path)


def plot_largest_confusions(
    matrix: Tensor | Array,  # [C, C] counts
    names: Sequence[str],  # C
    path: str | Path | None = None,
    *,
    misses: Tensor | Array | None = None,  # [C] counts
    most: int = 10,
    ax: Axes | None = None,
) -> Figure:
    """Draw the pairs of classes that are confused most, as shares of all pixels, largest first.

    A bar has the colour of the true class, and the square at its end that of the predicted one.

    Args:
        matrix: counts of (truth, prediction), for instance `ConfusionMatrix.matrix`.
        names: class names.
        path: a .png file to write; None writes none.
        misses: pixels of each class predicted as "no class".
        most: how many pairs; pairs that never occur are left out.
        ax: axes to draw into; None makes a figure.

    Raises:
        ValueError: if the matrix is not square, names or misses are not one per class, or nothing was counted.
    """
    counts = _counts(matrix, names, misses)
    of_class = counts.sum(axis=1)
    if not (total := counts.sum()):
        raise ValueError("matrix: expected pixels that were counted, got zeros only; was anything scored?")
    wrong = counts - np.pad(np.diag(np.diag(counts)), ((0, 0), (0, 1)))
    order = [divmod(int(i), counts.shape[1]) for i in np.argsort(-wrong.ravel(), kind="stable")[:most]]
    pairs = [(i, j) for i, j in order if wrong[i, j]]
    axes, rows = axes_for(ax, 7.2, 0.36 * max(len(pairs), 1) + 1.3), np.arange(len(pairs))
    share = np.array([100 * wrong[pair] / total for pair in pairs])
    if pairs:
        true, seen = np.array(pairs).T
        colors = palette(np.where(seen < len(names), seen, -1), names) / 255
        axes.barh(rows, share, color=palette(true, names) / 255, edgecolor=INK, linewidth=0.6, height=0.7)
        axes.scatter(share, rows, marker="s", s=90, color=colors, edgecolor=INK, linewidth=0.6, zorder=3)
    for row, (i, j) in enumerate(pairs):
        text = f"{share[row]:.2f} %, {100 * wrong[i, j] / of_class[i]:.0f} % of {names[i]}"
        axes.annotate(text, (share[row], row), (9, 0), textcoords="offset points", va="center", fontsize=8.5)
    axes.set_yticks(rows, [f"{names[i]} \N{RIGHTWARDS ARROW} {[*names, 'no class'][j]}" for i, j in pairs])
    title = f"Largest confusions: {share.sum():.1f} of {100 * wrong.sum() / total:.1f} % wrong pixels"
    axes.set(title=title, xlabel="% of all pixels (truth \N{RIGHTWARDS ARROW} prediction)")
    axes.set_xlim(0, 1.55 * max([1e-9, *share]))  # room for the texts
    axes.set_ylim(len(pairs) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return finish(axes, path)


def _counts(matrix: Tensor | Array, names: Sequence[str], misses: Tensor | Array | None) -> Array:  # [C, C + 1]
    """Counts of (truth, prediction), checked; the last column: no class."""
    check_shapes(("matrix", matrix, "C C"), ("misses", misses, "C"))
    counts = as_array(matrix, "matrix").astype(np.float64)
    check_class_names(names, len(counts), "matrix")
    return np.column_stack([counts, np.zeros(len(counts)) if misses is None else as_array(misses, "misses")])
