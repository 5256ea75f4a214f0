"""The raw, trainable values of a cloud of Gaussians, and their start from a point cloud or from Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isqrt
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import ORIGIN, as_tensor, check_range, check_shapes, check_whole
from .._origin import Origin
from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0

# Bounds of a point's spacing: near-duplicates would give specks, and a lonely point a giant Gaussian.
SMALLEST_SPACING = 0.01  # times the median spacing
LARGEST_SPACING_QUANTILE = 0.99
OUTLIER_RANGE = 4.0  # times the 0.95 quantile of the distances from the median: points farther out are dropped
_NAMES = ("means", "quats", "log_scales", "logit_opacities", "features", "sh0", "sh_rest")


@dataclass(frozen=True, eq=False)
class GaussianParams:
    """N Gaussians as unbounded numbers for the optimiser. `activated()` returns them as `Gaussians`.

    **Convention**: scales are logarithms of world units, opacities are logits, quaternions are (w, x, y, z) of any
    length; features and spherical harmonics are linear, without activation. A semantic field has `features`, a colour
    field `sh0` and, above degree 0, `sh_rest`: two tensors, because their learning rates differ.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz
    log_scales: Tensor  # [N, 3]
    logit_opacities: Tensor  # [N]
    features: Tensor | None = None  # [N, D]
    sh0: Tensor | None = None  # [N, 3], the coefficient of degree 0
    sh_rest: Tensor | None = None  # [N, K - 1, 3], K = (degree + 1)^2; None at degree 0
    origin: Origin = ORIGIN  # as in `Gaussians`
    antialiased: bool = False  # as in `Gaussians`

    def __post_init__(self) -> None:
        shapes = "N 3", "N 4", "N 3", "N", "N D", "N 3", "N R 3"
        check_shapes(*((name, getattr(self, name), shape) for name, shape in zip(_NAMES, shapes, strict=True)))
        if (self.features is None) == (self.sh0 is None):
            got = "neither" if self.features is None else "both"
            raise ValueError(f"features, sh0: expected one of them, got {got}; a field has features or colours")
        if self.sh_rest is not None and (self.sh0 is None or self.sh_rest.shape[1] not in (3, 8, 15)):
            raise ValueError(
                f"sh_rest: expected 3, 8 or 15 coefficients (degree 1 to 3) with sh0, got {self.sh_rest.shape[1]}"
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        kind = f"SH degree {self.sh_degree}" if self.sh0 is not None else f"{self.channels} channels"
        return f"GaussianParams({len(self)} Gaussians, {kind}, {self.means.dtype})"

    @property
    def channels(self) -> int:
        """D, the channels of a rendered map: the number of features per Gaussian, or 3 for colours."""
        return 3 if self.features is None else int(self.features.shape[1])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics; 0 if there are none."""
        return 0 if self.sh_rest is None else isqrt(self.sh_rest.shape[1] + 1) - 1

    def used_sh_degree(self) -> int:
        """Highest degree with a coefficient other than 0; 0 if only `sh0` is used."""
        if self.sh_rest is None:
            return 0
        filled = self.sh_rest.detach().ne(0).any(dim=2).any(dim=0)  # [K - 1]
        return isqrt(int(filled.nonzero().max()) + 1) if bool(filled.any()) else 0

    def to_tensors(self) -> dict[str, Tensor]:
        """The raw tensors (without None) by name, in a fixed order."""
        values = {name: getattr(self, name) for name in _NAMES}
        return {name: value for name, value in values.items() if value is not None}

    def map(self, function: Callable[[Tensor], Tensor]) -> GaussianParams:
        """Apply one function to every raw tensor."""
        mapped: dict[str, Any] = {name: function(value) for name, value in self.to_tensors().items()}
        return replace(self, **mapped)

    def activated(self, sh_degree: int | None = None) -> Gaussians:
        """The Gaussians with these values; differentiable. Of colours, only harmonics up to `sh_degree` (None: all)."""
        sh = None
        if self.sh0 is not None:
            degree = self.sh_degree if sh_degree is None else min(sh_degree, self.sh_degree)
            rest = [] if degree == 0 or self.sh_rest is None else [self.sh_rest[:, : (degree + 1) ** 2 - 1]]
            sh = torch.cat([self.sh0[:, None], *rest], dim=1)
        shape = self.means, self.quats, self.log_scales.exp(), self.logit_opacities.sigmoid()
        return Gaussians(*shape, features=self.features, sh=sh, origin=self.origin, antialiased=self.antialiased)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianParams:
        """The raw values of a cloud with features or colours, to continue training: the inverse of `activated`.

        If a cloud has both, features are taken. Scales of 0 become the smallest normal number, and opacities keep eps away
        from 0 and 1, because logarithm and logit must be finite.

        Raises:
            ValueError: if the Gaussians carry neither.
        """
        if gaussians.features is None and gaussians.sh is None:
            raise ValueError(
                "gaussians: expected features [N, D] or sh [N, K, 3], got neither; give them some with replace()"
            )
        cloud = gaussians.detach()
        sh = None if cloud.features is not None else cloud.sh
        return cls(
            means=cloud.means,
            quats=cloud.quats,
            log_scales=cloud.scales.clamp_min(torch.finfo(cloud.scales.dtype).tiny).log(),
            logit_opacities=torch.logit(cloud.opacities, eps=torch.finfo(cloud.opacities.dtype).eps),
            features=cloud.features,
            sh0=None if sh is None else sh[:, 0],
            sh_rest=sh[:, 1:] if sh is not None and sh.shape[1] > 1 else None,
            origin=cloud.origin,
            antialiased=cloud.antialiased,
        ).map(torch.clone)

    @classmethod
    def from_points(
        cls,
        points: Tensor,  # [P, 3] world units
        channels: int | None = None,
        *,
        colors: Tensor | None = None,  # [P, 3] in [0, 1], or uint8
        sh_degree: int = 3,
        initial_opacity: float = 0.1,
    ) -> GaussianParams:
        """Put one round Gaussian on each point, with the distance of its three nearest neighbours as its width (3DGS).

        Features start at 0 and rotations at the identity. With `colors` it becomes a colour field: each Gaussian has its
        point's colour from all directions. Structure from motion leaves points far outside a scene (30 times its size is
        common): a point is dropped if its distance from the median exceeds 4 times the 0.95 quantile of these distances.

        Args:
            points: the cloud, usually `Scene.points`; at least two different ones.
            channels: D, the number of features per Gaussian; leave it out with `colors`.
            colors: of the points, usually `Scene.colors`; None starts a field of features.
            sh_degree: highest degree of the spherical harmonics of a colour field, 0 to 3.
            initial_opacity: in (0, 1).

        Example:
            >>> cube = torch.tensor([[x, y, z] for x in (0., 1.) for y in (0., 1.) for z in (0., 1.)])
            >>> GaussianParams.from_points(cube, 9).activated().scales[0]
            tensor([1., 1., 1.])
        """
        points = as_tensor("points", points, floating=True).detach()
        if colors is not None:
            colors = as_tensor("colors", colors).to(points.device)
            colors = colors.double() / 255 if colors.dtype == torch.uint8 else colors
            if not bool(((colors >= 0) & (colors <= 1)).all()):
                raise ValueError("colors: expected uint8, or numbers in [0, 1], got others; divide by 255")
        check_shapes(("points", points, "P 3"), ("colors", colors, "P 3"))
        check_whole("channels", 1 if channels is None else channels, 1)
        check_whole("sh_degree", sh_degree, 0, 3)
        check_range("initial_opacity", initial_opacity, 0, 1, closed=(False, False))
        if not bool(torch.isfinite(points).all()):
            raise ValueError("points: expected finite numbers, got others; drop those rows first")
        if len(points):
            distance = (points - points.median(dim=0).values).norm(dim=1)
            radius = float(np.quantile(distance.cpu().double().numpy(), 0.95))  # torch.quantile stops at 16M elements
            kept = distance <= (OUTLIER_RANGE * radius or math.inf)
            points, colors = points[kept], None if colors is None else colors[kept]
        n = len(points)
        return cls(
            means=points.clone(),
            quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            log_scales=point_spacing(points).log()[:, None].repeat(1, 3),
            logit_opacities=points.new_full((n,), math.log(initial_opacity / (1 - initial_opacity))),
            features=None if channels is None else points.new_zeros(n, channels),
            sh0=None if colors is None else rgb_to_sh0(colors.to(points)),
            sh_rest=points.new_zeros(n, (sh_degree + 1) ** 2 - 1, 3) if colors is not None and sh_degree else None,
        )


def point_spacing(points: Tensor) -> Tensor:  # [P, 3] -> [P] world units
    """Root mean square distance to the three nearest other positions, clamped to bounds. Equal points are one position."""
    cloud, where = np.unique(points.detach().cpu().double().numpy(), axis=0, return_inverse=True)
    if len(cloud) < 2:
        raise ValueError(
            f"points: expected at least two different points, got {len(points)} point(s) at {len(cloud)} place(s); "
            "check that the reconstruction holds points"
        )
    neighbours = min(3, len(cloud) - 1)
    distances = np.asarray(cKDTree(cloud).query(cloud, k=neighbours + 1)[0])[:, 1:]  # the nearest is the point itself
    spacing = np.sqrt((distances**2).mean(axis=1))
    lower = SMALLEST_SPACING * float(np.median(spacing))
    upper = float(np.quantile(spacing, LARGEST_SPACING_QUANTILE))
    return torch.from_numpy(np.clip(spacing, lower, max(lower, upper))[where.reshape(-1)]).to(points)
