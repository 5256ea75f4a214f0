"""Two clouds with one camera, and the labels that one gave to the other (Sec. 3.4): who gave what to whom, and who got none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .._check import as_array, check_shapes
from ..cameras import Camera, estimate_up
from ..gaussians import Gaussians
from ..labels import Transfer
from .clouds import Style, add_cloud
from .colors import Array, ColorBy, names_of
from .legends import add_legend, add_title
from .palette import palette
from .plotter import draw_mesh, look_through, make_plotter, placed

if TYPE_CHECKING:
    import pyvista as pv

FAR = 99.0  # percentile of distances from the middle that the first view shows: floaters stay outside
TITLES = {"label": "classes", "rgb": "colours", "view": "colours", "opacity": "opacity"}
LINES = 500  # more lines than this hide the clouds


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
        names: class names; the legend lists those present. None: the cloud's own; without any there is no legend.
        color_by: what the colours mean, left and right: `label`, `rgb`, `view` or `opacity`.
        style: as in `add_cloud`.
        camera: the first view, with its proportions; None: everything but floaters.
        height: of the window, pixels.
        off_screen: as in `make_plotter`.

    Returns:
        The plotter, with the left subplot active: call `.show()`, or add more first.

    Raises:
        ValueError: if a cloud is empty or lacks what it is coloured by, or the lens distorts.
    """
    wide = 4 / 3 if camera is None else camera.width / camera.height
    plotter = make_plotter(height, 2 * round(height * wide), shape=(1, 2), off_screen=off_screen)
    try:
        for column, (cloud, by) in enumerate(zip((semantic, color), color_by, strict=True)):
            plotter.subplot(0, column)
            add_title(plotter, f"{('semantic', 'colour')[column]} field: {TITLES.get(by, by)}")
            named = cloud if names is None else cloud.replace(names=tuple(names))
            add_cloud(plotter, named, color_by=by, style=style)
            if by == "label" and cloud.labels is not None and names_of(named):
                add_legend(plotter, cloud.labels, named.names)
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


def add_transfer(
    plotter: pv.Plotter,
    src: Gaussians,
    dst: Gaussians,
    transfer: Transfer,
    *,
    names: Sequence[str] | None = None,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sample: int = LINES,
    line_width: float = 1.0,
) -> pv.Actor:
    """Draw a line from each labelled destination to the source of its label.

    Lines are as short as lambda. To see them, draw the destinations aside: pass a `shift` here, and draw the cloud
    `dst.replace(means=dst.means + shift)`. Cells carry `label`, `source`, `destination`, `distance` and `rgb`.

    Args:
        plotter: where to draw.
        src: the Gaussians that labels came from.
        dst: the Gaussians that received them.
        transfer: the result of `nearest_labels` for these two.
        names: class names, for the colours of labels as in `palette`; None: those of `src`.
        shift: added to the destinations' positions, world units.
        sample: the most lines, evenly chosen among the labelled destinations.
        line_width: in pixels.

    Raises:
        ValueError: if the transfer belongs to other clouds, or nothing was labelled.
    """
    import pyvista as pv

    check_shapes(("dst.means", dst.means, "N 3"), ("transfer.labels", transfer.labels, "N"))
    src, dst = placed(plotter, src), placed(plotter, dst)
    labelled = np.flatnonzero(as_array(transfer.labels) >= 0)
    if labelled.size == 0:
        raise ValueError(
            f"transfer: expected labelled Gaussians to draw, got none within {transfer.distance:g}; raise the distance"
        )
    chosen = labelled[evenly(labelled.size, sample)]
    sources = as_array(transfer.sources)[chosen]
    if sources.max() >= len(src):
        raise ValueError(
            f"transfer: expected sources below {len(src)} (from src), got {sources.max()}; pass its own clouds"
        )
    ends = np.stack([as_array(dst.means)[chosen] + shift, as_array(src.means)[sources]], axis=1).reshape(-1, 3)
    labels = as_array(transfer.labels)[chosen]
    lines = pv.line_segments_from_points(ends.astype(np.float32))
    lines.cell_data["label"], lines.cell_data["rgb"] = labels, palette(labels, names or names_of(src))
    lines.cell_data["source"], lines.cell_data["destination"] = sources, chosen
    lines.cell_data["distance"] = as_array(transfer.distances)[chosen]
    return draw_mesh(plotter, lines, scalars="rgb", rgb=True, line_width=line_width, lighting=False)


def look_over(plotter: pv.Plotter, gaussians: Gaussians, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Set an isometric view of all Gaussians but the outermost 1 %, for all linked subplots."""
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    side = np.cross(axis, np.roll(axis, 1))
    if np.linalg.norm(side) < 1e-6:  # along a diagonal
        side = np.cross(axis, (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    means = as_array(placed(plotter, gaussians).means).astype(np.float64)
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    kept = means[distance <= np.percentile(distance, FAR)]
    plotter.view_vector(axis + side + np.cross(axis, side), viewup=axis)
    plotter.renderer.ResetCamera(*np.stack([kept.min(axis=0), kept.max(axis=0)], axis=1).reshape(-1))
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
