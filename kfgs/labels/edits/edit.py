"""The interface of edits, and the edits remove, extract, recolour and opacity."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import reduce
from operator import or_
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..._check import check_choice, check_range
from ...gaussians import Gaussians
from ..color import MODES, Mode, parse_color, recolor
from ..nearest import positions
from ..selection import Selection
from ..where import OfClass, OfIndex, Where, plain_fields, set_fields

HIDDEN = 1e-6  # an opacity that every renderer skips (alpha < 1/255) and every file can hold
Rules = str | Selection | Where | Sequence[str | Selection | Where]
"""Which Gaussians an edit changes: a class name, a selection or a rule; or several, for all that any of them selects."""


class Edit(ABC):
    """One edit: frozen plain data that can be compared, saved and replayed. `op` is its name in JSON."""

    op: ClassVar[str]

    @abstractmethod
    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The edited cloud; the old one stays.

        Raises:
            ValueError: if nothing is selected and `allow_empty` is false, or the cloud lacks what the edit needs.
        """

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `op`, and the fields."""
        return {"op": self.op} | plain_fields(self)


@dataclass(frozen=True)
class OnSelection(Edit):
    """An edit of the Gaussians that rules select."""

    where: Rules
    """Which Gaussians; becomes a tuple of rules (`Where`)."""
    _: KW_ONLY
    allow_empty: bool = False
    """False: it is an error if nothing is selected."""

    def __post_init__(self) -> None:
        where: Any = self.where
        rules = where if isinstance(where, list | tuple) else [where]
        if not rules:
            raise ValueError("where: expected at least one rule, got none; name a class, or give OfClass('chair')")
        set_fields(self, where=tuple(_rule(rule) for rule in rules))

    def selected(self, gaussians: Gaussians) -> Tensor:  # [N] bool
        """The mask of the selected Gaussians; a ValueError if there is none and `allow_empty` is false."""
        rules: tuple[Where, ...] = self.where  # type: ignore[assignment]  # since __post_init__
        mask = reduce(or_, (rule.select(gaussians).mask for rule in rules))
        if not self.allow_empty and not bool(mask.any()):
            raise ValueError(
                f"where: expected a selection of some of {len(gaussians)} Gaussians, got none from "
                f"{', '.join(map(repr, rules)):.120}; {_present(gaussians)} (allow_empty=True allows it)"
            )
        return mask


def _rule(where: Any) -> Where:
    if isinstance(where, str):
        return OfClass(where)
    if isinstance(where, Selection):
        return OfIndex(tuple(where.indices.tolist()))
    if isinstance(where, dict):
        return Where.from_json(where)
    if not isinstance(where, Where):
        raise TypeError(
            f"where: expected a class name, a Selection or a rule like OfClass('chair'), got {where!r:.80}; build one"
        )
    return where


@dataclass(frozen=True)
class Remove(OnSelection):
    """Remove Gaussians ("delete the chair").

    A transfer of labels leaves unlabelled Gaussians around an object, which would stay behind as a halo. `grow` also
    removes **unlabelled** Gaussians (label -1; all others if the cloud has no labels) that are closer than `grow` to a
    removed one, unless a labelled one that stays is closer still. Labelled neighbours are never removed.
    """

    op: ClassVar[str] = "remove"
    grow: float = 0.0
    """World units, >= 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("grow", self.grow, 0)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        mask, labels = self.selected(gaussians), gaussians.labels
        free = ~mask if labels is None else ~mask & (labels < 0)
        if self.grow and bool(mask.any()) and bool(free.any()):
            means = positions("gaussians.means", gaussians.means)
            gone, candidates, rivals = (means[rows.cpu().numpy()] for rows in (mask, free, ~(mask | free)))
            to_gone = np.asarray(cKDTree(gone).query(candidates, distance_upper_bound=self.grow)[0])  # infinite beyond
            near = to_gone < self.grow
            if len(rivals) and near.any():
                to_rival = np.asarray(cKDTree(rivals).query(candidates[near], distance_upper_bound=self.grow)[0])
                near[near] = to_gone[near] <= to_rival
            mask = mask.clone()
            mask[free] = torch.from_numpy(near).to(mask.device)
        return gaussians.select(~mask)


@dataclass(frozen=True)
class Extract(OnSelection):
    """Keep only some Gaussians."""

    op: ClassVar[str] = "extract"

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        return gaussians.select(self.selected(gaussians))


@dataclass(frozen=True)
class Recolor(OnSelection):
    """Give Gaussians one hue and keep their shading; see `kfgs.labels.recolor`."""

    op: ClassVar[str] = "recolor"
    rgb: tuple[float, float, float]
    """Red, green, blue in [0, 1], or text like `"#c04040"` or `"teal"`."""
    mode: Mode = "tint"
    """`"tint"`: the object's middle luminance becomes `rgb`. `"hue"`: luminance stays."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, rgb=parse_color(self.rgb))
        check_choice("mode", self.mode, MODES)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        return recolor(gaussians, self.selected(gaussians), self.rgb, self.mode)


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

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """See `Edit.apply`."""
        mask, old = self.selected(gaussians), gaussians.opacities
        changed = torch.maximum(old * self.factor, old.clamp(max=HIDDEN))
        return gaussians.replace(opacities=torch.where(mask, changed, old))


def class_name(names: Sequence[str], index: int) -> str:
    """The name of a class; one without a name is called `class 7`."""
    return names[index] if index < len(names) else f"class {index}"


def _present(gaussians: Gaussians) -> str:
    labels = gaussians.labels
    if labels is None:
        return "the cloud carries no labels: widen the box or sphere"
    sizes = Counter(class_name(gaussians.names, label) for label in labels[labels >= 0].tolist())
    named = ", ".join(f"{name} ({count})" for name, count in sizes.most_common(12))
    return f"classes present are {named or 'none'}{', ...' * (len(sizes) > 12)}: select one of them"
