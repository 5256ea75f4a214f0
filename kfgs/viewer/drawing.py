"""One side of the explorer on the screen: its cloud as Gaussians or points, with the selection and the picked Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from .._check import check_range
from ..cameras import Camera
from ..cameras.camera import NEAR
from ..gaussians import Gaussians
from ..splat import ALPHA_MIN
from ..viz.clouds import CloudOptions, add_cloud, recolor_cloud
from ..viz.frusta import evenly
from ..viz.gaussian_actor import FAINT, MOVING_POINTS, STILL
from ..viz.legends import add_legend, add_scalar_bar
from ..viz.linked import add_title
from ..viz.meshes import draw_mesh
from .hit_test import gaussian_at
from .ring import Ring
from .state import check_number

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Drawn = Literal["gaussians", "points"]

POINT_SIZES = ((30_000, 5.0), (150_000, 4.0))  # (up to so many points, their size in pixels); more have 3
REST_POINTS = 30_000  # points for what is not selected, evenly chosen: more would hide the selection
REST_ALPHA = 0.12  # opacity of these points


class Pane:
    """A subplot with one cloud, whose colours, selection and style can change.

    Args:
        plotter: where to draw.
        column: the subplot.
        cloud: at least one Gaussian.
        near: depth up to which Gaussians are not drawn, world units.
    """

    def __init__(self, plotter: pv.Plotter, column: int, cloud: Gaussians, near: float = NEAR) -> None:
        self.plotter, self.column, self.cloud, self.near = plotter, column, cloud, near
        self.renderer: Any = plotter.renderers[column]
        self.visible = np.ones(len(cloud), dtype=bool)  # [N] drawn bright
        self.faint = ~self.visible  # [N] drawn faint
        self._opacities: Array = cloud.opacities.detach().cpu().numpy()
        self._means: Array = cloud.means.detach().cpu().numpy().astype(np.float32)
        self._gaussians: Any = None
        self._points: list[Any] | None = None  # actors: bright points, faint points, a sample of the bright ones
        self._annotated: Any = None
        self._notes: list[Any] = []
        self.ring = Ring(self.renderer)  # around the picked Gaussian

    def draw(
        self,
        style: Drawn,
        colors: Array,  # [N, 3] uint8
        drawn: Array,  # [N] bool
        selected: Array | None,  # [N] bool
        rest: float,
    ) -> None:
        """Draw the Gaussians in `drawn`, those in `selected` bright and the others faint.

        Args:
            style: `gaussians` (as kfgs's rasteriser draws them) or `points`.
            colors: of all N.
            drawn: which are drawn at all.
            selected: which are bright; None: all.
            rest: factor on the opacity of the others.
        """
        strong = drawn if selected is None else drawn & selected
        others = drawn & ~strong & (self._opacities * rest >= ALPHA_MIN)  # the rasteriser leaves out fainter ones
        self.plotter.subplot(0, self.column)
        if style == "gaussians":
            self.visible, self.faint = strong, others
            self._draw_gaussians(colors, strong, drawn, rest)
        else:
            opaque = self._opacities > FAINT
            self.visible, self.faint = strong & opaque, np.zeros_like(others)
            self.faint[_sample(np.flatnonzero(others & opaque), REST_POINTS)] = True
            self._draw_points(colors)
        self._set_present(self._gaussians, style == "gaussians")
        for actor in self._points or ():
            self._set_present(actor, style == "points" and int(actor.mapper.dataset.field_data["shown"][0]) > 0)

    def annotate(
        self,
        title: str,
        labels: Sequence[int] = (),
        names: Sequence[str] = (),
        clim: tuple[float, float] | None = None,
    ) -> None:
        """Write a title, a legend if there are `labels`, and a bar of scores if there is a `clim`."""
        content = title, tuple(labels), clim
        if content == self._annotated:
            return
        self.plotter.subplot(0, self.column)
        for actor in self._notes:
            self.plotter.remove_actor(actor, render=False)
        self._annotated, self._notes = content, [add_title(self.plotter, title)]
        if len(labels):
            self._notes.append(add_legend(self.plotter, np.array(labels), names))
        if clim is not None:
            self._notes.append(add_scalar_bar(self.plotter, clim))

    def within(self, x: float, y: float) -> tuple[float, float] | None:
        """Convert a pixel of the window (y from its top) to a pixel of this subplot; None if it lies outside.

        Raises:
            TypeError: if x or y is no number.
            ValueError: if one is not finite.
        """
        for name, value in (("x", x), ("y", y)):
            check_number(name, value)
            check_range(name, value, float("-inf"), closed=(False, False))
        width, height = self.renderer.GetSize()
        left, bottom = self.renderer.GetOrigin()
        x, y = x - left, y - (self.plotter.render_window.GetSize()[1] - bottom - height)
        return (x, y) if 0 <= x < width and 0 <= y < height else None

    def gaussian_at(self, camera: Camera, x: float, y: float) -> int | None:
        """The Gaussian seen at a pixel of this subplot: a bright one if there is one, else a faint one."""
        for mask in (self.visible, self.visible | self.faint):
            index = gaussian_at(self.cloud, camera, x, y, torch.from_numpy(mask))
            if index is not None:
                return index
        return None

    def _set_present(self, actor: Any, present: bool) -> None:
        """Add or remove an actor. Its visibility stays: a cloud hides itself while points replace it."""
        if actor is not None and bool(self.renderer.HasViewProp(actor)) != present:
            (self.renderer.AddActor if present else self.renderer.RemoveActor)(actor)

    def _draw_gaussians(self, colors: Array, strong: Array, drawn: Array, rest: float) -> None:
        if self._gaussians is None:
            options = CloudOptions(near=self.near)
            self._gaussians = add_cloud(self.plotter, self.cloud, color_by=colors, style="gaussians", options=options)
        factor = np.where(strong, 1.0, np.where(drawn, rest, 0.0))
        recolor_cloud(self._gaussians, colors, np.clip(self._opacities * factor, 0, 1))

    def _draw_points(self, colors: Array) -> None:
        clear, others = np.flatnonzero(self.visible), np.flatnonzero(self.faint)
        few = _sample(clear, MOVING_POINTS) if len(clear) > MOVING_POINTS else clear[:0]
        parts = [self._part(rows, colors) for rows in (clear, others, few)]
        if self._points is not None:
            for actor, part in zip(self._points, parts, strict=True):
                actor.mapper.dataset.shallow_copy(part)
            return
        size = next((pixels for most, pixels in POINT_SIZES if len(self.cloud) <= most), 3.0)
        self._points = [
            draw_mesh(
                self.plotter, part, style="points", scalars="rgb", rgb=True, point_size=size, lighting=False, opacity=alpha,
                reset_camera=False,
            )
            for part, alpha in zip(parts, (1.0, REST_ALPHA, 1.0), strict=True)
        ]  # fmt: skip
        self.renderer.AddObserver("StartEvent", self._before_frame)

    def _before_frame(self, *_: Any) -> None:
        """While the camera moves, draw only a sample of the points."""
        assert self._points is not None
        clear, _, few = self._points
        moves = self.renderer.HasViewProp(few) and self.renderer.GetRenderWindow().GetDesiredUpdateRate() >= STILL
        clear.SetVisibility(not moves)
        few.SetVisibility(bool(moves))

    def _part(self, rows: Array, colors: Array) -> pv.PolyData:
        """Points for some Gaussians; field data `shown` is their number (pyvista refuses an empty mesh, so one stays)."""
        import pyvista as pv

        kept = rows if len(rows) else np.zeros(1, dtype=np.int64)
        part = pv.PolyData(self._means[kept])
        part["index"], part["rgb"] = kept, colors[kept]
        part.field_data["shown"] = np.array([len(rows)])
        part.set_active_scalars("rgb")
        return part


def _sample(rows: Array, most: int) -> Array:
    return rows[evenly(len(rows), most)]
