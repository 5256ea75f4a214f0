"""The Gaussian under a pixel, from rendering weights w = T alpha (Eq. 3): what a click in the viewer must find."""

from __future__ import annotations

import torch
from torch import Tensor

from kfgs._check import check_shapes
from kfgs.cameras import Camera
from kfgs.cameras.projection import world_to_camera
from kfgs.gaussians import Gaussians
from kfgs.splat import ALPHA_MIN, project
from kfgs.splat.engines.contract import ALPHA_MAX, TRANSMITTANCE_MIN
from kfgs.splat.project import FIELD_OF_VIEW_MARGIN
from kfgs.viz.gaussian_actor import LOW_PASS

BACKGROUND = 0.05  # a pixel covered less than this shows the background


def gaussian_at(
    gaussians: Gaussians,
    camera: Camera,
    x: float,
    y: float,
    mask: Tensor | None = None,  # [N] bool
) -> int | None:
    """The Gaussian with the largest rendering weight w = T alpha at a pixel (Eq. 3).

    **Convention**: pixels, x to the right and y down; the centre of the first pixel is (0.5, 0.5).

    The camera has no distortion. `mask` says which Gaussians exist here; None: all. Of equal weights the nearest wins.
    None if less than 5 % of the pixel is covered (background), or the pixel is outside the picture.
    """
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("mask", mask, "N"))
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return None
    with torch.no_grad():
        index, weights = _weights_at(gaussians, camera, (x, y), mask)
    return None if float(weights.sum()) < BACKGROUND else int(index[weights.argmax()])


def _weights_at(
    gaussians: Gaussians,
    camera: Camera,
    place: tuple[float, float],  # (x, y)
    mask: Tensor | None = None,  # [N] bool
) -> tuple[Tensor, Tensor]:  # [m] int64, [m]
    """Weights of the Gaussians composited at a place, front to back (point 2 of the engines' contract)."""
    index = _near_ray(gaussians, camera, place)
    if mask is not None:
        index = index[mask.to(index.device)[index]]
    seen = project(gaussians.select(index), camera)
    dx, dy = (torch.tensor(place).to(seen.means2d) - seen.means2d).unbind(1)
    a, b, c = seen.conics.unbind(1)
    alphas = (seen.opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))).clamp_max(ALPHA_MAX)
    order = seen.depths.argsort(stable=True)  # by depth, then by index
    order = order[alphas[order] >= ALPHA_MIN]
    alphas = alphas[order]
    after = torch.cumprod(1 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    drawn = after >= TRANSMITTANCE_MIN  # `after` decreases, so these come first
    return index[seen.index[order]][drawn], (alphas * before)[drawn]


def _near_ray(gaussians: Gaussians, camera: Camera, place: tuple[float, float]) -> Tensor:  # [m] int64, ascending
    """The Gaussians that can reach a place in the picture, by the bound of `project` without rotations."""
    camera = camera.to(gaussians.means).with_origin(gaussians.origin)
    reach = 2 * torch.log(gaussians.opacities / ALPHA_MIN)  # d^T C d where alpha falls to 1/255
    largest = gaussians.scales.amax(dim=1).square()
    points = world_to_camera(camera, gaussians.means)
    z = points[:, 2]
    near = (z > camera.near) & (reach >= 0)
    for axis, size in enumerate((camera.width, camera.height)):
        f, c = float(camera.K[axis, axis]), float(camera.K[axis, 2])
        tangent = points[:, axis] / z
        middle, half = (size / 2 - c) / f, FIELD_OF_VIEW_MARGIN * size / 2 / f
        slope = 1 + tangent.clamp(middle - half, middle + half).square()  # of row `axis` of J, squared, times (z / f)^2
        variance = largest * slope * (f / z).square() + LOW_PASS
        near &= (f * tangent + (c - place[axis])).square() <= 1.01 * reach * variance + 1e-3  # room for rounding
    return near.nonzero()[:, 0]
