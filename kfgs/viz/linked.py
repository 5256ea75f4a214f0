"""Two clouds next to each other, with one camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..cameras import Camera, estimate_up
from ..gaussians import Gaussians
from ..labels.transfer import as_cloud
from .clouds import add_cloud
from .colors import Array
from .legends import add_legend, add_title
from .plotter import look_through, make_plotter

if TYPE_CHECKING:
    import pyvista as pv

    from ..fields import SemanticField


def linked_clouds(
    semantic: SemanticField | Gaussians,
    color: Gaussians,
    *,
    camera: Camera | None = None,
    height: int = 600,
    off_screen: bool | None = None,
) -> pv.Plotter:
    """Show the semantic cloud on the left and the colour cloud on the right; turning one turns the other.

    Args:
        semantic: a field, or labelled Gaussians; a legend lists the classes present.
        color: Gaussians with `sh`, in the same frame.
        camera: the first view, with its proportions; None: everything but floaters.
        height: of the window, pixels.
        off_screen: as in `make_plotter`.

    Returns:
        The plotter, with the left subplot active: call `.show()`, or add more first.

    Raises:
        ValueError: if a cloud is empty or lacks what it is coloured by, or the lens distorts.
    """
    semantic, color = as_cloud(semantic, "semantic", labelled=True), as_cloud(color, "color")
    wide = 4 / 3 if camera is None else camera.width / camera.height
    plotter = make_plotter(height, 2 * round(height * wide), shape=(1, 2), off_screen=off_screen)
    try:
        add_title(plotter, "semantic field: classes")
        add_cloud(plotter, semantic, color_by="label", style="gaussians")
        add_legend(plotter, semantic)
        plotter.subplot(0, 1)
        add_title(plotter, "colour field: colours")
        add_cloud(plotter, color, color_by="rgb", style="gaussians")
        plotter.subplot(0, 0)
        plotter.link_views()
        if camera is not None:
            look_through(plotter, camera)
            plotter.renderers[1].camera_set = True
        else:
            look_over(plotter)
    except BaseException:
        plotter.close()
        raise
    return plotter


def look_over(plotter: pv.Plotter, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Set an isometric view of everything but floaters (`add_cloud`), for all linked subplots."""
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    side = np.cross(axis, np.roll(axis, 1) + np.array([1e-9, 0.0, 0.0]))  # not zero along a diagonal
    side /= np.linalg.norm(side)
    plotter.view_vector(axis + side + np.cross(axis, side), viewup=axis)
    for renderer in plotter.renderers:
        renderer.camera_set = True
        renderer.ResetCameraClippingRange()


def upwards(cameras: Sequence[Camera]) -> list[float]:
    """The world's up (`estimate_up`); z if there are no cameras or they are not upright."""
    try:
        return [float(x) for x in estimate_up(cameras)]
    except ValueError:
        return [0.0, 0.0, 1.0]


def evenly(count: int, most: int | None) -> Array:  # [min(count, most)] int64
    """At most `most` indices below `count`, evenly spaced, with both ends; None: all."""
    return np.unique(np.linspace(0, count - 1, count if most is None else min(most, count)).round().astype(np.int64))
