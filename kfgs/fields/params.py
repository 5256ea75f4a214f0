"""The raw, trainable values behind a cloud of Gaussians, and how they start from a point cloud."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .._check import check_range, check_shapes
from ..gaussians import Gaussians

# Spacing of a point is held within these bounds: near-duplicates would give specks, a loner a giant Gaussian.
SMALLEST_SPACING = 0.01  # times the median spacing
LARGEST_SPACING_QUANTILE = 0.99


@dataclass(frozen=True, eq=False)
class GaussianParams:
    """N Gaussians as the optimiser sees them: unbounded numbers. `activated()` gives what everyone else uses.

    **Convention**: scales are logarithms of world units, opacities are logits, quaternions are (w, x, y, z) of any
    length; features are linear, without activation.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz
    log_scales: Tensor  # [N, 3]
    logit_opacities: Tensor  # [N]
    features: Tensor  # [N, D]

    def __post_init__(self) -> None:
        check_shapes(
            ("means", self.means, "N 3"),
            ("quats", self.quats, "N 4"),
            ("log_scales", self.log_scales, "N 3"),
            ("logit_opacities", self.logit_opacities, "N"),
            ("features", self.features, "N D"),
        )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        return f"GaussianParams({len(self)} Gaussians, {self.channels} channels, {self.means.dtype})"

    @property
    def channels(self) -> int:
        """D, the number of features per Gaussian."""
        return int(self.features.shape[1])

    def to_tensors(self) -> dict[str, Tensor]:
        """The raw tensors by name, in a fixed order."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> GaussianParams:
        """The params that `to_tensors` took apart; other names are ignored.

        Raises:
            ValueError: if a name is missing.
        """
        names = [field.name for field in fields(cls)]
        missing = [name for name in names if name not in tensors]
        if missing:
            raise ValueError(
                f"tensors: expected the names {names}, got {sorted(tensors)} without {missing}; "
                "pass what GaussianParams.to_tensors gave"
            )
        return cls(**{name: tensors[name] for name in names})

    def map(self, function: Callable[[Tensor], Tensor]) -> GaussianParams:
        """Apply one function to every raw tensor."""
        return GaussianParams(**{name: function(value) for name, value in self.to_tensors().items()})

    def activated(self) -> Gaussians:
        """The Gaussians these values stand for; differentiable."""
        return Gaussians(
            self.means, self.quats, self.log_scales.exp(), self.logit_opacities.sigmoid(), features=self.features
        )

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianParams:
        """The raw values of a cloud with features: the inverse of `activated`, to train on from there.

        Raises:
            ValueError: if the Gaussians carry no features.
        """
        if gaussians.features is None:
            raise ValueError("gaussians: expected features [N, D], got None; give them some with replace(features=...)")
        tiny = torch.finfo(gaussians.opacities.dtype).eps  # a logit stays finite
        return cls(
            means=gaussians.means.detach().clone(),
            quats=gaussians.quats.detach().clone(),
            log_scales=gaussians.scales.detach().log(),
            logit_opacities=torch.logit(gaussians.opacities.detach(), eps=tiny),
            features=gaussians.features.detach().clone(),
        )

    @classmethod
    def from_points(
        cls,
        points: Tensor,  # [P, 3] world units
        channels: int,
        *,
        initial_opacity: float = 0.1,
        max_points: int | None = None,
        outlier_range: float = 4.0,
        generator: torch.Generator | None = None,
    ) -> GaussianParams:
        """Put one round Gaussian on each point, as wide as its three nearest neighbours are away (3DGS).

        The standard deviation is the root mean square of the three distances, held between `SMALLEST_SPACING` times its
        median and its 0.99 quantile, so that near-duplicates and lonely points are harmless. Features start at 0 and
        rotations at the identity.

        Structure from motion leaves points far outside a scene (30 times its size is common). A point is dropped when
        its distance from the coordinate-wise median exceeds `outlier_range` times the 0.95 quantile of these distances.

        Args:
            points: the cloud, usually `Scene.points`.
            channels: D, the number of features per Gaussian.
            initial_opacity: in (0, 1).
            max_points: keep a random subset of at most this many (after outliers are dropped).
            outlier_range: infinity keeps every point.
            generator: draws the subset; None draws the same one each time.

        Raises:
            ValueError: for points that are not finite or not at least two different ones, or options out of range.

        Example:
            >>> cube = torch.tensor([[x, y, z] for x in (0., 1.) for y in (0., 1.) for z in (0., 1.)])
            >>> GaussianParams.from_points(cube, 9).activated().scales[0]
            tensor([1., 1., 1.])
        """
        check_shapes(("points", points, "P 3"))
        check_range("channels", channels, 1)
        check_range("initial_opacity", initial_opacity, 0, 1, closed=(False, False))
        if not outlier_range > 0:
            raise ValueError(f"outlier_range: expected a positive number (or infinity), got {outlier_range!r}")
        if not points.is_floating_point() or not bool(torch.isfinite(points).all()):
            raise ValueError("points: expected finite floating-point numbers, got others; drop those rows first")
        points = points.detach()
        points = points[_inliers(points, outlier_range)]
        if max_points is not None and len(points) > max_points:
            check_range("max_points", max_points, 2)
            generator = generator or torch.Generator().manual_seed(0)
            chosen = torch.randperm(len(points), generator=generator)[:max_points].sort().values
            points = points[chosen.to(points.device)]
        n = len(points)
        return cls(
            means=points.clone(),
            quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            log_scales=point_spacing(points).log()[:, None].repeat(1, 3),
            logit_opacities=points.new_full((n,), math.log(initial_opacity / (1 - initial_opacity))),
            features=points.new_zeros(n, channels),
        )


def _inliers(points: Tensor, outlier_range: float) -> Tensor:  # [P, 3] -> [P] bool
    """Mask of the points within `outlier_range` times the 0.95 quantile of the distances from the median."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool, device=points.device)
    distance = (points - points.median(dim=0).values).norm(dim=1)
    radius = float(np.quantile(distance.cpu().double().numpy(), 0.95))  # torch.quantile stops at 16M elements
    return distance <= outlier_range * radius if radius > 0 else torch.ones_like(distance, dtype=torch.bool)


def point_spacing(points: Tensor) -> Tensor:  # [P, 3] -> [P] world units
    """Root mean square distance to the three nearest other places (fewer if there are fewer), held within bounds.

    Equal points count as one place and share its spacing.

    Raises:
        ValueError: if there are not at least two different points.
    """
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
