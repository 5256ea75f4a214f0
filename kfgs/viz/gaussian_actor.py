"""Draw anisotropic Gaussians with VTK's EWA splatting mapper, changed to follow the rules of kfgs's rasteriser."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..gaussians import Gaussians
from ..splat.engines.contract import ALPHA_MAX, ALPHA_MIN
from ..splat.project import FIELD_OF_VIEW_MARGIN
from ..splat.sh import evaluate_sh
from .pictures import as_bytes
from .plotter import draw_mesh

if TYPE_CHECKING:
    import pyvista as pv

LOW_PASS = 0.3  # pixels squared, added to each projected covariance as 3DGS does
BOUND = 3.0  # standard deviations at which VTK stops drawing; 3.3, where ALPHA_MIN stops, agrees no better

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
FRAGMENT = f"{DENSITY} if (opacity*gaussian < {ALPHA_MIN:.9f}) discard; gaussian = min(gaussian, {ALPHA_MAX}/opacity);"


def as_gaussians(
    plotter: pv.Plotter, cloud: pv.PolyData, near: float, antialiased: bool, followed: Gaussians | None, **options: Any
) -> pv.Actor:
    """Draw a cloud with `index`, `rgb`, `scale`, `quat` (w, x, y, z; unit) and `opacity` as Gaussians.

    It agrees with kfgs's rasteriser (`tests/viz/test_agreement.py`): through five cameras of room_0, 42 to 43 dB on the
    field's classes and 45 to 47 dB on the colours. Colours are bytes, so where harmonics are brighter than white, as in
    room_0's windows, it is 38 to 41 dB. Do not enable depth peeling: VTK's Gaussians vanish with it.

    Args:
        plotter: where to draw.
        cloud: its arrays may change later; a frame only changes their order.
        near: depth up to which nothing is drawn, world units (`Camera.near`).
        antialiased: what the low-pass filter widens becomes fainter (`Gaussians.antialiased`).
        followed: Gaussians whose `sh` gives `rgb` as the camera sees it, in the order of `index`; None: fixed colours.
        options: of `plotter.add_mesh`.
    """
    actor = draw_mesh(plotter, cloud, style="points_gaussian", emissive=False, **options)
    mapper = actor.mapper
    with suppress(ImportError):  # vtk.js has no Gaussians: without this, a page that pyvista exports lacks the cloud
        from trame_vtk.modules.vtk.serializers import mappers, registry

        registry.register_instance_serializer(mapper.GetClassName(), mappers.generic_mapper_serializer)
        registry.register_js_class(mapper.GetClassName(), "vtkMapper")
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
    actor.GetShaderProperty().AddFragmentShaderReplacement(DENSITY, False, FRAGMENT, False)
    plotter.renderer.SetUseOIT(False)  # VTK would average translucency instead of drawing back to front
    plotter.renderer.AddObserver("StartEvent", _Frame(plotter.renderer, actor, cloud, followed).start)
    return actor


class _Frame:
    """Prepares each frame: low-pass filter for the window's size, order and colours for the camera."""

    def __init__(self, renderer: Any, actor: pv.Actor, cloud: pv.PolyData, followed: Gaussians | None) -> None:
        self.renderer, self.actor, self.cloud, self.followed = renderer, actor, cloud, followed
        self.points = np.array(cloud.points)
        self.order = np.arange(len(self.points))  # the Gaussian in each row of the cloud
        self.forward: tuple[float, ...] | None = None
        self.center: tuple[float, ...] | None = None

    def start(self, *_: Any) -> None:
        if not (self.renderer.HasViewProp(self.actor) and self.actor.GetVisibility()):
            return
        width, height = self.renderer.GetSize()
        # VTK wants the covariance in normalised device coordinates, where the picture is 2 x 2
        self.actor.mapper.SetLowpassMatrix(LOW_PASS * (2 / width) ** 2, 0.0, LOW_PASS * (2 / height) ** 2)
        camera = self.renderer.GetActiveCamera()
        forward = camera.GetDirectionOfProjection()
        if forward != self.forward:  # the order depends on the direction, not on the camera's position
            self.forward = forward
            order = np.argsort(-(self.points @ np.asarray(forward)), kind="stable")
            row = np.empty_like(self.order)
            row[self.order] = np.arange(len(row))  # the row of each Gaussian now
            self.cloud.points = self.points[order]
            for name in self.cloud.point_data:
                self.cloud.point_data[name] = np.asarray(self.cloud.point_data[name])[row[order]]
            self.order = order
        if self.followed is not None and camera.GetPosition() != self.center:
            self.center, means, sh = camera.GetPosition(), self.followed.means, self.followed.sh
            assert sh is not None
            seen = evaluate_sh(sh, means - torch.tensor(self.center).to(means))
            self.cloud.point_data["rgb"] = as_bytes(seen)[self.order]
