"""The mouse in the page's tabs: handled by VTK, and released if a tab closes during a drag."""

from __future__ import annotations

from typing import Any

from ..gaussian_actor import STILL
from .web_picture import Pictures

BUTTONS_AND_KEYS = ("buttonLeft", "buttonMiddle", "buttonRight", "shiftKey", "ctrlKey", "altKey", "metaKey")


def make_mouse(pictures: Pictures, delivery: Any) -> Any:
    """The protocol for mouse events, instead of trame-vtk's; `delivery` is that of `make_delivery`."""
    from trame_vtk.modules.vtk.protocols import vtkWebMouseHandler
    from wslink import register

    class Mouse(vtkWebMouseHandler):  # type: ignore[misc]
        @register("viewport.mouse.interaction")
        def mouse_interaction(self, event: Any) -> Any:
            with pictures.lock:
                return None if pictures.gone else super().mouse_interaction(event)

        @register("viewport.mouse.zoom.wheel")
        def update_zoomFromWheel(self, event: Any) -> Any:  # noqa: N802  wslink's name
            with pictures.lock:
                return None if pictures.gone else super().update_zoomFromWheel(event)

        def onClose(self, client_id: str) -> None:  # noqa: N802  wslink's name
            """Release the mouse buttons of a closed tab; another tab that drags presses them again as it moves."""
            window: Any = pictures.plotter.render_window
            if pictures.gone or not (delivery.views_in_animations or window.GetDesiredUpdateRate() >= STILL):
                return
            (x, y), (width, height) = window.GetInteractor().GetEventPosition(), window.GetSize()
            still = {"view": self.get_global_id(window), "action": "up", "x": x / width, "y": y / height}
            super().mouse_interaction(still | dict.fromkeys(BUTTONS_AND_KEYS, False))
            delivery.views_in_animations.clear()
            self.app.InvokeEvent("UpdateEvent")  # a new picture for the other tabs

    return Mouse()
