"""Draw clouds with pyvista: as points, as Gaussians or as ellipsoids.

Every `add_*` adds one actor to the plotter's active subplot and returns it; the caller shows the plotter. Data are named
arrays on the actor's mesh (`actor.mapper.dataset["label"]`). pyvista is imported when something is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from .._check import as_array, check_choice
from .._origin import to_world
from ..cameras.camera import NEAR
from ..gaussians import Gaussians
from ..labels.transfer import as_cloud
from ..splat.views import sum_pixels
from .colors import COLORMAP, Array, CloudColors, ColorBy, FeatureColors, cloud_colors
from .gaussian_actor import as_gaussians
from .legends import letters
from .plotter import camera_of, draw_mesh, origin_of

if TYPE_CHECKING:
    import pyvista as pv

    from ..fields import SemanticField

Style = Literal["points", "gaussians", "ellipsoids"]
FAINT = 0.5  # Gaussians up to this opacity get no ellipsoid: its surface would hide what is behind
FACES = ((5_000, 2), (20_000, 1))  # up to 5,000 ellipsoids have 320 faces each, up to 20,000 have 80; more have 20
MOST = 100_000  # ellipsoids, with 2 million faces: 1.2 s a frame in software
BACKGROUND = 0.05  # a pixel that is covered less shows the background
OUTER, MARGIN = 0.01, 0.05  # share of the points beyond each side of the box that a first view shows; room around it


def add_cloud(
    plotter: pv.Plotter,
    gaussians: Gaussians | SemanticField,
    *,
    color_by: ColorBy = None,
    style: Style = "points",
    feature_colors: FeatureColors | None = None,
    clim: tuple[float, float] | None = None,
    cmap: str = COLORMAP,
    show_scalar_bar: bool = False,
    near: float = NEAR,
    on_pick: Callable[[int], object] | None = None,
    **options: Any,
) -> pv.Actor:
    """Draw a cloud as points, as anisotropic Gaussians, or as ellipsoids.

    The mesh carries `index` (which Gaussian), `opacity`, `rgb` (the colours drawn, uint8) and, if present, `label` and the
    values of `color_by` (`score`). A view of everything shows the middle 98 % of the points in each axis, with a margin:
    floaters do not set the camera.

    Args:
        plotter: where to draw, in the active subplot.
        gaussians: what to draw: a cloud, or a field with its classes.
        color_by: `label` or `class` (the palette, by the cloud's class names), the name of one class (the others are grey),
            `score` (of the labels), `rgb` (`sh` without its dependence on the view), `view` (`sh` as the camera sees it;
            style `gaussians` only), `opacity`, `feature`; a `Selection` or a rule (its scores); or one value for each Gaussian:
            integers [N] are numbers of colours, floats or a mask [N] scores (not finite: grey), [N, 3] colours. None: labels if
            there are any, else rgb, feature, opacity.
        style: `points` is quick; `gaussians` is VTK's EWA splatting, adjusted to kfgs's rasteriser (points in a page that
            pyvista exports); `ellipsoids` are closed surfaces of one standard deviation, for at most 100,000 Gaussians; those up
            to an opacity of 0.5 are left out.
        feature_colors: the scene's projection of features to colours; None: one for this cloud alone.
        clim: scores of the darkest and the brightest colour; None: their 1st and 99th percentile (by name: 0, 1).
        cmap: the colour map of scores, as matplotlib names it.
        show_scalar_bar: whether to show the scale of scores.
        near: Gaussians up to this depth, in world units, are not drawn, as with `Camera.near`; they would be a haze.
        on_pick: called when the key P is pressed with the mouse over a pixel: with the index of the Gaussian that shows most
            there as kfgs renders the cloud, -1 for the background.
        options: of `plotter.add_mesh`: `name` (replaces what has this name), `opacity`, `point_size`, `pickable`, ...

    Raises:
        ValueError: if the cloud is empty or lacks what to colour by, or a number is out of range.
        TypeError: if values to colour by are neither integers nor floats.

    Note:
        VTK draws one cloud after the other, so Gaussians of two clouds do not mix: join the clouds first (`Gaussians.cat`).
    """
    check_choice("style", style, get_args(Style))
    gaussians = as_cloud(gaussians)
    gaussians = gaussians.with_origin(origin_of(plotter, gaussians.origin))
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one Gaussian to draw, got none; widen the selection")
    by_view = isinstance(color_by, str) and color_by == "view"
    if by_view and style != "gaussians":
        raise ValueError(f"color_by: expected 'rgb' for {style!r}, got 'view'; only 'gaussians' follow the camera")
    colors = cloud_colors(gaussians, color_by, feature_colors, clim, cmap)
    mesh = _ellipsoids(gaussians) if style == "ellipsoids" else _points(gaussians)
    _fill(mesh, gaussians, colors)
    last, cut = mesh.n_points - 1, int(OUTER * mesh.n_points)
    ends = [0, cut, last - cut, last]  # a partition takes a fraction of the time of a sort; NaN comes last
    least, low, high, most = np.partition(np.asarray(mesh.points, np.float64).T, ends).T[ends]
    box = np.maximum(low - MARGIN * (high - low), least), np.minimum(high + MARGIN * (high - low), most)
    mesh.field_data["box"] = np.stack(box, axis=1).reshape(-1)  # x from, x to, y from, ...
    _frame_middle(plotter.renderer)
    drawn: dict[str, Any] = {"scalars": "rgb", "rgb": True, "lighting": style == "ellipsoids"}
    if style == "points":
        actor = draw_mesh(plotter, mesh, **drawn | {"style": "points", "point_size": 4.0} | options)
    elif style == "ellipsoids":
        actor = draw_mesh(plotter, mesh, **drawn | {"ambient": 0.45, "diffuse": 0.6} | options)
        actor.prop.interpolation = "Phong"
    else:
        _add_shapes(mesh, gaussians)
        followed = gaussians.detach() if by_view else None
        actor = as_gaussians(plotter, mesh, near, gaussians.antialiased, followed, **drawn | options)
    if on_pick is not None:
        _call_when_picked(plotter, gaussians, near, on_pick)
    if show_scalar_bar and colors.clim is not None:
        actor.mapper.lookup_table.apply_cmap(cmap)  # the colours are given: its own table is for the bar alone
        actor.mapper.scalar_range = colors.clim
        plotter.add_scalar_bar(colors.name, mapper=actor.mapper, color=letters(plotter))
    return actor


def to_pyvista(gaussians: Gaussians | SemanticField, color_by: ColorBy = None) -> pv.PolyData:
    """Convert a cloud, or a field with its classes, to a pyvista point cloud: one point per Gaussian, values as named arrays.

    Points are in the world: in float64 if the cloud has an origin. The arrays are `index`, `rgb` (uint8), `opacity`,
    `scale` (standard deviations), `quat` (w, x, y, z), and, if present, `label` and the values of `color_by` (`score`).
    `to_pyvista(cloud).plot(scalars="rgb", rgb=True)` shows it. Arguments as in `add_cloud`.
    For trimesh: `trimesh.PointCloud(points.points, colors=points["rgb"])`.
    """
    gaussians = as_cloud(gaussians)
    colors = cloud_colors(gaussians, color_by)
    mesh = _points(gaussians)
    if any(gaussians.origin):
        mesh.points = as_array(to_world(gaussians.means, gaussians.origin))
    _fill(mesh, gaussians, colors)
    _add_shapes(mesh, gaussians)
    return mesh


def recolor_cloud(
    actor: pv.Actor,
    colors: Array,  # [N, 3] uint8
    opacities: Array | None = None,  # [N] in [0, 1]
) -> None:
    """Recolour a cloud that `add_cloud` drew, with style `gaussians` also its opacities, from the next `plotter.render()` on."""
    mesh = actor.mapper.dataset
    index = np.asarray(mesh["index"])
    if opacities is not None:
        mesh.point_data["opacity"] = opacities.astype(np.float32)[index]
    mesh.point_data["rgb"] = colors[index]


def _call_when_picked(plotter: pv.Plotter, gaussians: Gaussians, near: float, call: Callable[[int], object]) -> None:
    """Call with the Gaussian of the largest rendering weight at each pixel that is picked."""

    def pick(_: Any, picker: Any) -> None:
        renderer, (x, y, _) = picker.GetRenderer(), picker.GetSelectionPoint()
        camera, (left, low) = camera_of(plotter, renderer, near), renderer.GetOrigin()
        signal = torch.zeros(*camera.size, 1).to(gaussians.means)
        signal[camera.height - 1 - int(y - low), int(x - left)] = 1  # VTK counts rows from below
        index, weights, _ = sum_pixels(gaussians, camera, signal)
        call(int(index[weights.argmax()]) if float(weights.sum()) > BACKGROUND else -1)

    plotter.enable_point_picking(pick, use_picker=True, pickable_window=True, show_message=False, show_point=False)


def _frame_middle(renderer: Any) -> None:
    """When a view is reset to show everything, show the middle boxes of clouds (field data `box`) instead of their bounds.

    VTK calls the observer only then, not when a caller gives a box. Clipping planes keep everything.
    """

    def reset(*_: Any) -> None:
        boxes = []
        for actor in renderer.actors.values():
            mesh: Any = getattr(getattr(actor, "mapper", None), "dataset", None)
            bounds = actor.GetBounds()
            if actor.GetVisibility() and actor.GetUseBounds() and bounds is not None and bounds[0] <= bounds[1]:
                has_box = mesh is not None and "box" in mesh.field_data and actor.GetMatrix().IsIdentity()
                boxes.append(mesh.field_data["box"] if has_box else bounds)
        if boxes:
            sides = np.array(boxes).reshape(-1, 3, 2)
            renderer.ResetCamera(*np.stack([sides[..., 0].min(axis=0), sides[..., 1].max(axis=0)], axis=1).reshape(-1))
            renderer.ResetCameraClippingRange()

    renderer.AddObserver("ResetCameraEvent", reset)


def _points(gaussians: Gaussians) -> pv.PolyData:
    import pyvista as pv

    mesh = pv.PolyData(as_array(gaussians.means).astype(np.float32))
    mesh["index"] = np.arange(len(gaussians))
    return mesh


def _ellipsoids(gaussians: Gaussians) -> pv.PolyData:
    """A mesh of ellipsoids of one standard deviation; its point array `index` names the Gaussian of each vertex."""
    import pyvista as pv

    opaque = (gaussians.opacities.detach() > FAINT).nonzero()[:, 0]
    count = len(opaque)
    if not 0 < count <= MOST:
        expected = f"1 to {MOST:,} of opacity above {FAINT:g} to draw as ellipsoids"
        raise ValueError(f"gaussians: expected {expected}, got {count:,}; select others, or draw points")
    gaussians = gaussians.select(opaque).detach()
    ball = pv.Icosphere(nsub=next((times for most, times in FACES if count <= most), 0))
    corners, faces = np.array(ball.points, dtype=np.float32), np.array(ball.regular_faces)
    turn = as_array(quaternion_to_rotation_matrix(gaussians.quats.double())).astype(np.float32)  # [N, 3, 3]
    half = as_array(gaussians.scales).astype(np.float32)[:, None, :]
    means = as_array(gaussians.means).astype(np.float32)[:, None]
    points = np.einsum("nij,nvj->nvi", turn, corners * half) + means
    normals = np.einsum("nij,nvj->nvi", turn, corners / np.maximum(half, 1e-12 * half.max()))  # the gradient's
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    shift = len(corners) * np.arange(count)[:, None, None]
    mesh = pv.PolyData.from_regular_faces(points.reshape(-1, 3), (faces + shift).reshape(-1, 3))
    mesh["index"] = np.repeat(as_array(opaque), len(corners))
    mesh.point_data.active_normals = normals.reshape(-1, 3)
    return mesh


def _add_shapes(mesh: pv.PolyData, gaussians: Gaussians) -> None:
    mesh["scale"] = as_array(gaussians.scales).astype(np.float32)
    mesh["quat"] = as_array(torch.nn.functional.normalize(gaussians.quats.detach().double())).astype(np.float32)


def _fill(mesh: pv.PolyData, gaussians: Gaussians, colors: CloudColors) -> None:
    """Give each point the values of its Gaussian."""
    index = np.asarray(mesh["index"])
    mesh["opacity"] = as_array(gaussians.opacities).astype(np.float32)[index]
    if gaussians.labels is not None:
        mesh["label"] = as_array(gaussians.labels).astype(np.int64)[index]
    if colors.values is not None and colors.name != "opacity":
        mesh[colors.name] = colors.values[index]
    mesh["rgb"] = colors.rgb[index]
