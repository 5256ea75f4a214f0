"""Titles and legends in a 3-D picture: class names with colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .._check import as_array
from ..gaussians import Gaussians
from ..labels.selection import class_names
from ..labels.transfer import as_cloud
from .pictures import LEGEND_INK, LEGEND_PAPER, draw_legend

if TYPE_CHECKING:
    import pyvista as pv

    from ..fields import SemanticField

MARGIN = 10  # pixels from a corner
DARK = 0.5  # brightness of a background; below it, letters are white
LETTERS = 14  # pixels, in windows up to 770 pixels high; higher windows have larger letters
SMALLEST = 9  # pixels: the smallest size that can be read


def add_legend(plotter: pv.Plotter, gaussians: Gaussians | SemanticField) -> Any:
    """List the classes of a labelled cloud, or of a field, by name and colour, in the lower left corner of the active subplot.

    It is a small picture: pyvista's own legend writes each name in its colour, for instance yellow on white. If the subplot
    is too low for all classes, the letters shrink to at least 9 pixels, then the list gets several columns.

    Colours are those in which `add_cloud` draws it. `plotter.remove_actor` removes what is returned.

    Raises:
        ValueError: if there is no label.
    """
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    gaussians = as_cloud(gaussians, labelled=True)
    present, names = np.unique(as_array(gaussians.labels)), class_names(gaussians)
    if present.size == 0:
        raise ValueError("gaussians: expected at least one label to list, got none; leave the legend out")
    _, bottom, _, top = plotter.renderer.GetViewport()
    room = round((top - bottom) * plotter.window_size[1])
    for size in range(max(LETTERS, round(room / 55)), SMALLEST - 1, -1):
        picture = draw_legend(present, names, size=size, height=room - 2 * MARGIN if size == SMALLEST else None)
        if len(picture) <= room - 2 * MARGIN:
            break
    height, width, _ = picture.shape
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
    image.set_active_scalars("rgb")
    mapper, actor = vtkImageMapper(), vtkActor2D()
    mapper.SetInputData(image)
    mapper.SetColorWindow(255)  # bytes stay as they are
    mapper.SetColorLevel(127.5)
    actor.SetMapper(mapper)
    actor.SetPosition(MARGIN, MARGIN)
    plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)
    return actor


def add_title(plotter: pv.Plotter, title: str) -> pv.CornerAnnotation:
    """Write a title over the active subplot, in a colour that can be read on its background."""
    return plotter.add_text(title, position="upper_edge", font_size=10, color=letters(plotter))


def letters(plotter: pv.Plotter) -> tuple[int, int, int]:
    """A text colour that can be read on the active subplot's background."""
    return LEGEND_PAPER if np.mean(plotter.renderer.GetBackground()) < DARK else LEGEND_INK
