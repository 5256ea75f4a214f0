"""Quality against storage, the picture behind Table 1: a point for each method, with its name beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .plots import INK, LINES, _figure, _save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_quality_storage(
    points: Mapping[str, tuple[float, float]],
    path: str | Path,
    *,
    reference: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Draw segmentation quality against size: mIoU in per cent over MiB (logarithmic), every point with its name.

    Args:
        points: name to (storage in MiB, mIoU in [0, 1]).
        path: a .png file.
        reference: published points to compare with, drawn hollow: for instance rows of Table 1, whose "MB" are MiB.

    Raises:
        ValueError: if there is no point, a size is not positive and finite, or an mIoU lies outside [0, 1].
    """
    groups = [(points, LINES[0], "o", "measured"), (reference or {}, "none", "s", "reference")]
    if not points and not reference:
        raise ValueError("points: expected at least one name with (MiB, mIoU), got none; pass what was measured")
    figure = _figure(7.6, 5.2)
    axes = figure.add_subplot()
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
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    _name_points(figure, axes, places)
    _save(figure, path)


def _quality_point(name: str, pair: tuple[float, float]) -> tuple[float, float]:
    """(MiB, per cent) of one point, checked."""
    mib, miou = pair
    if not (0 < mib < float("inf") and 0 <= miou <= 1):
        raise ValueError(
            f"points[{name!r}]: expected (MiB above 0, mIoU in [0, 1]), got ({mib!r}, {miou!r}); "
            "give sizes in MiB and mIoU as a fraction, in this order"
        )
    return float(mib), 100 * float(miou)


def _name_points(figure: Figure, axes: Axes, places: Sequence[tuple[str, float, float]]) -> None:
    """Write each name beside its point, on the first side where it covers neither a point nor an earlier name."""
    figure.draw_without_rendering()  # the layout decides where points are
    figure.set_layout_engine("none")
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
