"""Edits of selected Gaussians, as data: remove, extract, recolour, opacity, and moves about a pivot."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from .._card import cut
from .._check import check_range
from .._origin import Origin, to_world
from ..cameras.similarity import Similarity
from ..gaussians import Gaussians
from ..splat.transform import transform_gaussians
from .color import parse_color, recolor
from .fill import fill_holes
from .selection import Rule, Selection, as_rule, as_selection, class_names, plain_fields, set_fields, three_numbers
from .transfer import INSTANCE, as_cloud

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
HIDDEN = 1e-6  # an opacity that every renderer skips (alpha < 1/255) and every file can hold


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

    where: str | Selection | Rule | Sequence[str | Selection | Rule]
    """A class name, a selection or a rule (`OfClass`, `InBox`, `OfIndex`); or several: what any of them selects."""

    def __post_init__(self) -> None:
        where: Any = self.where
        rules = where if isinstance(where, list | tuple) else [where]
        if not rules:
            raise ValueError("where: expected at least one rule, got none; name a class, or give OfClass('chair')")
        set_fields(self, where=tuple(as_rule(rule, "where") for rule in rules))

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        gaussians = as_cloud(gaussians)
        mask = as_selection(self.where, gaussians).mask
        if not bool(mask.any()):
            got = f"none from {', '.join(map(repr, self.where)):.120}; {_present(gaussians)}"  # type: ignore[arg-type]
            raise ValueError(f"where: expected a selection of some of {len(gaussians)} Gaussians, got {got}")
        return self._change(gaussians, mask)

    @abstractmethod
    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:  # mask: [N] bool, of some Gaussians
        """The edited cloud."""


def _present(gaussians: Gaussians) -> str:
    names, labels = class_names(gaussians), [] if gaussians.labels is None else gaussians.labels.tolist()
    sizes = Counter(names[label] for label in labels if label >= 0)
    return f"classes present are {cut(', '.join(f'{name} ({n})' for name, n in sizes.most_common()) or 'none', 200)}"


@dataclass(frozen=True)
class Remove(OnSelection):
    """Remove Gaussians ("delete the chair")."""

    op: ClassVar[str] = "remove"
    fill: bool = False
    """Whether to continue the flat surfaces around it through the hole, as new Gaussians (`labels/fill.py`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.fill, bool):
            raise TypeError(f"fill: expected True or False, got {self.fill!r:.80}; leave it out to fill nothing")

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return fill_holes(gaussians, mask) if self.fill else gaussians.select(~mask)


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
    rgb: str | tuple[float, ...]
    """Red, green, blue in [0, 1], or text like `"#c04040"` or `"teal"`: the new colour of the object's middle luminance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, rgb=parse_color(self.rgb))

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return recolor(gaussians, mask, parse_color(self.rgb))


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
    rotation: tuple[Any, float] | None = None
    """An axis ("x", "y", "z" or a direction) and degrees by the right hand, like `("z", 90)`."""
    scale: float = 1.0
    """> 0"""
    pivot: str | tuple[float, ...] = "centroid"
    """The fixed point of rotation and scale: (x, y, z), or the mean of the selected positions, weighted by opacity."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, translation=three_numbers("translation", self.translation))
        if self.rotation is not None:
            if not isinstance(self.rotation, list | tuple) or len(self.rotation) != 2:
                raise ValueError(f"rotation: expected an axis and degrees like ('z', 90), got {self.rotation!r:.80}")
            axis, degrees = self.rotation
            axis = three_numbers("rotation axis", AXES.get(axis, axis) if isinstance(axis, str) else axis)
            check_range("rotation degrees", degrees, -math.inf, closed=(False, False))
            if not any(axis):
                raise ValueError("rotation: expected an axis, got (0, 0, 0); name 'x', 'y', 'z' or a direction")
            set_fields(self, rotation=(axis, float(degrees)))
        check_range("scale", self.scale, 0, closed=(False, False))
        if self.pivot != "centroid":
            set_fields(self, pivot=three_numbers("pivot", self.pivot))

    def moved(self, part: Gaussians) -> Gaussians:
        """The selected Gaussians in their new place."""
        R = torch.eye(3, dtype=torch.float64)
        if self.rotation is not None:
            axis = torch.tensor(self.rotation[0], dtype=torch.float64)
            axis = axis / axis.abs().max()  # no overflow
            vector = math.radians(math.fmod(self.rotation[1], 360)) * axis / axis.norm()
            R = axis_angle_to_rotation_matrix(vector[None])[0]
        if isinstance(self.pivot, tuple):
            pivot = torch.tensor(self.pivot, dtype=torch.float64)
        else:
            weights = part.opacities.detach().double().cpu().clamp_min(1e-30)  # all may be 0
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
    """Add a copy of Gaussians, moved like `Move`, with labels and other columns, as new things, after the originals."""

    op: ClassVar[str] = "duplicate"

    def _change(self, gaussians: Gaussians, mask: Tensor) -> Gaussians:
        return Gaussians.cat([gaussians, numbered_after(gaussians, self.moved(gaussians.select(mask)))])


def numbered_after(first: Gaussians, second: Gaussians) -> Gaussians:
    """The second cloud with new numbers for its things, as the first has some; if it has none, each class is one thing."""
    extra = {**second.extra}
    numbers = np.asarray(extra.pop(INSTANCE, np.ones(len(second), np.float32)))
    if INSTANCE in first.extra:
        extra[INSTANCE] = numbers + (numbers > 0) * np.max(first.extra[INSTANCE], initial=0)
    return second.replace(extra=extra)


def transformed(gaussians: Gaussians, similarity: Similarity, origin: Origin) -> Gaussians:
    """`transform_gaussians`, counted from an origin; a ValueError if the dtype cannot hold the result.

    Fourth powers (determinants of 2-D covariances) must be finite and scales above 0. The rounding of positions must be less
    than a tenth of the size of what moves, or no worse than before.
    """
    moved = transform_gaussians(gaussians, similarity).with_origin(origin)
    if len(moved) == 0:
        return moved
    limits, reach, scales = torch.finfo(moved.means.dtype), moved.means.abs().max(), moved.scales
    size = torch.maximum(gaussians.means.amax(0) - gaussians.means.amin(0), gaussians.scales.amax(0)).max()
    allowed = torch.maximum(0.1 * similarity.scale * size, 2 * limits.eps * gaussians.means.abs().max())
    fits = torch.maximum(reach, scales.max()) <= limits.max**0.25 and bool((scales > 0).all())
    if not (fits and limits.eps * reach <= allowed):
        shift = [float(f"{part:.3g}") for part in similarity.translation.tolist()]
        got = f"some beyond after scale {similarity.scale:g} and translation {shift}; move less far, or scale less"
        raise ValueError(f"expected positions and scales that {moved.means.dtype} can tell apart, got {got}")
    return moved
