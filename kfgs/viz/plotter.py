"""Plotters that work with and without a display, their views from posed cameras, and one origin for all that they draw."""

from __future__ import annotations

import functools
import gc
import os
import subprocess
import sys
from collections.abc import Callable
from math import atan, degrees
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import torch

from .._check import ORIGIN, check_whole
from .._origin import Origin
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..cameras.projection import refuse_distortion
from ..splat.engines import available_engines

if TYPE_CHECKING:
    import pyvista as pv

WITHOUT_DISPLAY = {"VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow", "PYVISTA_OFF_SCREEN": "true"}
PROBE = """
import pyvista as pv
plotter = pv.Plotter(off_screen=True, window_size=(8, 8))
plotter.background_color = (255, 0, 0)
plotter.add_mesh(pv.Sphere(radius=0.01))
picture = plotter.screenshot(return_img=True)
plotter.close()
assert picture.shape == (8, 8, 3) and tuple(picture[0, 0]) == (255, 0, 0), picture
"""
_origins: WeakKeyDictionary[pv.Plotter, Origin] = WeakKeyDictionary()


def has_display() -> bool:
    """Whether windows can be opened (Windows and macOS: always)."""
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def prepare() -> None:
    """On Linux without a display, make VTK use EGL and pyvista draw off-screen, before pyvista is imported."""
    if not has_display():
        for name, value in WITHOUT_DISPLAY.items():
            os.environ.setdefault(name, value)


@functools.cache
def trouble() -> str:
    """Why no 3-D picture can be drawn here; empty if it can.

    An 8 x 8 picture is drawn in another process, once: without an OpenGL driver VTK ends Python with a segfault.
    """
    prepare()
    result = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=False)
    if result.returncode == 0:
        return ""
    last = (result.stderr.strip().splitlines() or ["crashed, so there is no OpenGL driver"])[-1]
    return f"the trial picture failed with exit status {result.returncode} ({last})"


def require() -> None:
    """Raise a RuntimeError if nothing can be drawn here; VTK would crash."""
    if trouble():
        raise RuntimeError(
            f"3-D pictures cannot be drawn here: expected a working OpenGL, but {trouble()}; on Debian or Ubuntu run: "
            "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
        )


def make_plotter(
    height: int = 768,
    width: int = 1024,
    *,
    shape: tuple[int, int] = (1, 1),
    off_screen: bool | None = None,
    background: str | None = None,
) -> pv.Plotter:
    """A pyvista plotter that works with and without a display.

    Args:
        height: of the window, pixels.
        width: of the window, pixels.
        shape: (rows, columns) of subplots.
        off_screen: draw without a window; None: only where there is no display.
        background: a colour that pyvista knows; None: that of pyvista's theme.
    """
    check_whole("height", height, 1)
    check_whole("width", width, 1)
    require()
    # Mesa's software driver loads its own LLVM; loading triton's after it, as torch's optimisers do, can crash Python
    available_engines("cpu")
    import pyvista as pv

    # plotters lie in reference cycles. If a closed one is freed between two renders of another, Mesa can crash
    gc.collect()
    hidden = not has_display() if off_screen is None else off_screen
    plotter = pv.Plotter(off_screen=hidden, window_size=(width, height), shape=shape)
    plotter.set_background(background or pv.global_theme.background)
    return plotter


def origin_of(plotter: pv.Plotter, first: Origin) -> Origin:
    """The origin of all that is drawn in a plotter (VTK draws float32); if nothing is yet, `first` becomes it."""
    return _origins.setdefault(plotter, first)


def draw_mesh(plotter: pv.Plotter, mesh: pv.PolyData, **options: Any) -> pv.Actor:
    """`plotter.add_mesh(mesh, **options)`, but `actor.mapper.dataset` stays valid as long as the actor lives.

    pyvista 0.49 holds only a weak reference, so the arrays of the mesh could be freed when the next one is drawn.
    """
    actor = plotter.add_mesh(mesh, **options)
    actor.AddObserver("DeleteEvent", lambda *_, mesh=mesh: mesh)  # the default argument holds the mesh
    return actor


def look_through(plotter: pv.Plotter, camera: Camera) -> None:
    """Set the active subplot's view to a camera, including its principal point and both focal lengths.

    The picture fills the window: make it with the camera's proportions, `make_plotter(camera.height, camera.width)`.

    Raises:
        ValueError: if the camera's lens distorts.
    """
    refuse_distortion(camera)
    camera = camera.with_origin(origin_of(plotter, camera.origin)).to("cpu", torch.float64)
    R, center, view = camera.R.detach(), camera.center.detach(), plotter.camera
    view.position = tuple(center.tolist())
    view.focal_point = tuple((center + R[2]).tolist())  # z of the camera points forward ...
    view.up = tuple((-R[1]).tolist())  # ... and y down
    view.view_angle = degrees(2 * atan(camera.height / 2 / camera.fy))
    view.SetWindowCenter(1 - 2 * camera.cx / camera.width, 2 * camera.cy / camera.height - 1)
    view.SetExplicitAspectRatio((camera.width / camera.fx) / (camera.height / camera.fy))
    view.SetUseExplicitAspectRatio(True)
    plotter.camera_set = True  # otherwise the first render moves the camera to see everything
    plotter.renderer.ResetCameraClippingRange()


def draw_view(
    camera: Camera,
    draw: Callable[[pv.Plotter], object],
    *,
    background: str | None = None,
) -> np.ndarray[Any, Any]:  # [H, W, 3] uint8
    """Draw with pyvista what a camera sees, and return the picture. No window opens, and the plotter is closed.

    `draw` is called with the plotter. For a window that can be turned, make a plotter with `make_plotter` and call
    `look_through` and `show` yourself.
    """
    plotter = make_plotter(*camera.size, off_screen=True, background=background)
    try:
        draw(plotter)
        look_through(plotter, camera)
        return np.asarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def camera_of(plotter: pv.Plotter, renderer: Any, near: float = NEAR) -> Camera:
    """The posed camera (float64) of a subplot's current view, with the subplot's size: the inverse of `look_through`."""
    view, (width, height) = renderer.GetActiveCamera(), renderer.GetSize()
    seen, drawn = view.GetViewTransformMatrix(), view.GetProjectionTransformMatrix(width / height, -1.0, 1.0)
    E, P = (np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)]) for matrix in (seen, drawn))
    E[1:3] *= -1  # VTK's y points up and z backward
    K = np.diag([width / 2, height / 2, 1.0]) @ [[P[0, 0], 0, 1 - P[0, 2]], [0, P[1, 1], 1 + P[1, 2]], [0, 0, 1]]
    return Camera(torch.from_numpy(E), torch.from_numpy(K), width, height, near=near, origin=origin_of(plotter, ORIGIN))


prepare()  # before the user makes a plotter
