"""Look at a plotter's scene through a posed camera, as the camera saw it."""

from __future__ import annotations

from math import atan, degrees
from typing import TYPE_CHECKING

from ..cameras import Camera

if TYPE_CHECKING:
    import pyvista as pv


def look_through(plotter: pv.Plotter, camera: Camera) -> None:
    """Set the active subplot's view to a camera, principal point and both focal lengths included.

    The picture fills the window; it is undistorted in shape when the window has the camera's proportions
    (`make_plotter(camera.height, camera.width)`).

    Raises:
        ValueError: if the camera's lens distorts.
    """
    if camera.distortion is not None:
        raise ValueError(f"camera: expected a pinhole camera, got distortion {camera.distortion}; undistort it first")
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
    plotter.camera_set = True  # or the first render would move the camera to see everything
    plotter.renderer.ResetCameraClippingRange()
