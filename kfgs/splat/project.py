"""Project 3-D Gaussians to 2-D ones on the image plane (EWA splatting)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.camera import dx_project_points_z1
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from .._card import short_repr
from .._check import check_range
from ..cameras.camera import Camera
from ..cameras.projection import camera_to_pixel, refuse_distortion, world_to_camera
from ..gaussians import Gaussians
from .engines.contract import ALPHA_MIN, Cloud, Pinhole
from .engines.table import choose_projecting

FIELD_OF_VIEW_MARGIN = 1.3
"""Limit of the linearisation, in half fields of view (3DGS). Beyond it, the linear footprint of a Gaussian next to the
camera grows without bound and would cover the picture."""


class Projected(NamedTuple):
    """The M Gaussians that can be seen, on the image plane, in increasing order of `index`."""

    means2d: Tensor  # [M, 2] pixels (x, y)
    conics: Tensor  # [M, 3] (a, b, c) of the inverse 2-D covariance [[a, b], [b, c]], 1/pixels^2
    depths: Tensor  # [M] z in the camera's frame, world units
    opacities: Tensor  # [M]
    extents: Tensor  # [M, 2] half-widths of the box outside of which alpha < 1/255, pixels; no gradient
    index: Tensor  # type: ignore[assignment]  # [M] int64, which of the N Gaussians

    def __repr__(self) -> str:
        return short_repr(self)


def project(
    gaussians: Gaussians,
    camera: Camera,
    *,
    near: float | None = None,
    low_pass: float = 0.3,
    engine: str = "auto",
) -> Projected:
    """Project Gaussians through a pinhole camera and cull those that cannot touch a pixel.

    The 2-D covariance is J W Sigma W^T J^T + low_pass * I (Zwicker et al. 2001, eq. 31), with W the camera's rotation
    and J the Jacobian of the projection at the mean. Beyond `FIELD_OF_VIEW_MARGIN` times the picture's half-size from its
    middle (in tangents), J is that of this limit.
    Culled are: depth <= near, opacity <= 1/255, and footprints {alpha >= 1/255} whose bounding box holds no pixel centre.
    The opacity of an `antialiased` cloud is multiplied by sqrt(det S / det(S + low_pass I)), S = J W Sigma W^T J^T: what is
    widened becomes fainter (the 2-D filter of Mip-Splatting, Yu et al. 2024, eq. 9).

    Args:
        gaussians: the N Gaussians; `means`, `quats`, `scales` and `opacities` are differentiable.
        camera: without distortion; cast to the Gaussians' dtype and device.
        near: smallest depth that is drawn, world units; None: the camera's.
        low_pass: variance in pixels^2 added on both axes, so that nothing is smaller than a pixel.
        engine: as in `composite`. "reference" uses kornia's functions under autograd; the others are compiled.

    Returns:
        The M visible Gaussians; M = 0 is possible.

    Raises:
        ValueError: if the camera has distortion, `near` is not positive or `low_pass` is negative, or the engine is
            unknown or cannot work on these tensors.
        ImportError: if the named engine's package is missing.

    Note:
        A Gaussian with NaN or infinite parameters, or whose footprint overflows, is culled. Its gradients are zero.

        The compiled code has no gradients of gradients, and none in the camera: if `camera.viewmat` or `camera.K`
        requires one, kornia's functions are used.
    """
    refuse_distortion(camera)
    near = camera.near if near is None else near
    check_range("near", near, 0, closed=(False, False))
    check_range("low_pass", low_pass, 0, closed=(True, False))
    camera = camera.with_origin(gaussians.origin)
    if any(m.dtype != gaussians.means.dtype or m.device != gaussians.means.device for m in (camera.viewmat, camera.K)):
        camera = camera.to(gaussians.means)
    values = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    to_camera = torch.is_grad_enabled() and (camera.viewmat.requires_grad or camera.K.requires_grad)
    compiled = choose_projecting(engine, *values)
    if compiled and not to_camera:
        cloud = Cloud(*(value.contiguous() for value in values))
        pinhole = Pinhole(camera.viewmat, camera.K, camera.width, camera.height, near, low_pass)
        projected = Projected(*compiled.project(cloud, pinhole))
    else:
        projected = _project(gaussians, camera, near, low_pass)
    return _compensate(projected, camera, low_pass) if gaussians.antialiased else projected


def _project(gaussians: Gaussians, camera: Camera, near: float, low_pass: float) -> Projected:
    """The projection by kornia and autograd, on any device."""
    index = _candidates(gaussians, camera, near, low_pass)
    points = world_to_camera(camera, gaussians.means[index])  # [m, 3]: without the culled ones, which have no gradient
    opacities = gaussians.opacities[index]
    means2d = camera_to_pixel(camera, points)
    variances, covariances, det = _covariance_2d(
        _jacobian(points, camera) @ camera.viewmat[:3, :3],
        gaussians.quats[index],
        gaussians.scales[index],
        low_pass,
    )
    with torch.no_grad():
        extents = (squared_reach(opacities)[:, None] * variances).sqrt()
        keep = _touches_pixel(means2d, extents, camera).nonzero().squeeze(1)
    variance_x, variance_y = variances.unbind(1)
    conics = torch.stack([variance_y, -covariances, variance_x], dim=1) / det[:, None]
    depths = points[:, 2]
    return Projected(means2d[keep], conics[keep], depths[keep], opacities[keep], extents[keep], index[keep])


def _compensate(projected: Projected, camera: Camera, low_pass: float) -> Projected:
    """Lower the opacities by what `low_pass` widened, and cull again.

    det S / det(S + l I) = det(I - l C) with the conic C = (S + l I)^-1. Its rounding error of about 1e-7 changes an opacity
    that is drawn by at most 1e-5.
    """
    means2d, conics, depths, opacities, extents, index = projected
    a, b, c = (low_pass * conics).unbind(1)
    squared = (1 - a) * (1 - c) - b * b
    with torch.no_grad():
        reduced = squared_reach(opacities * squared.clamp(min=0).sqrt())  # negative: faint, and NaN as an extent
        extents = extents * (reduced / squared_reach(opacities)).sqrt()[:, None]
        keep = _touches_pixel(means2d, extents, camera).nonzero().squeeze(1)
    # The culled are left out before the root, whose slope at 0 is infinite.
    opacities = opacities[keep] * squared[keep].sqrt()
    return Projected(means2d[keep], conics[keep], depths[keep], opacities, extents[keep], index[keep])


def pixel_box(
    means2d: Tensor,  # [M, 2]
    extents: Tensor,  # [M, 2]
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """The pixels whose centres lie within `extents` of the means: first (column, row) and end, one past the last, [M, 2] each.

    Values are whole but of the input's dtype, clamped to the image; an empty box has end <= first, a NaN stays NaN.
    """
    size = torch.tensor([width, height], dtype=means2d.dtype, device=means2d.device)
    rounding = 4 * torch.finfo(means2d.dtype).eps * (means2d.abs() + extents)  # never lose a pixel to it
    first = torch.ceil(means2d - extents - 0.5 - rounding).clamp(min=0)
    end = torch.floor(means2d + extents - 0.5 + rounding) + 1
    return first, torch.minimum(end, size)


def _touches_pixel(means2d: Tensor, extents: Tensor, camera: Camera) -> Tensor:  # [M] bool
    first, end = pixel_box(means2d, extents, camera.width, camera.height)
    return (end > first).all(dim=1)


def squared_reach(opacities: Tensor) -> Tensor:  # [M] -> [M]
    """Largest value of d^T C d at which opacity * exp(-0.5 d^T C d) >= ALPHA_MIN; negative for an opacity below it."""
    return 2 * torch.log(opacities / ALPHA_MIN)


def _jacobian(points: Tensor, camera: Camera) -> Tensor:  # [M, 3] of the camera's frame -> [M, 2, 3]
    """Derivative of the projection, d(u, v) / d(x, y, z), in pixels per world unit (EWA, Zwicker 2001).

    It is taken at the point, moved along the image plane to where the projection may be linearised.
    """
    focal = camera.K.diagonal()[:2]
    size = torch.tensor([camera.width, camera.height], dtype=points.dtype, device=points.device)
    middle = (size / 2 - camera.K[:2, 2]) / focal
    half = FIELD_OF_VIEW_MARGIN * size / 2 / focal
    z = points[:, 2:]
    tangents = torch.clamp(points[:, :2] / z, middle - half, middle + half)
    return dx_project_points_z1(torch.cat([tangents * z, z], dim=1)) * focal[:, None]


@torch.no_grad()
def _candidates(gaussians: Gaussians, camera: Camera, near: float, low_pass: float) -> Tensor:  # [m] int64
    """Cull, without looking at rotations: the footprint is bounded by that of a ball around the Gaussian."""
    points = world_to_camera(camera, gaussians.means)  # [N, 3]
    index = ((points[:, 2] > near) & (squared_reach(gaussians.opacities) > 0)).nonzero().squeeze(1)
    points = points[index]
    J = _jacobian(points, camera)
    largest = gaussians.scales[index].amax(dim=1, keepdim=True)
    variances = (J * J).sum(dim=2) * largest**2 + low_pass
    extents = (squared_reach(gaussians.opacities[index])[:, None] * variances).sqrt()
    extents = extents * (1 + 1e-3)  # a bound stays one after rounding
    keep = _touches_pixel(camera_to_pixel(camera, points), extents, camera)
    # Where a number overflows or is NaN, gradients would be NaN. The determinant is at most the variances' product.
    sizes = torch.linalg.vector_norm(gaussians.quats[index], dim=1) + extents.sum(dim=1) + variances.prod(dim=1)
    return index[keep & torch.isfinite(sizes)]


def _covariance_2d(
    JW: Tensor,  # [M, 2, 3]
    quats: Tensor,  # [M, 4]
    scales: Tensor,  # [M, 3]
    low_pass: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Variances [M, 2] along x and y, covariance [M] and determinant [M] of J W R S S R^T W^T J^T + low_pass I.

    Sums of elementwise products: a batch of small matrix products is several times slower on a CPU.
    """
    R = quaternion_to_rotation_matrix(quats)  # [M, 3, 3]
    u = (JW[:, 0, :, None] * R).sum(dim=1) * scales  # row x of J W R S, [M, 3]
    v = (JW[:, 1, :, None] * R).sum(dim=1) * scales
    plain = torch.stack([(u * u).sum(dim=1), (v * v).sum(dim=1)], dim=1)
    # |u|^2 |v|^2 - (u.v)^2 = |u x v|^2 (Lagrange): the difference cancels for needles, the cross product does not.
    area = torch.linalg.cross(u, v)
    det = (area * area).sum(dim=1) + low_pass * plain.sum(dim=1) + low_pass**2
    return plain + low_pass, (u * v).sum(dim=1), det
