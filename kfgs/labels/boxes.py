"""Oriented boxes, for the size and place of a selection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes
from .._rows import check_finite


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box with any orientation, in world units: the points `center + sum_i t_i axes[i]` with |t_i| <= half[i].

    **Convention**: the axes are the *rows* of a rotation (right-handed); `half` are half the edges. In Open3D the box is
    `OrientedBoundingBox(box.center.numpy(), box.axes.numpy().T, 2 * box.half.numpy())`.
    """

    center: Tensor  # [3]
    axes: Tensor  # [3, 3] orthonormal rows
    half: Tensor  # [3] >= 0

    __repr__ = short_repr

    @classmethod
    def around(cls, points: Tensor) -> OrientedBox:  # points: [N, 3]
        """The smaller of two boxes around points: along their principal axes, and along the world's; longest edge first.

        Raises:
            ValueError: if there is no point, or one is not finite.
        """
        points = as_tensor("points", points).detach().cpu().double()
        check_shapes(("points", points, "N 3"))
        if len(points) == 0:
            raise ValueError("points: expected at least one, got none; select something first")
        check_finite("points", points)
        middle, world = points.mean(dim=0), torch.eye(3, dtype=torch.float64)
        principal = torch.linalg.svd((points - middle).T @ (points - middle))[2]
        boxes = [_along(axes, points, middle) for axes in (principal, world)]
        return min(boxes, key=lambda box: box.volume)

    @property
    def volume(self) -> float:
        """The volume in cubed world units; 0 for a flat box."""
        return float((2 * self.half).prod())

    @property
    def corners(self) -> Tensor:  # [8, 3]
        """The eight corners, sorted by their coordinates along the first, second and third axis."""
        signs = torch.cartesian_prod(*([torch.tensor([-1.0, 1.0])] * 3)).to(self.half)
        return self.center + (signs * self.half) @ self.axes

    def to_json(self) -> dict[str, Any]:
        """Plain lists: center, axes (rows) and half edges."""
        return {name: getattr(self, name).tolist() for name in ("center", "axes", "half")}


def _along(axes: Tensor, points: Tensor, middle: Tensor) -> OrientedBox:
    """The box with these axes around points."""
    low, high = ((points - middle) @ axes.T).aminmax(dim=0)
    longest = (high - low).argsort(descending=True, stable=True)
    first, second = axes[longest[0]], axes[longest[1]]
    axes = torch.stack([first, second, torch.linalg.cross(first, second)])  # right-handed
    low, high = ((points - middle) @ axes.T).aminmax(dim=0)
    return OrientedBox(middle + (low + high) / 2 @ axes, axes, (high - low) / 2)
