"""Set a plotter's view from a posed camera, draw what a camera sees, and make a posed camera from a view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import atan, degrees, radians, tan
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from .._check import ORIGIN
from .._typed import typed
from ..cameras import Camera
from ..cameras.camera import NEAR
from .headless import make_plotter
from .places import origin_of, placed

if TYPE_CHECKING:
    import pyvista as pv


@typed
def look_through(plotter: pv.Plotter, camera: Camera) -> None:
    """Set the active subplot's view to a camera, including its principal point and both focal lengths.

    The picture fills the window, so make the window with the camera's proportions (`make_plotter(camera.height,
    camera.width)`), or it is stretched.

    Raises:
        ValueError: if the camera's lens distorts.
    """
    if camera.distortion is not None:
        raise ValueError(f"camera: expected a pinhole camera, got distortion {camera.distortion}; undistort it first")
    camera = placed(plotter, camera)
    K, E = camera.K.detach().double().cpu(), camera.viewmat.detach().double().cpu()
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    R, center = E[:3, :3], -E[:3, :3].T @ E[:3, 3]
    view = plotter.camera
    view.position = tuple(center.tolist())
    view.focal_point = tuple((center + R[2]).tolist())  # z of the camera points forward ...
    view.up = tuple((-R[1]).tolist())  # ... and y down
    view.view_angle = degrees(2 * atan(camera.height / 2 / fy))
    view.SetWindowCenter(1 - 2 * cx / camera.width, 2 * cy / camera.height - 1)
    view.SetExplicitAspectRatio((camera.width / fx) / (camera.height / fy))
    view.SetUseExplicitAspectRatio(True)
    plotter.camera_set = True  # otherwise the first render moves the camera to see everything
    plotter.renderer.ResetCameraClippingRange()


@typed
def draw_view(
    camera: Camera,
    draw: Callable[[pv.Plotter], object],
    *,
    background: str = "white",
) -> np.ndarray[Any, Any]:  # [H, W, 3] uint8
    """Draw with pyvista what a camera sees, and return the picture. No window opens, and the plotter is closed.

    For a window that can be turned, make a plotter with `make_plotter` and call `look_through` and `show` yourself.

    Args:
        camera: where to look from; the picture has its size.
        draw: called with the plotter; adds to it what is to be seen. What it returns is not used.
        background: a colour that pyvista knows.

    Raises:
        RuntimeError: if nothing can be drawn here; the message names the packages to install.
        ValueError: if the camera's lens distorts.

    Example:
        >>> from kfgs.viz import add_cloud
        >>> picture = draw_view(camera, lambda plotter: add_cloud(plotter, cloud))  # doctest: +SKIP
    """
    plotter = make_plotter(*camera.size, off_screen=True, background=background)
    try:
        draw(plotter)
        look_through(plotter, camera)
        return np.asarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def camera_of(plotter: pv.Plotter, subplot: tuple[int, int] = (0, 0), *, near: float = NEAR) -> Camera:
    """The posed camera of a subplot's current view: the inverse of `look_through`.

    Args:
        plotter: its window may have any size.
        subplot: (row, column).
        near: near plane of the returned camera, world units. VTK's own depends on its depth buffer, and says nothing.

    Returns:
        A pinhole camera (float64) with the size of the subplot, in pixels.

    Raises:
        ValueError: if the subplot looks along parallel rays.
    """
    renderer = plotter.renderers[plotter.renderers.loc_to_index(subplot)]
    view = renderer.GetActiveCamera()
    if view.GetParallelProjection():
        raise ValueError(
            "plotter: expected a perspective view, got a parallel projection, which no pinhole camera has; call "
            "plotter.disable_parallel_projection()"
        )
    width, height = renderer.GetSize()
    matrix = view.GetViewTransformMatrix()
    E = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    E[1:3] *= -1  # VTK's y points up and z backward
    aspect = view.GetExplicitAspectRatio() if view.GetUseExplicitAspectRatio() else width / height
    fy = height / 2 / tan(radians(view.GetViewAngle()) / 2)
    fx = width / aspect * fy / height
    x, y = view.GetWindowCenter()
    K = [[fx, 0.0, (1 - x) * width / 2], [0.0, fy, (1 + y) * height / 2], [0.0, 0.0, 1.0]]
    lens = torch.tensor(K, dtype=torch.float64), width, height
    return Camera(torch.from_numpy(E), *lens, near=near, origin=origin_of(plotter, ORIGIN))


def letterboxed(camera: Camera, height: int, width: int) -> Camera:
    """Resize a camera. The old view stays complete and centred, at its aspect ratio."""
    scale = min(height / camera.height, width / camera.width)
    K = camera.K.detach().double().cpu().clone()
    K[:2] *= scale
    K[0, 2] += (width - scale * camera.width) / 2
    K[1, 2] += (height - scale * camera.height) / 2
    return replace(camera, viewmat=camera.viewmat.detach().double().cpu(), K=K, width=width, height=height)
