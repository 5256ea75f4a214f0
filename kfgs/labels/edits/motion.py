"""Edits that move, rotate and resize Gaussians about a pivot, or a copy of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..._check import check_range
from ..._origin import Origin, to_world
from ...cameras.similarity import Similarity
from ...gaussians import Gaussians
from ...splat.transform import transform_gaussians
from ..where import set_fields, three_numbers
from .edit import OnSelection

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class _Motion(OnSelection):
    """Base of `Move` and `Duplicate`: x' = scale R (x - pivot) + pivot + translation."""

    translation: tuple[float, ...] = (0.0, 0.0, 0.0)
    """World units."""
    rotation: tuple[str | tuple[float, ...], float] | None = None
    """An axis ("x", "y", "z" or a direction) and degrees by the right hand, like `("z", 90)`."""
    scale: float = 1.0
    """> 0"""
    pivot: str | tuple[float, ...] = "centroid"
    """The fixed point of rotation and scale: (x, y, z), or `"centroid"` (the mean of the selected positions, weighted by
    opacity; the plain mean if every opacity is 0)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, translation=three_numbers("translation", self.translation), rotation=_rotation(self.rotation))
        check_range("scale", self.scale, 0, closed=(False, False))
        if self.pivot != "centroid":
            set_fields(self, pivot=three_numbers("pivot", self.pivot))

    def similarity(self, gaussians: Gaussians) -> Similarity:
        """The motion of the selected Gaussians in world axes."""
        R = _matrix(self.rotation)
        if self.pivot == "centroid":
            weights = gaussians.opacities.detach().double().cpu()
            weights = weights if bool(weights.any()) else torch.ones_like(weights)
            middle = weights @ gaussians.means.detach().double().cpu() / weights.sum()
            pivot = to_world(middle, gaussians.origin)
        else:
            pivot = torch.tensor(self.pivot, dtype=torch.float64)
        shift = torch.tensor(self.translation, dtype=torch.float64)
        return Similarity(self.scale, R, pivot + shift - self.scale * (R @ pivot))

    def moved(self, part: Gaussians) -> Gaussians:
        """The selected Gaussians in their new place."""
        return transformed(part, self.similarity(part), part.origin)


@dataclass(frozen=True)
class Move(_Motion):
    """Move, turn and resize Gaussians, with their scales and the directions of their colours."""

    op: ClassVar[str] = "move"

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        mask = self.selected(gaussians)
        if not bool(mask.any()):
            return gaussians
        moved = self.moved(gaussians.select(mask))
        rows = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "sh")}
        changed = {name: values.clone() for name, values in rows.items() if values is not None}
        for name, values in changed.items():
            values[mask] = getattr(moved, name)
        return gaussians.replace(**changed)


@dataclass(frozen=True)
class Duplicate(_Motion):
    """Add a copy of Gaussians, moved like `Move`, with labels and other columns. Copies come after the originals."""

    op: ClassVar[str] = "duplicate"

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        mask = self.selected(gaussians)
        return Gaussians.cat([gaussians, self.moved(gaussians.select(mask))]) if bool(mask.any()) else gaussians


def transformed(gaussians: Gaussians, similarity: Similarity, origin: Origin) -> Gaussians:
    """`transform_gaussians`, counted from an origin; a ValueError if a number leaves the range in which its type is of use.

    Fourth powers (determinants of 2-D covariances) stay finite, scales stay above 0, and positions are not rounded by more than
    a tenth of the size of what moves, unless they were before.
    """
    moved = transform_gaussians(gaussians, similarity).with_origin(origin)
    if len(moved) == 0:
        return moved
    limits = torch.finfo(moved.means.dtype)
    largest = torch.maximum(moved.means.abs().max(), moved.scales.max())
    size = torch.maximum(gaussians.means.amax(0) - gaussians.means.amin(0), gaussians.scales.amax(0)).max()
    rounding = limits.eps * moved.means.abs().max()
    allowed = torch.maximum(0.1 * similarity.scale * size, 2 * limits.eps * gaussians.means.abs().max())
    if not (largest <= limits.max**0.25 and bool((moved.scales > 0).all()) and rounding <= allowed):
        raise ValueError(
            f"expected positions and scales that {moved.means.dtype} can tell apart, got some beyond after scale "
            f"{similarity.scale:g} and translation {[float(f'{part:.3g}') for part in similarity.translation.tolist()]}; move "
            "less far, or scale less"
        )
    return moved


def _rotation(value: Any) -> tuple[Any, float] | None:
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"rotation: expected an axis and degrees, got {value!r:.80}; write it as ('z', 90)")
    axis, degrees = value
    if not (isinstance(axis, str) and axis in AXES):
        axis = three_numbers("rotation axis", axis)
        if not any(axis):
            raise ValueError("rotation: expected an axis, got (0, 0, 0); name 'x', 'y', 'z' or a direction")
    check_range("rotation degrees", degrees, -math.inf, closed=(False, False))
    return axis, float(degrees)


def _matrix(rotation: tuple[Any, float] | None) -> Tensor:  # [3, 3] float64
    if rotation is None:
        return torch.eye(3, dtype=torch.float64)
    axis = torch.tensor(AXES.get(rotation[0], rotation[0]), dtype=torch.float64)
    axis = axis / axis.abs().max()  # no overflow
    vector = math.fmod(rotation[1], 360) * axis / axis.norm()
    return torch.from_numpy(Rotation.from_rotvec(vector.numpy(), degrees=True).as_matrix())
