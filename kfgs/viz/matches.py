"""Draw the transfer of labels by distance (Sec. 3.4): who gave a label to whom, and who got none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch

from .._check import as_array, check_choice, check_shapes, check_whole
from .._typed import typed
from ..gaussians import Gaussians
from ..labels import Transfer
from .frusta import evenly
from .legends import add_legend
from .meshes import draw_mesh
from .palette import palette
from .places import placed

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
LINES = 500  # more lines than this hide the clouds
MATCHED, AMBIGUOUS, ORPHANED = 0, 1, 2
STATE_NAMES = ("matched", "ambiguous", "orphaned")
STATE_COLORS = np.array([[86, 180, 233], [213, 94, 0], [0, 0, 255]], np.uint8)  # every eye can tell them apart


class Matches(NamedTuple):
    """The actors of one picture of a transfer."""

    points: pv.Actor  # the destinations
    lines: pv.Actor | None  # to their sources; None where nothing was labelled
    legend: Any


@typed
def match_states(transfer: Transfer) -> Array:  # [N] int64
    """The state of each destination: 0 matched, 1 ambiguous (labelled, but its sources disagree), 2 orphaned (no label)."""
    labelled = as_array(transfer.labels) >= 0
    return np.where(labelled, np.where(as_array(transfer.disagree), AMBIGUOUS, MATCHED), ORPHANED)


@typed
def add_matches(
    plotter: pv.Plotter,
    src: Gaussians,
    dst: Gaussians,
    transfer: Transfer,
    *,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sample: int = LINES,
    point_size: float = 3.0,
    line_width: float = 1.0,
) -> Matches:
    """Draw the destinations as matched, ambiguous or orphaned points, lines to their sources, and how many of each.

    Draw the sources with `add_cloud`. Lines are as short as lambda, so use `shift` to move the destinations aside.

    Args:
        plotter: where to draw.
        src: the Gaussians that labels came from.
        dst: the Gaussians that received them.
        transfer: the result of `transfer_labels` for these two.
        shift: added to the destinations' positions, world units.
        sample: the most lines, evenly chosen among the labelled destinations; the legend says how many.
        point_size: in pixels.
        line_width: in pixels.

    Returns:
        The actors. Points carry `state` (0, 1, 2 as in `match_states`), `label`, `distance` and `rgb`; lines as in
        `add_transfer`.

    Raises:
        ValueError: if the transfer belongs to other clouds.
    """
    check_shapes(("dst.means", dst.means, "N 3"), ("transfer.labels", transfer.labels, "N"))
    src, dst = placed(plotter, src), placed(plotter, dst)
    moved = dst.replace(means=dst.means + torch.as_tensor(shift).to(dst.means))
    states = match_states(transfer)
    import pyvista as pv

    points = pv.PolyData(as_array(moved.means).astype(np.float32))
    points["state"], points["label"] = states, as_array(transfer.labels)
    points["distance"] = as_array(transfer.distances)
    points["rgb"] = _state_colors(states)
    dots = draw_mesh(plotter, points, style="points", scalars="rgb", rgb=True, point_size=point_size, lighting=False)
    lines = None
    if (states != ORPHANED).any():
        lines = add_transfer(plotter, src, moved, transfer, color_by="state", sample=sample, line_width=line_width)
    legend = add_legend(plotter, np.unique(states), _state_names(states, sample), colors=STATE_COLORS)
    return Matches(dots, lines, legend)


@typed
def add_transfer(
    plotter: pv.Plotter,
    src: Gaussians,
    dst: Gaussians,
    transfer: Transfer,
    *,
    color_by: Literal["label", "state"] = "label",
    sample: int = LINES,
    line_width: float = 1.0,
) -> pv.Actor:
    """Draw a line from each labelled destination to the source of its label.

    Lines are as short as lambda. To see them, move one cloud aside (`dst.replace(means=dst.means + shift)`) before
    drawing it and its lines. Cells carry `label`, `state`, `source`, `destination`, `distance` and `rgb`.

    Args:
        plotter: where to draw.
        src: the Gaussians that labels came from.
        dst: the Gaussians that received them.
        transfer: the result of `transfer_labels` for these two.
        color_by: the palette of labels, or whether sources agree (see `match_states`).
        sample: the most lines, evenly chosen among the labelled destinations.
        line_width: in pixels.

    Raises:
        ValueError: if the transfer belongs to other clouds, or nothing was labelled.
    """
    check_choice("color_by", color_by, ("label", "state"))
    check_shapes(("dst.means", dst.means, "N 3"), ("transfer.labels", transfer.labels, "N"))
    check_whole("sample", sample, 1)
    src, dst = placed(plotter, src), placed(plotter, dst)
    labelled = np.flatnonzero(as_array(transfer.labels) >= 0)
    if labelled.size == 0:
        raise ValueError(
            f"transfer: expected labelled Gaussians to draw, got none within {transfer.distance:g}; raise the distance"
        )
    chosen = labelled[evenly(labelled.size, sample)]
    sources = as_array(transfer.sources)[chosen]
    if sources.max() >= len(src):
        raise ValueError(
            f"transfer: expected sources below {len(src)} (from src), got {sources.max()}; pass its own clouds"
        )
    import pyvista as pv

    ends = np.stack([as_array(dst.means)[chosen], as_array(src.means)[sources]], axis=1).reshape(-1, 3)
    labels, states = as_array(transfer.labels)[chosen], match_states(transfer)[chosen]
    lines = pv.line_segments_from_points(ends.astype(np.float32))
    lines.cell_data["label"], lines.cell_data["state"] = labels, states
    lines.cell_data["source"], lines.cell_data["destination"] = sources, chosen
    lines.cell_data["distance"] = as_array(transfer.distances)[chosen]
    lines.cell_data["rgb"] = palette(labels) if color_by == "label" else _state_colors(states)
    return draw_mesh(plotter, lines, scalars="rgb", rgb=True, line_width=line_width, lighting=False)


def _state_colors(states: Array) -> Array:  # [N] -> [N, 3] uint8
    return STATE_COLORS[states]


def _state_names(states: Array, sample: int) -> list[str]:
    """Each state with its count, for the legend."""
    counts = np.bincount(states, minlength=len(STATE_NAMES))
    names = [f"{name} {count:,}" for name, count in zip(STATE_NAMES, counts, strict=True)]
    labelled = int(counts[MATCHED] + counts[AMBIGUOUS])
    if labelled > sample:
        for state in (MATCHED, AMBIGUOUS):
            names[state] += f" (1 line in {labelled / sample:.3g})"
    return names
