"""How large a scene is: the box of its points without far outliers, and the reach of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_range, check_shapes
from .camera import Camera


class Bounds(NamedTuple):
    """The box of most points of a cloud, in world units."""

    low: Tensor  # [3] lower corner
    high: Tensor  # [3] upper corner
    inside: Tensor  # [P] bool, which points lie in the box

    def __repr__(self) -> str:
        return short_repr(self)


def robust_bounds(points: Tensor, *, coverage: float = 0.98, margin: float = 0.1) -> Bounds:  # [P, 3]
    """The axis-aligned box of the central `coverage` of the points along each axis, widened by `margin` of its size.

    SfM clouds have points far behind every wall (in Replica's room_0, a room of about 8 m, one is 139 m away), so the
    minimum and maximum are useless. A ValueError if there are no points.
    """
    check_shapes(("points", points := as_tensor("points", points), "P 3"))
    check_range("coverage", coverage, 0, 1, closed=(False, True))
    check_range("margin", margin, 0)
    if len(points) == 0:
        raise ValueError("points: expected at least one point, got none; give the scene a point cloud first")
    ordered = points.detach().sort(0).values  # torch.quantile refuses more than 16 million values
    last = len(points) - 1
    left_out = int(last * (1 - coverage) / 2)
    low, high = ordered[left_out], ordered[last - left_out]
    pad = (high - low) * margin
    low, high = low - pad, high + pad
    inside = ((points.detach() >= low) & (points.detach() <= high)).all(-1)
    return Bounds(low, high, inside)


def camera_extent(cameras: Sequence[Camera], points: Tensor) -> float:  # [P, 3]
    """1.1 times the largest distance of a camera from the cameras' mean, in world units: the size of a scene in 3DGS.

    If all cameras stand in one place, it is the median distance to the points, or 1 without points.
    """
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one view, got none; the extent of an empty scene is unknown")
    centers = torch.stack([camera.center.detach().double().cpu() for camera in cameras])
    mean = centers.mean(0)
    radius = 1.1 * float((centers - mean).norm(dim=-1).max())
    if radius > 1e-6 * (1 + float(mean.norm())):
        return radius
    return float((points.detach().double().cpu() - mean).norm(dim=-1).median()) if len(points) else 1.0
