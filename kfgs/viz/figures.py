"""Helpers for all plots: figures without matplotlib's global state, line colours, PNG files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._files import as_path, atomic_path
from .pictures import DRAWN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = np.ndarray[Any, Any]
Row = Mapping[str, Any]
"""One row of a recorded history: numbers by name."""
LINES = np.array([[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [230, 159, 0]]) / 255
"""Okabe and Ito's darker colours, which are readable as lines."""
INK = (0.08, 0.08, 0.08)
DPI = 110


def new_figure(width: float, height: float) -> Figure:
    """An empty figure; sizes in inches. Needs matplotlib, which pyvista installs."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("plots need matplotlib, which pyvista brings; run: pip install matplotlib") from error
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def axes_for(ax: Axes | None, width: float, height: float) -> Axes:
    """The caller's axes, or those of a new figure."""
    return new_figure(width, height).add_subplot() if ax is None else ax


def panels_for(
    ax: Sequence[Axes] | Array | None, count: int, columns: int, width: float, height: float
) -> tuple[list[Axes], bool]:
    """`count` axes, and whether they belong to a new figure; a ValueError if the caller gives fewer."""
    if ax is None:
        figure = new_figure(width, height)
        return [figure.add_subplot(-(-count // columns), columns, i + 1) for i in range(count)], True
    given = np.atleast_1d(np.asarray(ax, dtype=object)).ravel().tolist()
    if len(given) < count:
        raise ValueError(
            f"ax: expected at least {count} axes (one per panel), got {len(given)}; make more, or pass None"
        )
    return given[:count], False


def finish(axes: Axes, path: str | Path | None) -> Figure:
    """The figure of the axes, written as a PNG file if there is a path."""
    figure: Figure = axes.figure.canvas.figure  # the whole figure, also for axes in a subfigure
    if path is not None:
        save_figure(figure, path)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a PNG file, whole or not at all. Raises a ValueError if the name does not end in .png."""
    if as_path(path).suffix.lower() != ".png":
        raise ValueError(f"path: expected a name that ends in .png, got {as_path(path).name!r}; rename it")
    with atomic_path(path) as temporary:
        # tight: otherwise labels beside square pictures are cut
        figure.savefig(temporary, format="png", bbox_inches="tight", metadata=DRAWN)


def add_legend_below(axes: Axes, own: bool) -> None:
    """Put a legend under our figure (`own`), or under the caller's axes."""
    if own:
        finish(axes, None).legend(loc="outside lower center", ncols=2, frameon=False)
    else:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)


def draw_curve(axes: Axes, x: Sequence[float], y: Sequence[float], panel: int, **options: Any) -> None:
    """Draw a line in the colour of its panel, with dots if there are few values."""
    marker = "o" if len(x) < 40 else None
    style = {"color": LINES[panel % len(LINES)], "marker": marker, "markersize": 3, "linewidth": 1.5}
    axes.plot(x, y, clip_on=False, zorder=3, **style | options)  # not clipped: zeros show over the frame
    axes.grid(alpha=0.3)
    if all(float(value).is_integer() for value in x):
        axes.locator_params(axis="x", integer=True)


def count_from_zero(axes: Axes, y: Sequence[float]) -> None:
    """Scale an axis of whole numbers from zero, with room above the highest, even if all are zero."""
    axes.set_ylim(0, 1.06 * max([1, *y]))
    axes.locator_params(axis="y", integer=True)


def is_number(value: object) -> bool:
    """Whether a recorded value can be drawn."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_class_names(names: Sequence[str], count: int, source: str) -> None:
    """Raise a ValueError unless there is one name for each class."""
    if len(names) != count:
        raise ValueError(
            f"names: expected {count} class names (from {source}), got {len(names)}; pass one name for each class"
        )
