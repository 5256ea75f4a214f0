"""Inputs that the splatting tests share: random clouds, cameras that are not symmetric, and tolerances by dtype."""

from __future__ import annotations

import torch
from torch import Tensor

from kfgs.cameras.camera import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat.project import Projected

TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-10}  # absolute, for values of about 1


def random_splats(
    M, width, height, *, seed, dtype=torch.float64, opacities=(0.05, 0.95), sigma=(0.7, 6.0), channels=3
) -> tuple[Projected, Tensor]:
    """M projected Gaussians in and around an image, a third of them at equal depth, and their features [M, D].

    `sigma` is in pixels."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    means2d = torch.stack([uniform(-3, width + 3, M), uniform(-3, height + 3, M)], dim=1)
    angle, sigmas = uniform(0, torch.pi, M), uniform(*sigma, M, 2)
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], dim=1).view(M, 2, 2) * sigmas[:, None]
    covs = axes @ axes.mT
    depths, opacity, features = (
        uniform(1, 10, M),
        uniform(*opacities, M),
        torch.randn(M, channels, generator=g).double(),
    )
    depths[: M // 3] = 5.0
    return splats_from(means2d, covs, depths, opacity, dtype), features.to(dtype)


def splats_from(means2d: Tensor, covs: Tensor, depths: Tensor, opacities: Tensor, dtype: torch.dtype) -> Projected:
    """Projected Gaussians from 2-D covariances [M, 2, 2]."""
    C = torch.linalg.inv(covs)
    conics = torch.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], dim=1)
    reach = 2 * torch.log(255 * opacities.clamp(min=1 / 255))
    extents = (reach[:, None] * covs.diagonal(dim1=1, dim2=2)).sqrt()
    index = torch.arange(len(means2d))
    return Projected(*(v.to(dtype) for v in (means2d, conics, depths, opacities, extents)), index)


def a_camera(width=24, height=18, *, focal=(22.0, 19.0), principal=(10.3, 8.1), seed=0, dtype=torch.float64) -> Camera:
    """A camera somewhere, turned somehow, with unequal focal lengths and a principal point off the middle."""
    g = torch.Generator().manual_seed(seed)
    R = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64)).Q
    R = R * torch.linalg.det(R).sign()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R, torch.randn(3, generator=g, dtype=torch.float64)
    K = torch.tensor([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat.to(dtype), K.to(dtype), width, height)


def gaussians_before(
    camera, N, *, seed, depth=(1.0, 10.0), spread=1.2, sigma=(0.02, 0.15), opacities=(0.2, 0.8), channels=3
) -> Gaussians:
    """N Gaussians at random places of the camera's view, and somewhat around it, in world coordinates.

    `spread` is 1 where they fill the picture; `sigma` is a share of the depth."""
    g = torch.Generator().manual_seed(seed)
    dtype = camera.K.dtype

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return (low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)).to(dtype)

    z = uniform(*depth, N)
    size = torch.tensor([camera.width, camera.height], dtype=dtype)
    pixels = size / 2 + spread * size * uniform(-0.5, 0.5, N, 2)
    points = torch.cat([(pixels - camera.K[:2, 2]) / camera.K.diagonal()[:2] * z[:, None], z[:, None]], dim=1)
    means = (points - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return Gaussians(
        means=means,
        quats=torch.randn(N, 4, generator=g, dtype=torch.float64).to(dtype),
        scales=uniform(*sigma, N, 3) * z[:, None],
        opacities=uniform(*opacities, N),
        features=torch.randn(N, channels, generator=g, dtype=torch.float64).to(dtype),
    )
