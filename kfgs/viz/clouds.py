"""Draw clouds with pyvista: as points, as Gaussians or as ellipsoids.

Every `add_*` adds one actor to the plotter's active subplot and returns it; the caller shows the plotter. Data are named
arrays on the actor's mesh (`actor.mapper.dataset["label"]`). pyvista is imported when something is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from torch import Tensor

from .._check import as_array, check_choice, check_range, check_shapes
from .._origin import to_world
from .._typed import typed
from ..cameras.camera import NEAR
from ..gaussians import Gaussians
from .cloud_colors import CloudColors, ColorBy, cloud_colors, seen_from
from .ellipsoids import ellipsoids
from .field_colors import FeatureColors
from .framing import frame_middle, middle_box
from .gaussian_actor import Moving, as_gaussians
from .meshes import draw_mesh
from .places import placed

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Style = Literal["points", "gaussians", "ellipsoids"]


@dataclass(frozen=True)
class CloudOptions:
    """Options for drawing a cloud."""

    opacity: float = 1.0
    """Opacity of everything drawn, in (0, 1]; it multiplies the opacities of Gaussians."""
    point_size: float = 4.0
    """Size of points, in pixels."""
    deviations: float = 1.0
    """Half axes of ellipsoids, in standard deviations."""
    faint: float = 0.5
    """Gaussians up to this opacity, in [0, 1), get no ellipsoid: its surface would hide what is behind."""
    near: float = NEAR
    """Gaussians up to this depth, in world units, are not drawn, as with `Camera.near`; they would be a haze."""
    sort: bool = True
    """Draw Gaussians back to front (exact). Without sorting it is five times faster, but translucency is averaged."""
    moving: Moving = "auto"
    """What to draw while the mouse moves the camera: "points" (at most 50,000, evenly chosen; faint ones pale), "gaussians",
    or "auto": points if a frame of Gaussians takes longer than 0.1 s (in software, from about 20,000 Gaussians)."""

    def __post_init__(self) -> None:
        check_range("opacity", self.opacity, 0, 1, closed=(False, True))
        check_range("point_size", self.point_size, 0, closed=(False, False))
        check_range("faint", self.faint, 0, 1, closed=(True, False))
        check_range("deviations", self.deviations, 0, closed=(False, False))
        check_range("near", self.near, 0)
        check_choice("moving", self.moving, get_args(Moving))


def add_cloud(
    plotter: pv.Plotter,
    gaussians: Gaussians,
    *,
    color_by: ColorBy | Tensor | Array | None = None,
    style: Style = "points",
    feature_colors: FeatureColors | None = None,
    clim: tuple[float, float] | None = None,
    options: CloudOptions = CloudOptions(),
) -> pv.Actor:
    """Draw a cloud as points, as anisotropic Gaussians, or as ellipsoids.

    The mesh carries `index` (which Gaussian), `opacity`, `rgb` (the colours drawn, uint8) and, if present, `label` and the
    values of `color_by` (`score`); with `style="gaussians"` also `scale` and `quat`. If colours mean numbers, its field
    data carry `clim`, which `add_scalar_bar` reads. `recolor_cloud` changes the colours. A view of everything shows the
    middle 98 % of the points in each axis, with a margin: floaters do not set the camera.

    Args:
        plotter: where to draw, in the active subplot.
        gaussians: what to draw.
        color_by: `label` (the palette), `rgb` (`sh` without its dependence on the view), `view` (`sh` as the camera sees
            it; style `gaussians` only), `opacity`, `feature` (through `feature_colors`); or one value for each Gaussian:
            integers [N] are labels, floats [N] scores (not finite: grey), [N, 3] colours. None: labels if there are any,
            else rgb, else features (in colours of this cloud alone), else opacity.
        style: `points` is quick and can be exported to HTML; `gaussians` is VTK's EWA splatting, adjusted to kfgs's
            rasteriser; `ellipsoids` are closed surfaces, for at most 100,000 Gaussians.
        feature_colors: the scene's projection of features to colours.
        clim: scores of the darkest and the brightest colour; None: their 1st and 99th percentile (opacity: 0, 1).
        options: sizes, opacity, order.

    Raises:
        ValueError: if the cloud is empty or lacks what to colour by.
        TypeError: if values to colour by are neither integers nor floats.

    Note:
        VTK draws one cloud after the other, so sorted Gaussians of two clouds do not mix: join the clouds first
        (`Gaussians.cat`). Sorted Gaussians turn off order-independent translucency for their subplot.
    """
    check_choice("style", style, get_args(Style))
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one Gaussian to draw, got none; widen the selection")
    by_view = isinstance(color_by, str) and color_by == "view"
    if by_view and style != "gaussians":
        raise ValueError(
            f"color_by: expected 'rgb' for style {style!r}, got 'view'; only 'gaussians' follow the camera"
        )
    gaussians = placed(plotter, gaussians)
    colors = cloud_colors(gaussians, color_by, feature_colors, clim)
    cloud = _surfaces(gaussians, options) if style == "ellipsoids" else _points(gaussians)
    _fill(cloud, gaussians, colors)
    cloud.field_data["box"] = middle_box(np.asarray(cloud.points))
    frame_middle(plotter.renderer)
    if style == "points":
        return draw_mesh(
        plotter,
            cloud, style="points", scalars="rgb", rgb=True, point_size=options.point_size, lighting=False,
            opacity=options.opacity,
        )  # fmt: skip
    if style == "ellipsoids":
        actor = draw_mesh(plotter, cloud, scalars="rgb", rgb=True, ambient=0.45, diffuse=0.6, opacity=options.opacity)
        actor.prop.interpolation = "Phong"
        return actor
    cloud["opacity"] *= np.float32(options.opacity)
    _add_shapes(cloud, gaussians)
    follow = partial(seen_from, gaussians) if by_view else None
    return as_gaussians(
        plotter,
        cloud,
        sort=options.sort,
        moving=options.moving,
        near=options.near,
        antialiased=gaussians.antialiased,
        colors_from=follow,
    )


def to_pyvista(
    gaussians: Gaussians,
    color_by: ColorBy | Tensor | Array | None = None,
    *,
    feature_colors: FeatureColors | None = None,
) -> pv.PolyData:
    """Convert a cloud to a pyvista point cloud: one point per Gaussian, values as named arrays.

    Points are in the world: in float64 if the cloud has an origin.

    The arrays are `index`, `rgb` (uint8), `opacity`, `scale` (standard deviations), `quat` (w, x, y, z), and, if present,
    `label` and the values of `color_by` (`score`). `to_pyvista(cloud).plot(scalars="rgb", rgb=True)` shows it;
    `add_cloud` draws true Gaussians.

    Args:
        gaussians: what to convert.
        color_by: the meaning of `rgb`, as in `add_cloud`.
        feature_colors: the scene's projection of features to colours.

    Raises:
        ValueError: if the cloud lacks what to colour by.
        TypeError: if these are no Gaussians, or values to colour by are neither integers nor floats.
    """
    colors = cloud_colors(gaussians, color_by, feature_colors)
    cloud = _points(gaussians)
    if any(gaussians.origin):
        cloud.points = as_array(to_world(gaussians.means, gaussians.origin))
    _fill(cloud, gaussians, colors)
    _add_shapes(cloud, gaussians)
    return cloud


def cloud_of(name: str, actor: Any) -> Any:
    """The mesh that an actor draws; a TypeError that names the argument if it is no actor."""
    if not hasattr(actor, "mapper"):
        raise TypeError(f"{name}: expected the actor of a cloud, got {type(actor).__name__}; add_cloud returns one")
    return actor.mapper.dataset


@typed
def recolor_cloud(
    actor: pv.Actor,
    colors: Array,  # [N, 3] uint8
    opacities: Array | None = None,  # [N] in [0, 1]
) -> None:
    """Change the colours, and optionally the opacities, of a cloud that `add_cloud` drew; the next frame shows them.

    Args:
        actor: the result of `add_cloud`. With `color_by="view"` the old colours return when the camera moves.
        colors: in the order of the Gaussians.
        opacities: in the same order, for `style="gaussians"`; None: unchanged.

    Raises:
        ValueError: if numbers differ from the Gaussians, colours are not uint8, or opacities are out of [0, 1].
    """
    cloud = cloud_of("actor", actor)
    count = int(cloud.field_data["count"][0])
    check_shapes(("colors", colors, ("N", 3)))
    if len(colors) != count or colors.dtype != np.uint8:
        raise ValueError(
            f"colors: expected uint8 [{count}, 3] (from actor), got {colors.dtype} {tuple(colors.shape)}; "
            "use palette(labels)"
        )
    index = np.asarray(cloud["index"])
    if opacities is not None:
        check_shapes(("colors", colors, "N 3"), ("opacities", opacities, "N"))
        if not ((opacities >= 0) & (opacities <= 1)).all():  # NaN fails
            raise ValueError(
                f"opacities: expected numbers in [0, 1], got {opacities.min():g} to {opacities.max():g}; clip them first"
            )
        cloud.point_data["opacity"] = opacities.astype(np.float32)[index]
    cloud.point_data["rgb"] = colors[index]


def _points(gaussians: Gaussians) -> pv.PolyData:
    import pyvista as pv

    cloud = pv.PolyData(as_array(gaussians.means).astype(np.float32))
    cloud["index"] = np.arange(len(gaussians))
    return cloud


def _add_shapes(cloud: pv.PolyData, gaussians: Gaussians) -> None:
    quats = as_array(gaussians.quats).astype(np.float64)
    cloud["scale"] = as_array(gaussians.scales).astype(np.float32)
    cloud["quat"] = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def _surfaces(gaussians: Gaussians, options: CloudOptions) -> pv.PolyData:
    """Ellipsoids of the Gaussians that are not faint; `index` refers to all Gaussians."""
    opaque = (gaussians.opacities.detach() > options.faint).nonzero()[:, 0]
    if len(opaque) == 0:
        raise ValueError(
            f"gaussians: expected at least one of opacity above {options.faint:g}, got none; lower options.faint"
        )
    mesh = ellipsoids(gaussians.select(opaque), options.deviations)
    mesh["index"] = as_array(opaque)[np.asarray(mesh["index"])]
    return mesh


def _fill(cloud: pv.PolyData, gaussians: Gaussians, colors: CloudColors) -> None:
    """Give each point the values of its Gaussian."""
    index = np.asarray(cloud["index"])
    cloud["opacity"] = as_array(gaussians.opacities).astype(np.float32)[index]
    if gaussians.labels is not None:
        cloud["label"] = as_array(gaussians.labels).astype(np.int64)[index]
    if colors.values is not None and colors.name != "opacity":
        cloud[colors.name] = colors.values[index]
    cloud["rgb"] = colors.rgb[index]
    cloud.field_data["count"] = np.array([len(gaussians)])
    if colors.clim is not None:
        cloud.field_data["clim"] = np.asarray(colors.clim, dtype=np.float64)
