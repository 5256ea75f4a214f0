"""Anisotropic Gaussians in VTK: its EWA splatting mapper, taught the rules by which kfgs's rasteriser draws."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..cameras.camera import NEAR
from ..splat.engines import ALPHA_MAX, ALPHA_MIN
from ..splat.project import FIELD_OF_VIEW_MARGIN
from .frusta import evenly
from .meshes import draw_mesh
from .points_and_ellipsoids import FAINT

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Moving = Literal["auto", "points", "gaussians"]
LOW_PASS = 0.3  # pixels squared, added to each projected covariance as 3DGS does
BOUND = 3.0  # standard deviations after which VTK stops drawing; 3.3, where ALPHA_MIN stops, agrees no better
MOVING_FAINT = 10_000  # points beside them that let the others be seen
FAINT_ALPHA = 0.12
MOVING_POINTS = 50_000  # 0.14 s a frame of 1024 x 768 in software on two busy cores; 100,000 took 0.25 s
STILL = 1.0  # frames per second: VTK asks for more while the mouse moves the camera, and for 0.0001 when it rests
SLOW = 0.1  # seconds a frame from which "auto" moves points

# VTK drops a Gaussian whose centre lies further out than 1.3 times the half picture; 3DGS draws it, with the projection
# linearised at that border, where the half picture is 1 (normalised device coordinates know no principal point)
VERTEX_SHADER = {
    "mat3 J = getProjectionMatrix(posVC.xyz);": f"""
      vec4 centerDC = VCDCMatrix * posVC;
      vec2 inside = clamp(centerDC.xy / centerDC.w, -{FIELD_OF_VIEW_MARGIN}, {FIELD_OF_VIEW_MARGIN});
      vec3 linearVC = posVC.xyz;
      if (cameraParallel == 0)
      {{
        linearVC.x = -(inside.x + VCDCMatrix[2][0]) * posVC.z / VCDCMatrix[0][0];
        linearVC.y = -(inside.y + VCDCMatrix[2][1]) * posVC.z / VCDCMatrix[1][1];
      }}
      mat3 J = getProjectionMatrix(linearVC);""",
    "if (posDC.x < -1.3*posDC.w || posDC.x > 1.3*posDC.w || posDC.y < -1.3*posDC.w || posDC.y > 1.3*posDC.w)": (
        "if (cameraParallel == 0 && posDC.w <= {near})"
    ),
}
DENSITY = "float gaussian = exp(-0.5*dist2);"
FRAGMENT_SHADER = {
    DENSITY: f"{DENSITY} if (opacity*gaussian < {ALPHA_MIN:.9f}) discard; gaussian = min(gaussian, {ALPHA_MAX}/opacity);"
}


def as_gaussians(
    plotter: pv.Plotter,
    cloud: pv.PolyData,
    *,
    sort: bool,
    moving: Moving = "auto",
    near: float = NEAR,
    colors_from: Callable[[Array], Array] | None = None,
) -> pv.Actor:
    """Draw a cloud with `index`, `rgb`, `scale`, `quat` (w, x, y, z; unit) and `opacity` as Gaussians.

    Sorted, it agrees with kfgs's own rasteriser: `tests/viz/test_agreement.py`; through five cameras of room_0, 42 to 43
    dB on the field's classes and 45 to 47 dB on the colours. Colours are bytes: where harmonics shine brighter than
    white, as in room_0's windows, 38 to 41 dB remain. Unsorted, translucency is averaged. Depth peeling makes VTK's
    Gaussians vanish, so do not enable it.

    Args:
        plotter: where to draw.
        cloud: its arrays may be exchanged later; a frame only changes their order.
        sort: draw back to front.
        moving: what to draw while the mouse moves the camera: "points" (at most 50,000, evenly chosen, and 10,000 pale ones
            for the Gaussians of opacity at most 0.1), "gaussians", or "auto": points if a frame of Gaussians takes longer
            than 0.1 s.
        near: depth up to which nothing is drawn, world units (`Camera.near`).
        colors_from: `rgb` in the order of `index`, given where the camera stands [3]; None: it does not change.
    """
    actor = draw_mesh(plotter, cloud, style="points_gaussian", scalars="rgb", rgb=True, emissive=False, lighting=False)
    mapper = actor.mapper
    mapper.SetScaleArray("scale")
    mapper.SetRotationArray("quat")
    mapper.SetOpacityArray("opacity")
    mapper.SetAnisotropic(True)
    mapper.SetScaleFactor(1.0)  # pyvista's own factor shrinks them to a point size
    mapper.SetBoundScale(BOUND)
    # room_0's field: 24 dB as VTK is, 39 with the vertex shader, 43 with both, but 23 before the near plane was kfgs's,
    # in the one view of five that needs it. A VTK whose text differs replaces nothing: test_agreement.py would show it
    for original, replacement in VERTEX_SHADER.items():
        actor.GetShaderProperty().AddVertexShaderReplacement(
            original, True, replacement.replace("{near}", f"{near:.9f}"), False
        )
    for original, replacement in FRAGMENT_SHADER.items():
        actor.GetShaderProperty().AddFragmentShaderReplacement(original, False, replacement, False)
    if sort:
        plotter.renderer.SetUseOIT(False)
    frame = _Frame(plotter.renderer, actor, cloud, sort, moving, colors_from)
    plotter.renderer.AddObserver("StartEvent", frame.start)
    plotter.renderer.AddObserver("EndEvent", frame.end)
    return actor


class _Frame:
    """Before each frame: dilation for the window's size, order and colours for the camera, points while it moves."""

    def __init__(
        self,
        renderer: Any,
        actor: pv.Actor,
        cloud: pv.PolyData,
        sort: bool,
        moving: Moving,
        colors_from: Callable[[Array], Array] | None,
    ) -> None:
        self.renderer, self.actor, self.cloud, self.sort = renderer, actor, cloud, sort
        self.moving, self.colors_from = moving, colors_from
        self.points = np.array(cloud.points)
        self.order = np.arange(len(self.points))  # the rows of the cloud, as numbers of Gaussians
        self.forward: tuple[float, ...] | None = None
        self.center: tuple[float, ...] | None = None
        self.seconds, self.began = 0.0, 0.0
        self.stand_ins: list[Any] = []  # actors, while the camera moves

    def start(self, *_: Any) -> None:
        """The renderer is about to draw."""
        self.began = perf_counter()
        if self._moves():
            self._to_points()
            return
        self._to_gaussians()
        if not self._drawn():
            return
        width, height = self.renderer.GetSize()
        # VTK wants the covariance in normalised device coordinates, where the picture is 2 x 2
        self.actor.mapper.SetLowpassMatrix(LOW_PASS * (2 / width) ** 2, 0.0, LOW_PASS * (2 / height) ** 2)
        camera = self.renderer.GetActiveCamera()
        if self.sort:
            self._sort(camera.GetDirectionOfProjection())
        if self.colors_from is not None and camera.GetPosition() != self.center:
            self.center = camera.GetPosition()
            self.cloud.point_data["rgb"] = self.colors_from(np.asarray(self.center))[self.order]

    def end(self, *_: Any) -> None:
        """The renderer has drawn."""
        if self.moving == "auto" and not self.stand_ins and self._drawn():
            self.renderer.GetRenderWindow().WaitForCompletion()  # what was drawn so far was only asked for
            self.seconds = perf_counter() - self.began

    def _drawn(self) -> bool:
        return bool(self.renderer.HasViewProp(self.actor) and (self.stand_ins or self.actor.GetVisibility()))

    def _moves(self) -> bool:
        if not self._drawn():
            return False
        asked = self.renderer.GetRenderWindow().GetDesiredUpdateRate() >= STILL
        return asked and (self.moving == "points" or (self.moving == "auto" and self.seconds > SLOW))

    def _sort(self, forward: tuple[float, ...]) -> None:
        if self.forward == forward:  # order along a direction does not depend on where the camera stands
            return
        self.forward = forward
        order = np.argsort(-(self.points @ np.asarray(forward)), kind="stable")
        row = np.empty_like(self.order)
        row[self.order] = np.arange(len(row))  # of each Gaussian as the cloud is now
        self.cloud.points = self.points[order]
        for name in self.cloud.point_data:
            self.cloud.point_data[name] = np.asarray(self.cloud.point_data[name])[row[order]]
        self.order = order

    def _to_points(self) -> None:
        if self.stand_ins:
            return
        opacity = np.asarray(self.cloud.point_data["opacity"])
        clear, faint = opacity > FAINT["points"], (opacity <= FAINT["points"]) & (opacity >= ALPHA_MIN)
        for kept, most, alpha in ((faint, MOVING_FAINT, FAINT_ALPHA), (clear, MOVING_POINTS, 1.0)):
            rows = np.flatnonzero(kept)
            if len(rows):
                some = rows[evenly(len(rows), most)]
                self.stand_ins.append(_few_points(self.cloud, some, alpha))
                self.renderer.AddActor(self.stand_ins[-1])
        self.actor.SetVisibility(not self.stand_ins)

    def _to_gaussians(self) -> None:
        for stand_in in self.stand_ins:
            self.renderer.RemoveActor(stand_in)
            self.actor.SetVisibility(True)
        self.stand_ins.clear()


def _few_points(cloud: pv.PolyData, rows: Array, alpha: float) -> pv.Actor:
    import pyvista as pv

    points = pv.PolyData(np.asarray(cloud.points)[rows])
    points["rgb"] = np.asarray(cloud.point_data["rgb"])[rows]
    mapper = pv.DataSetMapper(points)
    mapper.set_scalars(points["rgb"], "rgb", rgb=True)
    actor = pv.Actor(mapper=mapper)
    actor.prop.style, actor.prop.point_size, actor.prop.lighting, actor.prop.opacity = "points", 3, False, alpha
    actor.SetPickable(False)
    return actor
