"""A ring around a point of the world, drawn over everything, with a fixed size in pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

RADII = ((9.0, 5.0, (1.0, 1.0, 1.0)), (9.0, 2.5, (0.86, 0.0, 0.45)))
"""Radius and line width in pixels, and colour: a white ring below the red one, so that it shows on every cloud."""
SIDES = 48


class Ring:
    """A ring in one VTK renderer; hidden while its point is behind the camera, where VTK would mirror it."""

    def __init__(self, renderer: Any) -> None:
        self.renderer = renderer
        self.place: tuple[float, float, float] | None = None
        self.rings: list[Any] = []

    def move(self, place: tuple[float, float, float] | None) -> None:
        """Put the ring around a point; None hides it."""
        if place is not None and not self.rings:
            self.rings = [_ring(*parts) for parts in RADII]
            for ring in self.rings:
                self.renderer.AddViewProp(ring)
            self.renderer.AddObserver("StartEvent", self._frame)
        self.place = place
        for ring in self.rings:
            if place is not None:
                ring.GetPositionCoordinate().SetValue(*place)
        self._frame()

    def _frame(self, *_: Any) -> None:
        seen = False
        if self.place is not None:
            camera = self.renderer.GetActiveCamera()
            ahead = np.subtract(self.place, camera.GetPosition()) @ camera.GetDirectionOfProjection()
            seen = bool(ahead > 0 or camera.GetParallelProjection())
        for ring in self.rings:
            ring.SetVisibility(seen)


def _ring(radius: float, width: float, color: tuple[float, float, float]) -> Any:
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkPolyDataMapper2D

    angles = np.linspace(0, 2 * np.pi, SIDES + 1)
    circle = pv.MultipleLines(radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1))
    mapper = vtkPolyDataMapper2D()
    mapper.SetInputData(circle)
    ring = vtkActor2D()
    ring.SetMapper(mapper)
    ring.GetProperty().SetColor(*color)
    ring.GetProperty().SetLineWidth(width)
    ring.GetPositionCoordinate().SetCoordinateSystemToWorld()
    ring.SetPickable(False)
    return ring
