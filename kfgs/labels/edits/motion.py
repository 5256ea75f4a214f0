"""Edits that move, rotate and resize Gaussians about a pivot, or a copy of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..._check import check_range
from ..._origin import Origin, to_world
from ...cameras.similarity import Similarity
from ...formats.splat_file import SplatFile
from ...gaussians import TENSORS, Gaussians
from ...splat.transform import transform_gaussians
from .._json import number_of, numbers_of, set_fields
from ..boxes import quaternion_of, rotation_matrix, unit
from .edit import OnSelection
from .merge import join

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Turn:
    """A right-handed rotation by an angle about an axis: 90 degrees about z take x to y."""

    axis: tuple[float, ...]
    """A direction (x, y, z) of any length, or `"x"`, `"y"`, `"z"`."""
    degrees: float

    def __post_init__(self) -> None:
        axis: Any = AXES.get(self.axis, self.axis) if isinstance(self.axis, str) else self.axis
        set_fields(self, axis=numbers_of("axis", axis, 3), degrees=number_of("degrees", self.degrees))
        if not any(self.axis):
            raise ValueError("axis: expected a direction, got (0, 0, 0); name 'x', 'y', 'z' or a vector")

    def matrix(self) -> Any:  # [3, 3]
        """The rotation matrix."""
        turns = math.fmod(self.degrees, 360)
        return Rotation.from_rotvec([turns * part for part in unit(self.axis)], degrees=True).as_matrix()

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold."""
        return {"axis": list(self.axis), "degrees": self.degrees}


@dataclass(frozen=True)
class _Motion(OnSelection):
    """Base of `Move` and `Duplicate`: x' = scale R (x - pivot) + pivot + translation."""

    translation: tuple[float, ...] = (0.0, 0.0, 0.0)
    """World units."""
    rotation: Turn | tuple[float, ...] | None = None
    """A `Turn`, a pair (axis, degrees) like `("z", 90)`, or a quaternion (w, x, y, z)."""
    scale: float = 1.0
    """> 0"""
    pivot: str | tuple[float, ...] = "centroid"
    """The fixed point of rotation and scale: (x, y, z), or `"centroid"` (the mean of the selected positions, weighted by
    opacity; the plain mean if every opacity is 0)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, translation=numbers_of("translation", self.translation, 3), rotation=_rotation(self.rotation))
        set_fields(self, scale=number_of("scale", self.scale))
        check_range("scale", self.scale, 0, closed=(False, False))
        if isinstance(self.pivot, str):
            if self.pivot != "centroid":
                raise ValueError(f"pivot: expected 'centroid' or [x, y, z], got {self.pivot!r:.80}; give the point")
        else:
            set_fields(self, pivot=numbers_of("pivot", self.pivot, 3))

    def similarity(self, gaussians: Gaussians) -> Similarity:
        """The motion of the selected Gaussians in world axes."""
        R = _matrix(self.rotation)
        if isinstance(self.pivot, str):
            weights = gaussians.opacities.detach().double().cpu()
            weights = weights / weights.max() if bool(weights.any()) else torch.ones_like(weights)
            middle = weights @ gaussians.means.detach().double().cpu() / weights.sum()
            pivot = to_world(middle, gaussians.origin)
        else:
            pivot = torch.tensor(self.pivot, dtype=torch.float64)
        shift = torch.tensor(self.translation, dtype=torch.float64)
        return Similarity(self.scale, R, pivot + shift - self.scale * (R @ pivot))


@dataclass(frozen=True)
class Move(_Motion):
    """Move, turn and resize Gaussians, with their scales and the directions of their colours."""

    op: ClassVar[str] = "move"

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = self.selected(splats)
        if not bool(mask.any()):
            return splats
        part = splats.gaussians.select(mask)
        moved = transformed(part, self.similarity(part), part.origin)
        rows = {name: getattr(splats.gaussians, name) for name in TENSORS}
        rows = {name: values.clone() for name, values in rows.items() if values is not None}
        for name, values in rows.items():
            values[mask] = getattr(moved, name)
        return splats.replace(gaussians=splats.gaussians.replace(**rows))


@dataclass(frozen=True)
class Duplicate(_Motion):
    """Add a copy of Gaussians, moved like `Move`, with labels and other columns. Copies come after the originals."""

    op: ClassVar[str] = "duplicate"

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = self.selected(splats)
        if not bool(mask.any()):
            return splats
        copy = splats.select(mask)
        moved = transformed(copy.gaussians, self.similarity(copy.gaussians), copy.gaussians.origin)
        return join(splats, copy.replace(gaussians=moved))


def transformed(gaussians: Gaussians, similarity: Similarity, origin: Origin) -> Gaussians:
    """`transform_gaussians`, counted from an origin; a ValueError if a number leaves the range in which its type is of use.

    Fourth powers (determinants of 2-D covariances) stay finite, scales stay above 0, and positions are not rounded by more than
    a tenth of the size of what moves, unless they were before.
    """
    moved = transform_gaussians(gaussians, similarity).with_origin(origin)
    limits = torch.finfo(moved.means.dtype)
    sound = [
        (one.means.abs() <= limits.max**0.25) & (one.scales > 0) & (one.scales <= limits.max**0.25)
        for one in (gaussians, moved)
    ]
    good, rows = bool((sound[1] | ~sound[0]).all()), sound[0].all(dim=1)
    if good and bool(rows.any()):
        before, after = gaussians.means[rows].double(), moved.means[rows].double()
        size = torch.maximum(before.amax(0) - before.amin(0), gaussians.scales[rows].amax(0)).max() * similarity.scale
        good = bool(after.abs().max() * limits.eps <= max(0.1 * size, 2 * before.abs().max() * limits.eps))
    if not good:
        raise ValueError(
            f"expected positions and scales that {moved.means.dtype} can tell apart, got some beyond after scale "
            f"{similarity.scale:g} and translation {[float(f'{part:.3g}') for part in similarity.translation.tolist()]}; move "
            "less far, or scale less"
        )
    return moved


def _rotation(value: Any) -> Turn | tuple[float, ...] | None:
    if value is None or isinstance(value, Turn):
        return value
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        return Turn(value[0], value[1])
    return quaternion_of("rotation", value)


def _matrix(rotation: Turn | tuple[float, ...] | None) -> Tensor:  # [3, 3] float64
    if rotation is None:
        return torch.eye(3, dtype=torch.float64)
    matrix = rotation.matrix() if isinstance(rotation, Turn) else rotation_matrix(rotation)
    return torch.tensor(matrix.tolist(), dtype=torch.float64)
