"""Show the semantic and the colour cloud side by side, with one camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .._check import check_whole
from ..cameras import Camera, estimate_up
from ..gaussians import Gaussians
from .camera_view import look_through
from .cloud_colors import ColorBy
from .clouds import Style, add_cloud
from .headless import make_plotter
from .legends import add_legend, letters
from .palette import palette
from .places import placed

if TYPE_CHECKING:
    import pyvista as pv

FAR = 99.0  # percentile of distances from the middle that the first view shows: floaters stay outside
TITLES = {"label": "classes", "rgb": "colours", "view": "colours", "opacity": "opacity"}


def linked_clouds(
    semantic: Gaussians,
    color: Gaussians,
    *,
    names: Sequence[str] | None = None,
    color_by: tuple[ColorBy, ColorBy] = ("label", "rgb"),
    style: Style = "gaussians",
    camera: Camera | None = None,
    height: int = 600,
    off_screen: bool | None = None,
) -> pv.Plotter:
    """Show the semantic cloud on the left and the colour cloud on the right; turning one turns the other.

    Args:
        semantic: labelled Gaussians.
        color: Gaussians with `sh`, in the same frame; if they have labels (`transfer_labels`), these can be shown.
        names: class names; the legend lists those present. None: no legend.
        color_by: what the colours mean, left and right: `label`, `rgb`, `view` or `opacity`.
        style: of both clouds.
        camera: the first view, with its proportions; None: everything but floaters.
        height: of the window, pixels.
        off_screen: as in `make_plotter`.

    Returns:
        The plotter, with the left subplot active: call `.show()`, or add more first.

    Raises:
        ValueError: if a cloud is empty or lacks what it is coloured by, a label has no name, or the lens distorts.
        RuntimeError: if nothing can be drawn here.
    """
    check_whole("height", height, 1)
    wide = 4 / 3 if camera is None else camera.width / camera.height
    plotter = make_plotter(height, 2 * round(height * wide), shape=(1, 2), off_screen=off_screen)
    try:
        for column, (cloud, by) in enumerate(zip((semantic, color), color_by, strict=True)):
            plotter.subplot(0, column)
            title = f"{('semantic', 'colour')[column]} field: {TITLES.get(by, by)}"
            add_title(plotter, title)
            if names is not None and by == "label" and cloud.labels is not None:
                add_cloud(plotter, cloud, color_by=palette(cloud.labels, names), style=style)
                add_legend(plotter, cloud.labels, names)
            else:
                add_cloud(plotter, cloud, color_by=by, style=style)
        plotter.subplot(0, 0)
        plotter.link_views()
        if camera is not None:
            look_through(plotter, camera)
            plotter.renderers[1].camera_set = True
        else:
            look_over(plotter, semantic)
    except BaseException:
        plotter.close()
        raise
    return plotter


def add_title(plotter: pv.Plotter, title: str) -> pv.CornerAnnotation:
    """Write a title over the active subplot, in a colour that can be read on its background."""
    return plotter.add_text(title, position="upper_edge", font_size=10, color=letters(plotter))


def look_over(plotter: pv.Plotter, gaussians: Gaussians, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Set an isometric view of all Gaussians but the outermost 1 %, for all linked subplots."""
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    side = np.cross(axis, np.roll(axis, 1))
    if np.linalg.norm(side) < 1e-6:  # along a diagonal
        side = np.cross(axis, (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    means = placed(plotter, gaussians).means.detach().cpu().double().numpy()
    middle = np.median(means, axis=0)
    distance = np.linalg.norm(means - middle, axis=1)
    kept = means[distance <= np.percentile(distance, FAR)]
    bounds = np.stack([kept.min(axis=0), kept.max(axis=0)], axis=1).reshape(-1)
    plotter.view_vector(axis + side + np.cross(axis, side), viewup=axis)
    plotter.renderer.ResetCamera(*bounds)
    for renderer in plotter.renderers:
        renderer.camera_set = True
        renderer.ResetCameraClippingRange()


def upwards(cameras: Sequence[Camera]) -> list[float]:
    """The world's up, estimated from cameras (`estimate_up`); z if there are none or they are not upright."""
    try:
        return [float(x) for x in estimate_up(cameras)]
    except ValueError:
        return [0.0, 0.0, 1.0]
