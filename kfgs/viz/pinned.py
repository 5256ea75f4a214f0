"""A small flat picture in a corner of a subplot, drawn for the size that the subplot has."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
MARGIN = 10  # pixels from the corner


def pin_picture(
    plotter: pv.Plotter,
    draw: Callable[[int, int], Array],  # (height, width) of the subplot, pixels -> [h, w, 3] uint8
    corner: Literal["left", "right"] = "left",
) -> Any:
    """Put a picture into the lower left or the lower right corner of the active subplot.

    It is drawn pixel by pixel, and drawn anew when the subplot's size changes. The next frame shows it: none is drawn here,
    which may take long.

    Args:
        plotter: where to draw.
        draw: makes the picture, best no larger than the subplot without a margin of 10 pixels on each side.
        corner: which.

    Returns:
        The actor; `plotter.remove_actor` takes it away.
    """
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    mapper = vtkImageMapper()
    mapper.SetColorWindow(255)  # bytes as they are
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    pinned = _Pinned(plotter.renderer, actor, draw, corner)
    pinned.draw(*_size_of(plotter))
    plotter.add_actor(actor, reset_camera=False, pickable=False, render=False)
    pinned.tag = plotter.renderer.AddObserver("StartEvent", pinned.before_frame)
    return actor


class _Pinned:
    """Follows the size of its subplot as long as its actor is there."""

    def __init__(self, renderer: Any, actor: Any, make: Callable[[int, int], Array], corner: str) -> None:
        self.renderer, self.actor, self.make, self.corner = renderer, actor, make, corner
        self.size: tuple[int, int] | None = None
        self.tag = 0

    def before_frame(self, *_: Any) -> None:
        """The renderer is about to draw."""
        if not self.renderer.HasViewProp(self.actor):
            self.renderer.RemoveObserver(self.tag)
            return
        width, height = self.renderer.GetSize()
        self.draw(height, width)

    def draw(self, height: int, width: int) -> None:
        """Make the picture for a subplot of this size, unless it is there already."""
        if self.size == (height, width):
            return
        self.size = (height, width)
        picture = self.make(height, width)
        import pyvista as pv

        rows, columns, _ = picture.shape
        image = pv.ImageData(dimensions=(columns, rows, 1))
        image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
        image.set_active_scalars("rgb")
        self.actor.GetMapper().SetInputData(image)
        left = MARGIN if self.corner == "left" else max(width - columns - MARGIN, 0)
        self.actor.SetPosition(left, MARGIN)


def _size_of(plotter: pv.Plotter) -> tuple[int, int]:
    """(height, width) that the active subplot will have, also before the first frame."""
    width, height = plotter.window_size
    x0, y0, x1, y1 = plotter.renderer.GetViewport()
    return max(round((y1 - y0) * height), 1), max(round((x1 - x0) * width), 1)
