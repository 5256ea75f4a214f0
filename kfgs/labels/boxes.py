"""Oriented boxes, for the size and place of a selection, and rotations by quaternions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes
from .._rows import check_finite

ROUNDS = 3  # over the three axes; the boxes of room_0's objects stop changing after two

Array = np.ndarray[Any, Any]


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

    def __post_init__(self) -> None:
        check_shapes(("center", self.center, "3"), ("axes", self.axes, "3 3"), ("half", self.half, "3"))
        for name, value in (("center", self.center), ("axes", self.axes), ("half", self.half)):
            check_finite(name, value)
        if bool((self.half < 0).any()):
            raise ValueError(f"half: expected half edges >= 0, got {self.half.tolist()}; swap minimum and maximum")
        axes = self.axes.double()
        if float((axes @ axes.T - torch.eye(3).to(axes)).abs().max()) > 1e-3 or float(torch.linalg.det(axes)) < 0:
            raise ValueError(f"axes: expected a rotation, got {self.axes.tolist()}; normalise it, right-handed")

    @classmethod
    def between(cls, low: Sequence[float] | Tensor, high: Sequence[float] | Tensor) -> OrientedBox:
        """The axis-aligned box between two corners.

        Raises:
            ValueError: if a corner is not three finite numbers, or `low` is above `high`.
        """
        ends = [torch.as_tensor(end, dtype=torch.float64).cpu() for end in (low, high)]
        check_shapes(("low", ends[0], "3"), ("high", ends[1], "3"))
        return cls((ends[0] + ends[1]) / 2, torch.eye(3, dtype=torch.float64), (ends[1] - ends[0]) / 2)

    @classmethod
    def around(cls, points: Tensor) -> OrientedBox:  # points: [N, 3]
        """A small box around points: the smaller of two searches, from the principal axes and from the world's axes.

        A search rotates the box about each axis in turn, to the smallest rectangle around the points seen along that axis
        (one of its sides lies on an edge of their hull). The volume never grows, but it is not always the smallest
        possible. The longest edge comes first. `contains` is true for all the points.

        Raises:
            ValueError: if there is no point, or one is not finite.
        """
        points = as_tensor("points", points)
        check_shapes(("points", points, "N 3"))
        if len(points) == 0:
            raise ValueError("points: expected at least one, got none; select something first")
        check_finite("points", points)
        cloud: Array = points.detach().cpu().double().numpy()
        middle = cloud.mean(axis=0)
        shell = _shell(cloud - middle)
        principal = np.linalg.svd(shell - shell.mean(axis=0), full_matrices=True)[2] if len(shell) > 1 else np.eye(3)
        axes = min((_turned(shell, start) for start in (principal, np.eye(3))), key=lambda one: _volume(shell, one))
        axes = axes[np.argsort(-np.ptp(shell @ axes.T, axis=0), kind="stable")]
        axes[2] *= np.sign(np.linalg.det(axes))
        local = shell @ axes.T
        center = middle + (local.min(axis=0) + local.max(axis=0)) / 2 @ axes
        place, rows = torch.from_numpy(center), torch.from_numpy(axes)
        half = (
            _local(points.detach().cpu().double(), place, rows).abs().amax(dim=0)
        )  # exactly as `contains` computes it
        return cls(place, rows, half)

    @property
    def volume(self) -> float:
        """The volume in cubed world units; 0 for a flat box."""
        return float((2 * self.half).prod())

    @property
    def corners(self) -> Tensor:  # [8, 3]
        """The eight corners, sorted by their coordinates along the first, second and third axis."""
        signs = torch.cartesian_prod(*([torch.tensor([-1.0, 1.0])] * 3)).to(self.half)
        return self.center + (signs * self.half) @ self.axes

    def contains(self, points: Tensor) -> Tensor:  # [N, 3] -> [N] bool
        """Which points lie inside or on the faces, in float64."""
        points = as_tensor("points", points)
        check_shapes(("points", points, "N 3"))
        center, axes, half = (part.to(points.device, torch.float64) for part in (self.center, self.axes, self.half))
        return (_local(points.double(), center, axes).abs() <= half).all(dim=1)

    def to_json(self) -> dict[str, Any]:
        """Plain lists: center, axes (rows) and half edges."""
        return {name: getattr(self, name).tolist() for name in ("center", "axes", "half")}


def _local(points: Tensor, center: Tensor, axes: Tensor) -> Tensor:  # [N, 3], [3], [3, 3] -> [N, 3]
    """Coordinates along the axes, from the centre. No matrix product: its rounding depends on the count and the device."""
    x, y, z = (points - center).unbind(dim=1)
    return torch.stack([x * axis[0] + y * axis[1] + z * axis[2] for axis in axes], dim=1)


def _shell(cloud: Array) -> Array:
    """The corners of the convex hull; the points themselves if they have no volume."""
    try:
        shell: Array = cloud[ConvexHull(cloud).vertices]
        return shell
    except (QhullError, ValueError):  # fewer than four points, or flat
        return np.unique(cloud, axis=0)


def _turned(shell: Array, axes: Array) -> Array:
    """Rotate a frame about each of its axes in turn, to the rectangle of least area seen along it."""
    for turn in range(3 * ROUNDS):
        a, b = (turn + 1) % 3, (turn + 2) % 3
        angle = _least_rectangle(shell @ axes[[a, b]].T)
        c, s = np.cos(angle), np.sin(angle)
        axes = axes.copy()
        axes[a], axes[b] = c * axes[a] + s * axes[b], c * axes[b] - s * axes[a]
    return axes


def _least_rectangle(flat: Array) -> float:  # flat: [n, 2]
    """The angle of the smallest rectangle around points of a plane; one of its sides lies on an edge of their hull."""
    try:
        corners = flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # on a line, or too few
        return 0.0
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.mod(np.arctan2(edges[:, 1], edges[:, 0]), np.pi / 2)
    angles = np.concatenate([[0.0], angles])  # 0 keeps the frame if no other area is smaller
    along = np.stack([np.cos(angles), np.sin(angles)])  # [2, E]
    across = np.stack([-np.sin(angles), np.cos(angles)])
    areas = np.ptp(corners @ along, axis=0) * np.ptp(corners @ across, axis=0)
    return float(angles[np.argmin(areas)])


def _volume(shell: Array, axes: Array) -> float:
    return float(np.prod(np.ptp(shell @ axes.T, axis=0)))
