"""Plots of a codebook: similarity, usage, the nearest words of each codeword, and its growth (Figure 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_shapes, check_whole
from .._rows import unit_rows
from .._typed import typed
from ..labels import label_codewords
from ..quant.fit_codebook import CodebookFit
from .figures import (
    INK,
    LINES,
    Row,
    check_class_names,
    count_from_zero,
    draw_curve,
    finish,
    is_number,
    new_figure,
    panels_for,
)
from .palette import palette

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 150
"""The most codewords in one report: more rows are too small to read, or the picture is too large to open."""
ROW = 0.145
"""Height of a row in inches: letters of 7 points with a little room."""


class CodebookRows(NamedTuple):
    """The rows of a codebook report."""

    codewords: Tensor  # [R] int64, indices into the codebook in the order of the rows
    labels: Tensor  # [R] int64, class of each
    similarity: Tensor  # [R, R] cosine between codewords
    words: tuple[tuple[tuple[int, float], ...], ...]  # R times the nearest classes, with their cosines, best first

    def __repr__(self) -> str:
        return short_repr(self)


def codebook_rows(
    codewords: Tensor,  # [K, D]
    embeddings: Tensor,  # [C, D]
    *,
    usage: Tensor | None = None,  # [K]
    words: int = 3,
) -> CodebookRows:
    """Order codewords for reading: by class, and within a class by usage (without `usage`, in book order).

    Args:
        codewords: the codebook S.
        embeddings: one row per class, in the same space.
        usage: number of features of each codeword, for instance `CodebookFit.usage`. At most 150 codewords are kept: the
            most used, or without usage the first.
        words: how many nearest classes of each codeword to name.

    Raises:
        ValueError: if shapes disagree, `words` is below 1, or a number is not finite.
    """
    check_shapes(("codewords", codewords, "K D"), ("embeddings", embeddings, "C D"), ("usage", usage, "K"))
    check_whole("words", words, 1)
    book = codewords.detach()
    found = label_codewords(book, embeddings)
    used = torch.arange(len(book), 0, -1) if usage is None else usage.detach().cpu()
    kept = used.argsort(descending=True, stable=True)[:SHOWN]
    order = kept[found.labels.cpu()[kept].argsort(stable=True)].to(book.device)
    unit = unit_rows(book[order].double())
    best = found.similarity[order].sort(dim=1, descending=True, stable=True)
    nearest = tuple(
        tuple(zip(row, values, strict=True))
        for row, values in zip(best.indices[:, :words].tolist(), best.values[:, :words].tolist(), strict=True)
    )
    return CodebookRows(order.cpu(), found.labels[order].cpu(), (unit @ unit.T).cpu(), nearest)


def plot_codebook_report(
    codewords: Tensor,  # [K, D]
    names: Sequence[str],  # C
    embeddings: Tensor,  # [C, D]
    path: str | Path | None = None,
    *,
    usage: Tensor | None = None,  # [K] int
    history: Sequence[Row] = (),
    words: int = 3,
) -> Figure:
    """Draw a codebook in one figure: similarity matrix, usage, nearest words of each codeword, and growth below.

    Rows are codewords, ordered by their class (the nearest text, Sec. 3.4) and within it by usage. Classes have the
    colours of `palette`. Usage is logarithmic, with "unused" for codewords without features. The figure's size depends on
    the number of codewords, so it takes no `ax`.

    Args:
        codewords: the codebook S, for instance `Codebook.codewords`.
        names: class names, for instance `LabelSet.names`.
        embeddings: one row per class, for instance `LabelSet.embeddings`.
        path: a .png file to write; None writes none.
        usage: number of features of each codeword (`CodebookFit.usage`); without it there is no such panel.
        history: `CodebookFit.history`; without it there is no growth panel.
        words: how many nearest classes of each codeword to name.

    Raises:
        ValueError: if shapes or names disagree, or the history has no `size`.
    """
    check_shapes(("embeddings", embeddings, "C D"))
    check_class_names(names, len(embeddings), "embeddings")
    rows = codebook_rows(codewords, embeddings, usage=usage, words=words)
    side = max(3.6, ROW * len(rows.codewords))
    longest = max(len(_words(row, names)) for row in rows.words)
    widths = [side, 0.0 if usage is None else 1.8, 0.6 + 0.056 * longest]
    panels = [width for width in widths if width]
    heights = [side + 0.9, 2.7] if history else [side + 0.9]
    figure = new_figure(sum(panels) + 2.6, sum(heights))
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
    upper, lower = parts[0, 0], parts[-1, 0]
    first, *others = upper.subplots(1, len(panels), width_ratios=panels, sharey=True)
    _draw_similarity(first, rows, names)
    if usage is not None:
        _draw_usage(others[0], usage.detach().cpu()[rows.codewords].numpy(), rows, names)
    _draw_words(others[-1], rows, names)
    count = f"{len(codewords)} codewords"
    if len(rows.codewords) < len(codewords):
        count += f", the {'first' if usage is None else 'most used'} {len(rows.codewords)} shown"
    figure.suptitle(f"Codebook: {count}")
    if history:
        _draw_growth(lower.subplots(1, 3), {"": history})
    return finish(first, path)


@typed
def plot_codebook_growth(
    histories: Mapping[str, Sequence[Row] | CodebookFit] | Sequence[Row] | CodebookFit,
    path: str | Path | None = None,
    *,
    ax: Sequence[Axes] | np.ndarray[Any, Any] | None = None,
) -> Figure:
    """Draw how codebooks grew, a line per scene (Figure 6): size, codewords added and pruned, and coverage.

    Args:
        histories: scene name to a `CodebookFit` or its history, or one of them alone.
        path: a .png file to write; None writes none.
        ax: three axes to draw into; None makes a figure.

    Raises:
        ValueError: if there is no scene, a history has no `size`, or there are fewer than three axes.
    """
    if not isinstance(histories, Mapping):
        histories = {"": histories}
    if not histories:
        raise ValueError("histories: expected at least one scene, got none; pass {name: CodebookFit.history}")
    rows = {name: one.history if isinstance(one, CodebookFit) else one for name, one in histories.items()}
    axes, own = panels_for(ax, 3, 3, 12.6, 3.6)
    _draw_growth(axes, rows)
    if any(rows):
        lines, names = axes[0].get_legend_handles_labels()
        if own:
            finish(axes[0], None).legend(lines, names, loc="outside right upper", frameon=False)
        else:
            axes[0].legend(lines, names, frameon=False)
    return finish(axes[0], path)


def _draw_similarity(axes: Axes, rows: CodebookRows, names: Sequence[str]) -> None:
    """The matrix, a stripe in each class's colour along its left side, and lines between classes."""
    R = len(rows.codewords)
    similarity, labels = rows.similarity.numpy(), rows.labels.numpy()
    low = min(0.9, np.floor(10 * similarity.min()) / 10)
    image = axes.imshow(similarity, cmap="cividis", vmin=low, vmax=1, aspect="auto", interpolation="nearest")
    axes.figure.colorbar(image, ax=axes, location="left", fraction=0.03, pad=0.02, label="cosine similarity")
    stripe = axes.inset_axes((-0.025, 0, 0.018, 1))
    stripe.imshow(palette(labels, names)[:, None], aspect="auto", interpolation="nearest")
    stripe.set_axis_off()
    starts = np.flatnonzero(np.diff(labels, prepend=labels[0] - 1))
    for start in starts[1:]:
        axes.axhline(start - 0.5, color="white", linewidth=0.5)
        axes.axvline(start - 0.5, color="white", linewidth=0.5)
    middles = (starts + np.append(starts[1:], R) - 1) / 2
    axes.set_xticks(middles, [_name(int(labels[start]), names) for start in starts], rotation=90, fontsize=8)
    axes.set_yticks([])
    axes.set_title("similarity of codewords, by class", fontsize=10)


def _draw_usage(axes: Axes, used: np.ndarray[Any, Any], rows: CodebookRows, names: Sequence[str]) -> None:
    colors = palette(rows.labels, names) / 255
    length = np.maximum(used - 0.5, 0)  # bars start at 0.5 and end at their count, so that a count of 1 can be seen
    axes.barh(range(len(used)), length, left=0.5, color=colors, edgecolor=INK, linewidth=0.4, height=0.8)
    axes.set_xscale("log")
    axes.set_xlim(0.5, max(10.0, 2 * float(used.max())))
    for row in np.flatnonzero(used <= 0).tolist():
        axes.text(0.6, row, "unused", va="center", fontsize=7)
    axes.set_title("features (log)", fontsize=10)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", left=False)


def _draw_words(axes: Axes, rows: CodebookRows, names: Sequence[str]) -> None:
    """One line per codeword: its number, a patch of its class's colour, and the nearest classes with their cosines."""
    axes.set_axis_off()
    axes.set_title("codeword: nearest words (cosine)", fontsize=10, loc="left")
    colors = palette(rows.labels, names) / 255
    beside: dict[str, Any] = {
        "xycoords": axes.get_yaxis_transform(),
        "textcoords": "offset points",
        "va": "center",
        "fontsize": 7,
    }
    for row, (codeword, words) in enumerate(zip(rows.codewords.tolist(), rows.words, strict=True)):
        axes.annotate(str(codeword), (0, row), (20, 0), ha="right", **beside)
        axes.annotate("\N{BLACK SQUARE}", (0, row), (24, 0.5), color=colors[row], **beside)
        axes.annotate(_words(words, names), (0, row), (35, 0), **beside)


def _draw_growth(axes: Sequence[Axes], histories: Mapping[str, Sequence[Row]]) -> None:
    """Size, codewords added and (dashed) pruned, and coverage, over epochs."""
    drawn: list[list[float]] = [[], [], []]
    for i, (name, history) in enumerate(histories.items()):
        if not any(is_number(row.get("size")) for row in history):
            argument = f"histories[{name!r}]" if name else "history"
            raise ValueError(
                f"{argument}: expected rows with epoch and size, got {list(history)[:1]}; pass CodebookFit.history"
            )
        color = LINES[i] if len(histories) <= len(LINES) else palette(np.array(i)) / 255
        for panel, key in ((0, "size"), (1, "added"), (1, "pruned"), (2, "coverage")):
            points = [(row.get("epoch", at), row[key]) for at, row in enumerate(history) if is_number(row.get(key))]
            if points:
                x, y = zip(*points, strict=True)
                style = "--" if key == "pruned" else "-"
                label = name if panel != 1 else key
                draw_curve(axes[panel], x, y, i, color=color, linestyle=style, label=label)
                drawn[panel] += y
    for panel, title in enumerate(("size K", "codewords added and pruned (dashed)", "coverage")):
        axes[panel].set_visible(bool(drawn[panel]))
        axes[panel].set(title=title, xlabel="epoch")
        axes[panel].title.set_fontsize(10)
        if panel < 2:
            count_from_zero(axes[panel], drawn[panel])
    axes[2].set_ylim(0, 1.03)


def _words(words: Sequence[tuple[int, float]], names: Sequence[str]) -> str:
    return ", ".join(f"{names[label]} {value:.2f}" for label, value in words)


def _name(label: int, names: Sequence[str]) -> str:
    return "no class" if label < 0 else names[label]
