"""Draw anisotropic Gaussians with VTK's EWA splatting mapper, changed to follow the rules of kfgs's rasteriser."""

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

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Moving = Literal["auto", "points", "gaussians"]
LOW_PASS = 0.3  # pixels squared, added to each projected covariance as 3DGS does
BOUND = 3.0  # standard deviations at which VTK stops drawing; 3.3, where ALPHA_MIN stops, agrees no better
FAINT = 0.1  # opacity up to which points are left out or pale: they are opaque and would hide what is behind
MOVING_FAINT = 10_000  # faint points drawn while the camera moves: few enough to see the others
FAINT_ALPHA = 0.12
MOVING_POINTS = 50_000  # 0.14 s a frame of 1024 x 768 in software on two busy cores; 100,000 took 0.25 s
STILL = 1.0  # frames per second: VTK requests more while the mouse moves the camera, and 0.0001 when it rests
SLOW = 0.1  # seconds per frame; above it, "auto" draws points while the camera moves

# VTK drops a Gaussian if its centre is farther out than 1.3 times half the picture. 3DGS draws it, with the projection
# linearised at that border. Here half the picture is 1: normalised device coordinates have no principal point
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
WIDENED = "cov2d += mat2(lowpassMatrix.x, lowpassMatrix.y, lowpassMatrix.y, lowpassMatrix.z);"
FAINTER = f"""float plain = determinant(cov2d);
      {WIDENED}
      vertexColorVSOutput.a *= sqrt(max(plain, 0.0) / determinant(cov2d));"""
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
    antialiased: bool = False,
    colors_from: Callable[[Array], Array] | None = None,
) -> pv.Actor:
    """Draw a cloud with `index`, `rgb`, `scale`, `quat` (w, x, y, z; unit) and `opacity` as Gaussians.

    Sorted, it agrees with kfgs's rasteriser (`tests/viz/test_agreement.py`): through five cameras of room_0, 42 to 43 dB
    on the field's classes and 45 to 47 dB on the colours. Colours are bytes, so where harmonics are brighter than white,
    as in room_0's windows, it is 38 to 41 dB. Unsorted, translucency is averaged. Do not enable depth peeling: VTK's
    Gaussians vanish with it.

    Args:
        plotter: where to draw.
        cloud: its arrays may change later; a frame only changes their order.
        sort: draw back to front.
        moving: what to draw while the mouse moves the camera: "points" (at most 50,000, evenly chosen, and 10,000 pale ones
            for Gaussians with an opacity of at most 0.1), "gaussians", or "auto": points if a frame of Gaussians takes
            longer than 0.1 s.
        near: depth up to which nothing is drawn, world units (`Camera.near`).
        antialiased: what the low-pass filter widens becomes fainter (`Gaussians.antialiased`).
        colors_from: a function from the camera's position [3] to `rgb` in the order of `index`; None: fixed colours.
    """
    actor = draw_mesh(plotter, cloud, style="points_gaussian", scalars="rgb", rgb=True, emissive=False, lighting=False)
    mapper = actor.mapper
    mapper.SetScaleArray("scale")
    mapper.SetRotationArray("quat")
    mapper.SetOpacityArray("opacity")
    mapper.SetAnisotropic(True)
    mapper.SetScaleFactor(1.0)  # pyvista's factor would shrink them to a point size
    mapper.SetBoundScale(BOUND)
    # room_0's field: 24 dB with VTK's shaders, 39 with our vertex shader, 43 with both. One view of five needs kfgs's near
    # plane: 23 dB without. If another VTK has other shader text, nothing is replaced, and test_agreement.py fails
    shader = VERTEX_SHADER | ({WIDENED: FAINTER} if antialiased else {})
    for original, replacement in shader.items():
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
    """Prepares each frame: low-pass filter for the window's size, order and colours for the camera, points while it moves."""

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
        self.order = np.arange(len(self.points))  # the Gaussian in each row of the cloud
        self.forward: tuple[float, ...] | None = None
        self.center: tuple[float, ...] | None = None
        self.seconds, self.began = 0.0, 0.0
        self.moving_actors: list[Any] = []  # actors, while the camera moves

    def start(self, *_: Any) -> None:
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
        if self.moving == "auto" and not self.moving_actors and self._drawn():
            self.renderer.GetRenderWindow().WaitForCompletion()  # OpenGL draws asynchronously
            self.seconds = perf_counter() - self.began

    def _drawn(self) -> bool:
        return bool(self.renderer.HasViewProp(self.actor) and (self.moving_actors or self.actor.GetVisibility()))

    def _moves(self) -> bool:
        if not self._drawn():
            return False
        asked = self.renderer.GetRenderWindow().GetDesiredUpdateRate() >= STILL
        return asked and (self.moving == "points" or (self.moving == "auto" and self.seconds > SLOW))

    def _sort(self, forward: tuple[float, ...]) -> None:
        if self.forward == forward:  # the order depends on the direction, not on the camera's position
            return
        self.forward = forward
        order = np.argsort(-(self.points @ np.asarray(forward)), kind="stable")
        row = np.empty_like(self.order)
        row[self.order] = np.arange(len(row))  # the row of each Gaussian now
        self.cloud.points = self.points[order]
        for name in self.cloud.point_data:
            self.cloud.point_data[name] = np.asarray(self.cloud.point_data[name])[row[order]]
        self.order = order

    def _to_points(self) -> None:
        if self.moving_actors:
            return
        opacity = np.asarray(self.cloud.point_data["opacity"])
        clear, faint = opacity > FAINT, (opacity <= FAINT) & (opacity >= ALPHA_MIN)
        for kept, most, alpha in ((faint, MOVING_FAINT, FAINT_ALPHA), (clear, MOVING_POINTS, 1.0)):
            rows = np.flatnonzero(kept)
            if len(rows):
                some = rows[evenly(len(rows), most)]
                self.moving_actors.append(_few_points(self.cloud, some, alpha))
                self.renderer.AddActor(self.moving_actors[-1])
        self.actor.SetVisibility(not self.moving_actors)

    def _to_gaussians(self) -> None:
        for actor in self.moving_actors:
            self.renderer.RemoveActor(actor)
            self.actor.SetVisibility(True)
        self.moving_actors.clear()


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
