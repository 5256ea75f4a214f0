"""A panel beside a plotter's subplots: it keeps its width when the window changes, and is drawn without the clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from .panel import WIDTH, Panel, PanelView, Spot, draw_panel

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
LEAST = 200  # pixels that the subplots keep, however narrow the window


class PanelPane:
    """Makes room on the right of a plotter's subplots, which keep their proportions, for a panel.

    Args:
        plotter: its window is made wider by the panel.
        view: asked for what the panel says each time it is drawn.
    """

    def __init__(self, plotter: pv.Plotter, view: Callable[[], PanelView]) -> None:
        from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper, vtkRenderer

        self.plotter, self.view = plotter, view
        self.panel = Panel(np.zeros((0, 0, 3), np.uint8), [], 0)
        window = plotter.render_window
        everything = [window.GetRenderers().GetItemAsObject(i) for i in range(window.GetRenderers().GetNumberOfItems())]
        self._viewports = [(renderer, renderer.GetViewport()) for renderer in everything]  # lines between subplots, too
        self._size: tuple[int, int] | None = None
        self._left, self._stale, self._away = 0, True, False
        self._removed = False
        self._mapper = vtkImageMapper()
        self._mapper.SetColorWindow(255)  # bytes as they are
        self._mapper.SetColorLevel(127.5)
        actor = vtkActor2D()
        actor.SetMapper(self._mapper)
        self._renderer = vtkRenderer()
        self._renderer.AddActor(actor)
        self._renderer.InteractiveOff()
        width, height = plotter.window_size
        window.AddRenderer(self._renderer)
        most = plotter.render_window.GetScreenSize()  # a window that is larger hides the panel
        plotter.window_size = [min(width + WIDTH, most[0] or width + WIDTH), min(height, most[1] or height)]
        self._observer = window.AddObserver("StartEvent", self._before_frame)

    def remove(self) -> None:
        """Give the room back to the subplots; afterwards nothing here draws. A second time does nothing."""
        window = self.plotter.render_window
        if window is None or self._removed:
            return
        self._removed = True
        window.RemoveObserver(self._observer)
        window.RemoveRenderer(self._renderer)
        for renderer, viewport in self._viewports:
            renderer.SetViewport(*viewport)
        width, height = self.plotter.window_size
        self.plotter.window_size = [max(width - WIDTH, min(LEAST, width)), height]

    def find(self, x: float, y: float) -> tuple[bool, Spot | None, float]:
        """Whether a point of the window (y from the top) is in the panel, what lies there, and x in the panel."""
        inside = not self._away and x >= self._left
        return inside, self.panel.find(x - self._left, y) if inside else None, x - self._left

    def refresh(self, clouds: bool = False) -> None:
        """Draw the panel again, alone (20 ms instead of a frame of Gaussians) or with the clouds.

        Before the first frame and after the last this does nothing.
        """
        self._stale = True
        window = self.plotter.render_window
        if window is None or self._removed:
            return
        if clouds:
            self.plotter.render()
        elif self._size is not None:  # a frame is there, of which most can stay
            drawn = [renderer for renderer in self.plotter.renderers if renderer.GetDraw()]
            for renderer in drawn:
                renderer.DrawOff()
            try:
                window.Render()
            finally:
                for renderer in drawn:
                    renderer.DrawOn()

    @contextmanager
    def away(self) -> Iterator[None]:
        """The subplots fill the window, as for a picture of them; the next frame brings the panel back."""
        self._away, self._size = True, None
        self.plotter.render_window.Render()  # pyvista's pictures of a window are of its last frame
        try:
            yield
        finally:
            self._away, self._size = False, None

    def _before_frame(self, *_: Any) -> None:
        """Follow the window's size, and paint what has changed."""
        width, height = self.plotter.render_window.GetSize()
        if (width, height) != self._size:
            self._size, self._stale = (width, height), True
            self._left = width if self._away else max(width - WIDTH, min(LEAST, width))
            for renderer, (left, low, right, high) in self._viewports:
                renderer.SetViewport(left * self._left / width, low, right * self._left / width, high)
            self._renderer.SetViewport(self._left / width, 0, 1, 1)
            self._renderer.SetDraw(not self._away and self._left < width)
        if self._stale and not self._away:
            self._stale = False
            self.panel = draw_panel(self.view(), height)
            self._mapper.SetInputData(_as_image(self.panel.picture))


def _as_image(picture: Array) -> Any:  # [H, W, 3] uint8
    import pyvista as pv

    height, width, _ = picture.shape
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
    image.set_active_scalars("rgb")
    return image
