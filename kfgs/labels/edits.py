"""Edits of selected Gaussians, as data: remove, extract, recolour, opacity, and moves about a pivot."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any, ClassVar, get_args

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from .._check import check_choice, check_range
from .._origin import Origin, to_world
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .color import Mode, parse_color, recolor
from .selection import (
    KINDS,
    OfClass,
    OfIndex,
    Selection,
    Where,
    class_name,
    plain_fields,
    read_object,
    set_fields,
    three_numbers,
)

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
HIDDEN = 1e-6  # an opacity that every renderer skips (alpha < 1/255) and every file can hold
Rules = str | Selection | Where | Sequence[str | Selection | Where]
"""Which Gaussians an edit changes: a class name, a selection or a rule; or several, for all that any of them selects."""


class Edit(ABC):
    """One edit: frozen plain data that can be compared, saved and replayed. `op` is its name in JSON."""

    op: ClassVar[str]

    @abstractmethod
    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The edited cloud; the old one stays. A ValueError if nothing is selected, or the cloud lacks what the edit needs."""

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `op`, and the fields."""
        return {"op": self.op} | plain_fields(self)


@dataclass(frozen=True)
class OnSelection(Edit):
    """An edit of the Gaussians that rules select."""

    where: Rules
    """Which Gaussians; becomes a tuple of rules (`OfClass`, `InBox`, `InSphere`, `OfIndex`)."""

    def __post_init__(self) -> None:
        where: Any = self.where
        rules = where if isinstance(where, list | tuple) else [where]
        if not rules:
            raise ValueError("where: expected at least one rule, got none; name a class, or give OfClass('chair')")
        set_fields(self, where=tuple(_rule(rule) for rule in rules))

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        rules: tuple[Where, ...] = self.where  # type: ignore[assignment]  # since __post_init__
        mask = reduce(or_, (rule.select(gaussians).mask for rule in rules))
        if not bool(mask.any()):
            raise ValueError(
                f"where: expected a selection of some of {len(gaussians)} Gaussians, got none from "
                f"{', '.join(map(repr, rules)):.120}; {_present(gaussians)}"
            )
        return self._change(gaussians, mask)

    @abstractmethod
    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:  # mask: [N] bool, of some Gaussians
        """The edited cloud."""


def _rule(where: Any) -> Where:
    if isinstance(where, str):
        return OfClass(where)
    if isinstance(where, Selection):
        return OfIndex(tuple(where.indices.tolist()))
    if isinstance(where, dict):
        return read_object("where", where, KINDS, "kind")
    if not isinstance(where, Where):
        raise TypeError(
            f"where: expected a class name, a Selection or a rule like OfClass('chair'), got {where!r:.80}; build one"
        )
    return where


def _present(gaussians: Gaussians) -> str:
    labels = gaussians.labels
    if labels is None:
        return "the cloud carries no labels: widen the box or sphere"
    sizes = Counter(class_name(gaussians.names, label) for label in labels[labels >= 0].tolist())
    named = ", ".join(f"{name} ({count})" for name, count in sizes.most_common(12))
    return f"classes present are {named or 'none'}{', ...' * (len(sizes) > 12)}: select one of them"


@dataclass(frozen=True)
class Remove(OnSelection):
    """Remove Gaussians ("delete the chair")."""

    op: ClassVar[str] = "remove"

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return gaussians.select(~mask)


@dataclass(frozen=True)
class Extract(OnSelection):
    """Keep only some Gaussians."""

    op: ClassVar[str] = "extract"

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return gaussians.select(mask)


@dataclass(frozen=True)
class Recolor(OnSelection):
    """Give Gaussians one hue and keep their shading, from every direction."""

    op: ClassVar[str] = "recolor"
    rgb: tuple[float, float, float]
    """Red, green, blue in [0, 1], or text like `"#c04040"` or `"teal"`."""
    mode: Mode = "tint"
    """`"tint"`: the object's middle luminance becomes `rgb`. `"hue"`: luminance stays."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, rgb=parse_color(self.rgb))
        check_choice("mode", self.mode, get_args(Mode))

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return recolor(gaussians, mask, self.rgb, self.mode)


@dataclass(frozen=True)
class Opacity(OnSelection):
    """Multiply opacities: 1 changes nothing, 0 hides.

    Hidden Gaussians stay in the cloud with opacity 1e-6 (or less, if they had less): no renderer draws them.
    """

    op: ClassVar[str] = "opacity"
    factor: float
    """In [0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("factor", self.factor, 0, 1)

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        old = gaussians.opacities
        changed = torch.maximum(old * self.factor, old.clamp(max=HIDDEN))
        return gaussians.replace(opacities=torch.where(mask, changed, old))


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

    def moved(self, part: Gaussians) -> Gaussians:
        """The selected Gaussians in their new place."""
        R = torch.eye(3, dtype=torch.float64)
        if self.rotation is not None:
            axis, degrees = self.rotation
            direction = torch.tensor(AXES[axis] if isinstance(axis, str) else axis, dtype=torch.float64)
            direction = direction / direction.abs().max()  # no overflow
            vector = math.fmod(degrees, 360) * direction / direction.norm()
            R = torch.from_numpy(Rotation.from_rotvec(vector.numpy(), degrees=True).as_matrix())
        pivot = torch.tensor(self.pivot if isinstance(self.pivot, tuple) else (0.0, 0.0, 0.0), dtype=torch.float64)
        if self.pivot == "centroid":
            weights = part.opacities.detach().double().cpu()
            weights = weights if bool(weights.any()) else torch.ones_like(weights)
            pivot = to_world(weights @ part.means.detach().double().cpu() / weights.sum(), part.origin)
        shift = torch.tensor(self.translation, dtype=torch.float64)
        return transformed(part, Similarity(self.scale, R, pivot + shift - self.scale * (R @ pivot)), part.origin)


@dataclass(frozen=True)
class Move(_Motion):
    """Move, turn and resize Gaussians, with their scales and the directions of their colours."""

    op: ClassVar[str] = "move"

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
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

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return Gaussians.cat([gaussians, self.moved(gaussians.select(mask))])


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
