"""Show the panel next to a plotter's subplots: its width is fixed, and it can be redrawn without the clouds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from ..legends import picture_actor, set_picture
from .panel import WIDTH, Panel, PanelView, Spot, draw_panel

if TYPE_CHECKING:
    import pyvista as pv

LEAST = 200  # pixels left for the subplots in a narrow window


class PanelPane:
    """A panel on the right of a plotter's subplots, which keep their proportions.

    Args:
        plotter: its window becomes wider by the panel.
        view: returns the panel's content; called at each drawing.
    """

    def __init__(self, plotter: pv.Plotter, view: Callable[[], PanelView]) -> None:
        from vtkmodules.vtkRenderingCore import vtkRenderer

        self.plotter, self.view = plotter, view
        self.panel = Panel(np.zeros((0, 0, 3), np.uint8), [], 0)
        window = plotter.render_window
        everything = [window.GetRenderers().GetItemAsObject(i) for i in range(window.GetRenderers().GetNumberOfItems())]
        self._viewports = [(renderer, renderer.GetViewport()) for renderer in everything]  # also the separating lines
        self._size: tuple[int, int] | None = None
        self._left, self._stale, self._away = 0, True, False
        self._removed = False
        self._actor = picture_actor()
        self._renderer = vtkRenderer()
        self._renderer.AddActor(self._actor)
        self._renderer.InteractiveOff()
        width, height = plotter.window_size
        window.AddRenderer(self._renderer)
        most = plotter.render_window.GetScreenSize()  # in a window larger than the screen the panel could not be seen
        plotter.window_size = [min(width + WIDTH, most[0] or width + WIDTH), min(height, most[1] or height)]
        self._observer = window.AddObserver("StartEvent", self._before_frame)

    def remove(self) -> None:
        """Remove the panel and give its room to the subplots; a second call does nothing."""
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
        """For a point of the window (y from the top): is it in the panel, which spot is there, and its x in the panel."""
        inside = not self._away and x >= self._left
        return inside, self.panel.find(x - self._left, y) if inside else None, x - self._left

    def refresh(self, clouds: bool = False) -> None:
        """Redraw the panel, alone (20 ms) or with the clouds. Does nothing before the first frame or after `remove`."""
        self._stale = True
        window = self.plotter.render_window
        if window is None or self._removed:
            return
        if clouds:
            self.plotter.render()
        elif self._size is not None:  # there was a frame: keep its clouds
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
        """Hide the panel for a while, for a picture of the subplots alone; the next frame brings it back."""
        self._away, self._size = True, None
        self.plotter.render_window.Render()  # pyvista takes its pictures from the last frame
        try:
            yield
        finally:
            self._away, self._size = False, None

    def _before_frame(self, *_: Any) -> None:
        """Follow the window's size, and redraw the panel if it changed."""
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
            set_picture(self._actor, self.panel.picture)
