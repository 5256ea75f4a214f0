"""Pictures of the clouds for the browser: drawn once per change, however often they are requested."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from ..._card import short_repr
from ..gaussian_actor import STILL

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
LEAST = 10  # pixels: a tab in the background has size 0
MOST = 8192  # pixels: no browser window is larger


class Frame(NamedTuple):
    """A picture, and the state that it shows."""

    key: tuple[Any, ...]
    still: bool  # the camera did not move; while it moves, points may replace Gaussians
    number: int
    picture: Array  # [H, W, 3] uint8

    def __repr__(self) -> str:
        return short_repr(self)


def camera_key(renderer: Any) -> tuple[float, ...]:
    """Everything that decides a renderer's view. VTK's time stamp of a camera would also count clipping planes."""
    camera = renderer.GetActiveCamera()
    pose = (*camera.GetPosition(), *camera.GetFocalPoint(), *camera.GetViewUp())
    lens = (camera.GetViewAngle(), camera.GetParallelScale(), camera.GetParallelProjection(), *camera.GetWindowCenter())
    return pose + lens


class Pictures:
    """The latest picture of a plotter.

    VTK's own web application draws each picture twice: it encodes in another thread, sends the previous picture, and
    draws again to fetch the new one.

    Args:
        plotter: the plotter to draw.
        resized: called before drawing if the browser changed the window's size.
        lock: held while drawing; other threads hold it while they change the actors.
    """

    def __init__(self, plotter: pv.Plotter, resized: Callable[[], object], lock: AbstractContextManager[Any]) -> None:
        self.plotter, self.resized, self.lock, self.changes = plotter, resized, lock, 0
        self.frame: Frame | None = None

    @property
    def gone(self) -> bool:
        """Whether the plotter was closed."""
        return self.plotter.render_window is None

    @property
    def camera(self) -> tuple[float, ...]:
        """The current view."""
        return camera_key(self.plotter.renderers[0])

    def now(self) -> Frame:
        """The current picture; drawn only if something changed, or the last one was drawn while the camera moved."""
        window: Any = self.plotter.render_window
        still = window.GetDesiredUpdateRate() < STILL
        views = [(camera_key(renderer), renderer.GetViewProps().GetMTime()) for renderer in self.plotter.renderers]
        key = (self.changes, tuple(window.GetSize()), *views)
        last = self.frame
        if last is None or last.key != key or (still and not last.still):
            self.frame = Frame(key, still, 1 if last is None else last.number + 1, _draw(window))
        assert self.frame is not None
        return self.frame


def _draw(window: Any) -> Array:  # [H, W, 3] uint8
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    window.Render()
    width, height = window.GetSize()
    pixels = vtkUnsignedCharArray()
    window.GetPixelData(0, 0, width - 1, height - 1, 0, pixels, 0)  # back buffer, left eye
    return np.ascontiguousarray(vtk_to_numpy(pixels).reshape(height, width, 3)[::-1])


def make_delivery(pictures: Pictures) -> Any:
    """The protocol that sends pictures, instead of trame-vtk's."""
    from trame_vtk.modules.vtk.protocols import vtkWebPublishImageDelivery
    from wslink import register

    class Delivery(vtkWebPublishImageDelivery):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(decode=False)
            self.asked_for = False  # by a tab that may have no picture yet

        @register("viewport.image.push")
        def image_push(self, options: Any) -> None:
            self.asked_for = True
            super().image_push(options)

        @register("viewport.image.push.observer.add")
        def add_render_observer(self, view_id: Any) -> Any:
            self.asked_for = True
            return super().add_render_observer(view_id)

        def push_render(self, *arguments: Any, **options: Any) -> None:
            if not pictures.gone:
                super().push_render(*arguments, **options)

        def still_render(self, options: dict[str, Any]) -> dict[str, Any]:
            began = perf_counter()
            window: Any = pictures.plotter.render_window
            with pictures.lock:
                width, height = (min(int(length), MOST) for length in options.get("size", window.GetSize()))
                if min(width, height) > LEAST and [width, height] != list(window.GetSize()):
                    window.SetSize(width, height)
                    pictures.resized()
                frame = pictures.now()
            fresh = self.asked_for or frame.number != options.get("mtime")
            self.asked_for = False
            data = _jpeg(frame.picture, options.get("quality", 100)) if fresh else None
            return {
                "image": data,
                "memsize": len(data or b""),
                "size": [frame.picture.shape[1], frame.picture.shape[0]],
                "mtime": frame.number,
                "stale": False,
                "format": "jpeg",
                "global_id": str(self.get_global_id(window)),
                "localTime": options.get("localTime", 0),
                "workTime": round(1000 * (perf_counter() - began)),
            }

    return Delivery()


def _jpeg(picture: Array, quality: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=min(max(int(quality), 1), 95))
    return file.getvalue()
