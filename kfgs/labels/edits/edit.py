"""The interface of edits, and the edits remove, extract, recolour and opacity."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..._check import check_choice, check_range
from ..._rows import check_finite
from ...formats.splat_file import SplatFile
from .._json import members_of, number_of, set_fields
from ..color import MODES, Mode, parse_color, recolor
from ..selection import Selection
from ..where import OfClass, OfIndex, Where
from .merge import class_name

SHOWN = 12  # classes listed in a message
HIDDEN = 1e-6  # an opacity that every renderer skips (alpha < 1/255) and every file can hold


class Edit(ABC):
    """One edit: frozen plain data that can be compared, saved and replayed.

    `op` is its name in JSON. `apply` returns a new cloud and changes nothing in place.
    """

    op: ClassVar[str]

    @abstractmethod
    def apply(self, splats: SplatFile) -> SplatFile:
        """The edited cloud.

        Raises:
            ValueError: if nothing is selected and `allow_empty` is false, or the cloud lacks what the edit needs.
        """

    def to_json(self) -> dict[str, Any]:
        """Plain values that JSON can hold: `op`, and the fields."""
        return {"op": self.op} | members_of(self)


@dataclass(frozen=True)
class OnSelection(Edit):
    """An edit of the Gaussians that a `Where` selects."""

    where: Where
    """Which Gaussians; a class name becomes `OfClass(name)`, a `Selection` becomes the `OfIndex` of its Gaussians."""
    _: KW_ONLY
    allow_empty: bool = False
    """False: it is an error if nothing is selected."""

    def __post_init__(self) -> None:
        where: Any = self.where
        if isinstance(where, str):
            where = OfClass(where)
        elif isinstance(where, Selection):
            where = OfIndex(tuple(where.indices.tolist()))
        elif not isinstance(where, Where):
            raise TypeError(
                f"where: expected a Where like OfClass('chair'), a Selection or a class name, got {where!r:.80}; "
                "build one"
            )
        set_fields(self, where=where)
        if not isinstance(self.allow_empty, bool):
            raise TypeError(
                f"allow_empty: expected true or false, got {self.allow_empty!r:.80}; write it without quotes"
            )

    def selected(self, splats: SplatFile) -> Tensor:  # [N] bool
        """The mask of the selected Gaussians.

        Raises:
            ValueError: if nothing is selected and `allow_empty` is false; the message lists the classes present.
        """
        mask = self.where.mask(splats)
        if not self.allow_empty and not bool(mask.any()):
            raise ValueError(
                f"where: expected a selection of some of {len(splats)} Gaussians, got none from {self.where!r:.120}; "
                f"{_present(splats)} (in Python: or pass allow_empty=True)"
            )
        return mask


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
        set_fields(self, grow=number_of("grow", self.grow))
        check_range("grow", self.grow, 0)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = self.selected(splats)
        return splats.select(~(mask | _orphans_near(splats, mask, self.grow)))


@dataclass(frozen=True)
class Extract(OnSelection):
    """Keep only some Gaussians."""

    op: ClassVar[str] = "extract"

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        return splats.select(self.selected(splats))


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

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        return splats.replace(gaussians=recolor(splats.gaussians, self.selected(splats), self.rgb, self.mode))


@dataclass(frozen=True)
class Opacity(OnSelection):
    """Multiply opacities: 1 changes nothing, 0 hides.

    Hidden Gaussians stay in the cloud with opacity 1e-6 (or less, if they had less). No renderer draws them, indices stay,
    and file formats with logits can store them. `Remove` deletes them.
    """

    op: ClassVar[str] = "opacity"
    factor: float
    """In [0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, factor=number_of("factor", self.factor))
        check_range("factor", self.factor, 0, 1)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = self.selected(splats)
        opacities = splats.gaussians.opacities.clone()
        old = opacities[mask]
        opacities[mask] = torch.maximum(old * self.factor, old.clamp(max=HIDDEN))
        return splats.replace(gaussians=splats.gaussians.replace(opacities=opacities))


def _present(splats: SplatFile) -> str:
    labels = splats.gaussians.labels
    if labels is None:
        return "the cloud carries no labels: widen the box or sphere"
    found, counts = torch.unique(labels[labels >= 0], return_counts=True)
    sizes: Counter[str] = Counter()
    for label, count in zip(found.tolist(), counts.tolist(), strict=True):
        sizes[class_name(splats.classes, label)] += count
    named = [f"{name} ({count})" for name, count in sizes.most_common()]
    more = f" and {len(named) - SHOWN} more" if len(named) > SHOWN else ""
    return f"classes present are {', '.join(named[:SHOWN]) or 'none'}{more}: select one of them"


def _orphans_near(splats: SplatFile, mask: Tensor, distance: float) -> Tensor:  # [N] bool -> [N] bool
    """The unlabelled Gaussians closer than `distance` to the mask, and no farther from it than from other labels."""
    labels = splats.gaussians.labels
    free = ~mask if labels is None else ~mask & (labels < 0)
    if distance == 0 or not bool(mask.any()) or not bool(free.any()):
        return torch.zeros_like(mask)
    check_finite("gaussians.means", splats.gaussians.means)
    means = splats.gaussians.means.detach().double().cpu().numpy()
    taken, candidates, rivals = (means[rows.cpu().numpy()] for rows in (mask, free, ~(mask | free)))
    to_taken = np.asarray(cKDTree(taken).query(candidates, distance_upper_bound=distance)[0])  # infinite beyond
    near = to_taken < distance
    if len(rivals) and near.any():
        to_rival = np.asarray(cKDTree(rivals).query(candidates[near], distance_upper_bound=distance)[0])
        near[near] = to_taken[near] <= to_rival
    out = torch.zeros_like(mask)
    out[free] = torch.from_numpy(near).to(mask.device)
    return out
