"""Draw oriented boxes with names, for instance of the parts of a selection."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._origin import choose_origin
from ..labels import OrientedBox, Part
from ..labels.selection import class_names
from .legends import letters
from .palette import palette
from .plotter import draw_mesh, origin_of

if TYPE_CHECKING:
    import pyvista as pv

LETTERS = 16  # pixels
EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of `OrientedBox.corners` that differ along one axis: the third, the second, the first."""


def add_boxes(
    plotter: pv.Plotter,
    boxes: Sequence[OrientedBox | Part],
    *,
    names: Sequence[str] = (),
    up: Sequence[float] = (0.0, 0.0, 1.0),
    line_width: float = 3.0,
) -> pv.Actor:
    """Draw the edges of boxes, and a name over each, in front of everything: parts in the colour of their class.

    Args:
        plotter: where to draw.
        boxes: B boxes, or parts with classes (`connected_parts(field, "chair")`).
        names: B names; () draws none over boxes, and "chair 1", "chair 2", ... over parts.
        up: the world's up: the name is on this side of the box.
        line_width: in pixels.

    Returns:
        The actor of the edges; its mesh's cells carry `box`, the index, `label` and `rgb`.

    Raises:
        ValueError: if there is no box, or not a name for each.
    """
    import pyvista as pv

    if not boxes:
        raise ValueError("boxes: expected at least one, got none; OrientedBox.around(means) makes one")
    if len(names) not in (0, len(boxes)):
        raise ValueError(f"names: expected {len(boxes)} (one per box), got {len(names)}; leave them out, or name each")
    classes, colors, titles = np.arange(len(boxes)), palette(np.arange(len(boxes))), list(names)
    for i, box in enumerate(boxes):
        if isinstance(box, Part) and box.gaussians.labels is not None:
            classes[i], words = int(box.gaussians.labels.mode().values), class_names(box.gaussians)
            colors[i] = palette(classes[i], words)
            titles += [] if names else [f"{words[classes[i]]} {i + 1}"]
    solid = [box.box if isinstance(box, Part) else box for box in boxes]
    corners = torch.stack([box.corners.double().cpu() for box in solid])  # [B, 8, 3] in the world
    places = corners.numpy() - origin_of(plotter, choose_origin(corners.flatten(0, 1)))
    mesh = pv.line_segments_from_points(places[:, np.array(EDGES)].reshape(-1, 3).astype(np.float32))
    which = np.repeat(np.arange(len(boxes)), len(EDGES))
    mesh.cell_data.update({"box": which, "label": classes[which], "rgb": colors[which]})
    if titles:
        axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
        centers, heights = places.mean(axis=1), places @ axis
        tops = centers + np.outer(heights.max(axis=1) - heights.mean(axis=1), axis)
        actor = plotter.add_point_labels(
            tops, titles, shape="rounded_rect", shape_color=plotter.renderer.background_color, shape_opacity=0.6,
            margin=2, show_points=False, always_visible=True, font_size=LETTERS, text_color=letters(plotter), bold=True,
            pickable=False, reset_camera=False,
        )  # fmt: skip
        actor.GetMapper().SetPlaceAllLabels(True)  # otherwise VTK leaves out names that overlap
    return draw_mesh(plotter, mesh, scalars="rgb", rgb=True, line_width=line_width, lighting=False)
