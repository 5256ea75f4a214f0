"""What pyvista draws of a scene: clouds of Gaussians, transferred labels, cameras, a legend.

Every `add_*` puts one actor into the plotter's active subplot and returns it; the caller shows the plotter. Data travel
as named arrays on the actor's mesh (`actor.mapper.dataset["label"]`). pyvista is imported when something is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from torch import Tensor

from .._check import check_choice, check_range, check_shapes
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels import Transfer
from ..splat.sh import sh0_to_rgb
from .gaussian_actor import as_gaussians
from .palette import palette
from .pictures import FeatureColors, legend_column

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
ColorBy = Literal["label", "rgb", "opacity", "feature"]
LEGEND_MARGIN = 10  # pixels from the corner
LINES = 2000  # more transfer lines than this hide what they show


def add_cloud(
    plotter: pv.Plotter,
    gaussians: Gaussians,
    *,
    color_by: ColorBy = "label",
    style: Literal["points", "gaussians"] = "points",
    point_size: float = 4.0,
    feature_colors: FeatureColors | None = None,
    sort: bool = True,
) -> pv.Actor:
    """Draw a cloud as points, or as the anisotropic Gaussians that it consists of.

    The mesh carries `index`, `opacity`, `rgb` (the colours drawn, uint8) and, where there are any, `label`; with
    `style="gaussians"` also `scale` and `quat`.

    Args:
        plotter: where to draw; its active subplot receives the cloud.
        gaussians: what to draw.
        color_by: `label` (the palette), `rgb` (view-independent colour of `sh`), `opacity` (dark to bright, 0 to 1), or
            `feature` (through `feature_colors`).
        style: `points` is quick and can be exported to HTML; `gaussians` is VTK's EWA splatting, the picture that
            kfgs's own rasteriser makes.
        point_size: of points, in pixels.
        feature_colors: the scene's projection of features to colours.
        sort: draw Gaussians back to front (exact). Without it their order is averaged: five times faster, less right.

    Raises:
        ValueError: if there is nothing to draw, or what to colour by is missing.

    Note:
        Sorted Gaussians of two clouds in one subplot cover each other as wholes; join the clouds first (`Gaussians.cat`).
        The first drawing of sorted Gaussians turns order-independent translucency off for that subplot.
    """
    check_choice("color_by", color_by, ("label", "rgb", "opacity", "feature"))
    check_choice("style", style, ("points", "gaussians"))
    check_range("point_size", point_size, 0, closed=(False, False))
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one Gaussian to draw, got none; widen the selection")
    import pyvista as pv

    cloud = pv.PolyData(_numpy(gaussians.means).astype(np.float32))
    cloud["index"] = np.arange(len(gaussians))
    cloud["opacity"] = _numpy(gaussians.opacities).astype(np.float32)
    if gaussians.labels is not None:
        cloud["label"] = _numpy(gaussians.labels).astype(np.int64)
    cloud["rgb"] = _colors(gaussians, color_by, feature_colors)
    if style == "points":
        return plotter.add_mesh(cloud, style="points", scalars="rgb", rgb=True, point_size=point_size, lighting=False)
    quats = _numpy(gaussians.quats).astype(np.float64)
    cloud["scale"] = _numpy(gaussians.scales).astype(np.float32)
    cloud["quat"] = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
    return as_gaussians(plotter, cloud, sort=sort)


def add_transfer(
    plotter: pv.Plotter,
    src: Gaussians,
    dst: Gaussians,
    transfer: Transfer,
    *,
    sample: int = LINES,
    line_width: float = 1.5,
) -> pv.Actor:
    """Draw where labels came from: a line from each labelled destination to the source that gave the label.

    Lines are as short as lambda; to see them, move one cloud aside (`dst.replace(means=dst.means + shift)`) before
    drawing it and its lines. Cells carry `label`, `source`, `destination`, `distance` and `rgb`.

    Args:
        plotter: where to draw.
        src: the Gaussians that labels came from.
        dst: the Gaussians that received them.
        transfer: what `transfer_labels` returned for these two.
        sample: at most so many lines, evenly spaced over the labelled destinations.
        line_width: in pixels.

    Raises:
        ValueError: if the transfer belongs to other clouds, or nothing was labelled.
    """
    check_shapes(("dst.means", dst.means, "N 3"), ("transfer.labels", transfer.labels, "N"))
    check_range("sample", sample, 1)
    labelled = np.flatnonzero(_numpy(transfer.labels) >= 0)
    if labelled.size == 0:
        raise ValueError(
            f"transfer: expected labelled Gaussians to draw, got none within {transfer.distance:g}; raise the distance"
        )
    chosen = labelled[np.unique(np.linspace(0, labelled.size - 1, min(sample, labelled.size)).round().astype(np.int64))]
    sources = _numpy(transfer.sources)[chosen]
    if sources.max() >= len(src):
        raise ValueError(
            f"transfer: expected sources below {len(src)} (from src), got {sources.max()}; pass its own clouds"
        )
    import pyvista as pv

    ends = np.stack([_numpy(dst.means)[chosen], _numpy(src.means)[sources]], axis=1).reshape(-1, 3)
    lines = pv.line_segments_from_points(ends.astype(np.float32))
    lines.cell_data["label"] = _numpy(transfer.labels)[chosen]
    lines.cell_data["source"], lines.cell_data["destination"] = sources, chosen
    lines.cell_data["distance"] = _numpy(transfer.distances)[chosen]
    lines.cell_data["rgb"] = palette(_numpy(transfer.labels)[chosen])
    return plotter.add_mesh(lines, scalars="rgb", rgb=True, line_width=line_width, lighting=False)


def add_legend(
    plotter: pv.Plotter,
    labels: Tensor | Array,  # any shape, int
    names: Sequence[str],
) -> Any:
    """List the classes present, by name and colour, in the lower left corner of the active subplot.

    A small picture instead of pyvista's legend, which writes each name in its own colour: yellow on white.

    Raises:
        ValueError: if a label has no name.
    """
    picture = legend_column(labels, names)
    import pyvista as pv
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkImageMapper

    height, width, _ = picture.shape
    image = pv.ImageData(dimensions=(width, height, 1))
    image.point_data["rgb"] = picture[::-1].reshape(-1, 3)  # VTK counts rows from below
    image.set_active_scalars("rgb")
    mapper = vtkImageMapper()
    mapper.SetInputData(image)
    mapper.SetColorWindow(255)
    mapper.SetColorLevel(127.5)
    actor = vtkActor2D()
    actor.SetMapper(mapper)
    actor.SetPosition(LEGEND_MARGIN, LEGEND_MARGIN)
    plotter.add_actor(actor, reset_camera=False, pickable=False)
    return actor


def add_cameras(
    plotter: pv.Plotter,
    cameras: Sequence[Camera],
    *,
    size: float | None = None,
    color: str = "black",
    line_width: float = 1.5,
) -> pv.Actor:
    """Draw cameras as pyramids with their true opening, and a small roof on the upper edge of the picture.

    Args:
        plotter: where to draw.
        cameras: their distortion is ignored here.
        size: depth of the pyramids, world units; None: a twentieth of the extent of the cameras' positions.
        color: one that pyvista knows.
        line_width: in pixels.

    Returns:
        The actor; its mesh's cells carry `camera`, the index.

    Raises:
        ValueError: if there are no cameras or the size is not positive.
    """
    if not cameras:
        raise ValueError("cameras: expected at least one camera, got none")
    centers = np.stack([_numpy(camera.center) for camera in cameras]).astype(np.float64)
    extent = float(np.ptp(centers, axis=0).max())
    depth = size if size is not None else (0.05 * extent if extent > 0 else 0.2)
    check_range("size", depth, 0, closed=(False, False))
    import pyvista as pv

    segments = np.concatenate([_frustum(camera, depth) for camera in cameras])  # [10 C, 2, 3]
    mesh = pv.line_segments_from_points(segments.reshape(-1, 3))
    mesh.cell_data["camera"] = np.repeat(np.arange(len(cameras)), len(segments) // len(cameras))
    return plotter.add_mesh(mesh, color=color, line_width=line_width, lighting=False)


def _frustum(camera: Camera, depth: float) -> Array:  # [10, 2, 3]
    """Four edges from the centre, four around the picture, two for the roof."""
    K, E = _numpy(camera.K).astype(np.float64), _numpy(camera.viewmat).astype(np.float64)
    w, h = camera.width, camera.height
    pixels = np.array([[0, 0], [w, 0], [w, h], [0, h], [w / 2, -h / 5]])  # the corners, then the ridge of the roof
    rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))]) * depth
    a, b, c, d, ridge = (rays - E[:3, 3]) @ E[:3, :3]  # R^T (x - t)
    o = -E[:3, 3] @ E[:3, :3]
    return np.array([(o, a), (o, b), (o, c), (o, d), (a, b), (b, c), (c, d), (d, a), (a, ridge), (ridge, b)])


def _colors(gaussians: Gaussians, color_by: ColorBy, feature_colors: FeatureColors | None) -> Array:  # [N, 3] uint8
    if color_by == "label":
        if gaussians.labels is None:
            raise ValueError(
                "gaussians.labels: expected labels to colour by, got None; label them or choose another color_by"
            )
        return palette(gaussians.labels)
    if color_by == "rgb":
        if gaussians.sh is None:
            raise ValueError("gaussians.sh: expected harmonics to colour by, got None; a semantic field has no colour")
        rgb = sh0_to_rgb(gaussians.sh[:, 0].detach()).clamp(0, 1)
        return np.round(_numpy(rgb) * 255).astype(np.uint8)
    if color_by == "feature":
        if gaussians.features is None or feature_colors is None:
            missing = "gaussians.features" if gaussians.features is None else "feature_colors"
            raise ValueError(
                f"{missing}: expected it to colour by features, got None; fit FeatureColors once per scene"
            )
        return feature_colors(gaussians.features)
    from matplotlib import colormaps

    colors: Array = colormaps["cividis"](_numpy(gaussians.opacities), bytes=True)[:, :3]
    return colors


def _numpy(values: Tensor) -> Array:
    array: Array = values.detach().cpu().numpy()
    return array
