"""Draw selections in the scene: Gaussians in a colour per selection, oriented boxes, names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from .._check import check_range, check_shapes
from .._origin import choose_origin
from .._typed import typed
from ..gaussians import Gaussians
from ..labels import OrientedBox, Selection
from ..labels.color import LUMINANCE
from .cloud_colors import cloud_colors
from .clouds import CloudOptions, Style, add_cloud
from .legends import letters
from .meshes import draw_mesh
from .palette import palette
from .places import origin_of

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
LETTERS = 16  # pixels
GRAYS = (70, 225)  # black and white become these greys, paler than the selections
EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of `OrientedBox.corners` that differ along one axis: the third, the second, the first."""


class Selections(NamedTuple):
    """The actors of one picture of selections."""

    cloud: pv.Actor  # the Gaussians; `label` is the number of the selection, -1 = none
    boxes: pv.Actor
    names: Any


@typed
def add_boxes(
    plotter: pv.Plotter,
    boxes: Sequence[OrientedBox],
    *,
    labels: Sequence[int] | None = None,
    line_width: float = 3.0,
) -> pv.Actor:
    """Draw the edges of boxes in the palette's colours.

    Args:
        plotter: where to draw.
        boxes: B boxes.
        labels: their classes; None: 0 to B - 1.
        line_width: in pixels.

    Returns:
        The actor; its mesh's cells carry `box`, the index, `label` and `rgb`.

    Raises:
        ValueError: if there is no box, or not one label for each.
    """
    if not boxes:
        raise ValueError("boxes: expected at least one, got none; OrientedBox.around(means) makes one")
    classes = np.arange(len(boxes)) if labels is None else np.asarray(labels)
    if classes.shape != (len(boxes),):
        raise ValueError(f"labels: expected {len(boxes)} (one per box), got {classes.size}; give one for each")
    check_range("line_width", line_width, 0, closed=(False, False))
    import pyvista as pv

    corners = _corners(plotter, boxes)
    mesh = pv.line_segments_from_points(corners[:, np.array(EDGES)].reshape(-1, 3).astype(np.float32))
    mesh.cell_data["box"] = np.repeat(np.arange(len(boxes)), len(EDGES))
    mesh.cell_data["label"] = classes[mesh.cell_data["box"]]
    mesh.cell_data["rgb"] = palette(classes)[mesh.cell_data["box"]]
    return draw_mesh(plotter, mesh, scalars="rgb", rgb=True, line_width=line_width, lighting=False)


@typed
def add_names(
    plotter: pv.Plotter,
    boxes: Sequence[OrientedBox],
    names: Sequence[str],
    *,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Any:
    """Write a name over each box, in front of everything. All names are drawn, even if they overlap.

    Args:
        plotter: where to draw.
        boxes: B boxes.
        names: B names.
        up: the world's up: the name is on this side of the box.

    Raises:
        ValueError: if there is no box, or not one name for each.
    """
    if not boxes or len(names) != len(boxes):
        raise ValueError(f"names: expected {len(boxes)} (one per box, at least one), got {len(names)}; name each box")
    direction = np.asarray(up, dtype=np.float64)
    check_shapes(("up", direction, "3"))
    corners = _corners(plotter, boxes)
    height = (corners @ direction).max(axis=1) / (direction @ direction)
    centers = corners.mean(axis=1)
    tops = centers + np.outer(height - centers @ direction / (direction @ direction), direction)
    actor = plotter.add_point_labels(
        tops, list(names), shape="rounded_rect", shape_color=plotter.renderer.background_color, shape_opacity=0.6, margin=2,
        show_points=False, always_visible=True, font_size=LETTERS, text_color=letters(plotter), bold=True, pickable=False,
        reset_camera=False,
    )  # fmt: skip
    actor.GetMapper().SetPlaceAllLabels(True)  # otherwise VTK leaves out names that overlap
    return actor


@typed
def add_selections(
    plotter: pv.Plotter,
    gaussians: Gaussians,
    selections: Mapping[str, Selection],
    *,
    style: Style = "points",
    rest: bool = True,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    options: CloudOptions = CloudOptions(),  # noqa: B008  frozen
) -> Selections:
    """Draw each selection in its colour, with its oriented box and its name.

    A Gaussian in several selections has the colour of the last one.

    Args:
        plotter: where to draw.
        gaussians: the cloud of the selections.
        selections: by name, in the order of their colours.
        style: as in `add_cloud`.
        rest: also draw all other Gaussians, in grey; if the cloud has colours, with their brightness.
        up: the world's up: names are on this side.
        options: as in `add_cloud`.

    Raises:
        ValueError: if there is no selection, one is empty, or it is of another cloud.
        TypeError: if one is no selection.
    """
    if not selections:
        raise ValueError("selections: expected at least one, got none; pass {name: selection}")
    labels = torch.full((len(gaussians),), -1, dtype=torch.int64)
    boxes = []
    for number, (name, selection) in enumerate(selections.items()):
        if not isinstance(selection, Selection):
            raise TypeError(
                f"selections[{name!r}]: expected a Selection, got {type(selection).__name__}; Selection.of(mask) makes one"
            )
        check_shapes(("gaussians.means", gaussians.means, "N 3"), (f"selections[{name!r}].mask", selection.mask, "N"))
        if not selection:
            raise ValueError(
                f"selections[{name!r}]: expected at least one selected Gaussian, got none; lower the threshold or leave "
                "it out"
            )
        mask = selection.mask.cpu()
        labels[mask] = number
        boxes.append(selection.box(gaussians))
    origin_of(plotter, gaussians.origin)
    labels = labels.to(gaussians.means.device)
    shown = gaussians.replace(labels=labels)
    if not rest:
        shown = shown.select(labels >= 0)
    cloud = add_cloud(plotter, shown, color_by=_colors(shown), style=style, options=options)
    return Selections(cloud, add_boxes(plotter, boxes), add_names(plotter, boxes, list(selections), up=up))


def _corners(plotter: pv.Plotter, boxes: Sequence[OrientedBox]) -> Array:  # [B, 8, 3]
    """The corners of boxes, which are in the world, counted from the plotter's origin."""
    corners = torch.stack([box.corners.double().cpu() for box in boxes])
    return corners.numpy() - origin_of(plotter, choose_origin(corners.flatten(0, 1)))


def _colors(gaussians: Gaussians) -> Array:  # [N, 3] uint8
    """The palette's colours; Gaussians without a label get a grey as bright as their colour."""
    assert gaussians.labels is not None
    colors = palette(gaussians.labels)
    if gaussians.sh is None:
        return colors
    gray = GRAYS[0] + (GRAYS[1] - GRAYS[0]) / 255 * (cloud_colors(gaussians, "rgb").rgb @ np.array(LUMINANCE))
    none = gaussians.labels.cpu().numpy() < 0
    return np.where(none[:, None], np.rint(gray)[:, None], colors).astype(np.uint8)
