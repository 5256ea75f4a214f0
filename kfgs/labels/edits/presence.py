"""Edits of what is there: take Gaussians away, or keep only them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..._check import check_range
from ..._rows import check_finite
from ...formats.splat_file import SplatFile
from .._json import number_of
from ..where import Where
from .base import Edit, as_where, selected


@dataclass(frozen=True)
class Remove(Edit):
    """Take Gaussians away ("delete the chair").

    `grow` also takes the **unlabelled** Gaussians (label -1; all others where the cloud has no labels) whose centres are
    closer than so many world units to a removed one, and no farther from it than from any labelled one that stays: the
    transfer of labels leaves such orphans around an object, and they would stay behind as a halo. Labelled neighbours
    are never taken.
    """

    op: ClassVar[str] = "remove"
    where: Where
    grow: float = 0.0
    """World units, >= 0."""
    allow_empty: bool = False
    """False: an empty selection is an error."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "where", as_where(self.where))
        object.__setattr__(self, "grow", number_of("grow", self.grow))
        check_range("grow", self.grow, 0)
        check_flag("allow_empty", self.allow_empty)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = selected(self.where, splats, self.allow_empty)
        return splats.select(~(mask | _orphans_near(splats, mask, self.grow)))


@dataclass(frozen=True)
class Extract(Edit):
    """Keep only some Gaussians."""

    op: ClassVar[str] = "extract"
    where: Where
    allow_empty: bool = False
    """False: an empty selection is an error."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "where", as_where(self.where))
        check_flag("allow_empty", self.allow_empty)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        return splats.select(selected(self.where, splats, self.allow_empty))


def check_flag(name: str, value: object) -> None:
    """Raise a TypeError unless `value` is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name}: expected true or false, got {value!r:.80}; write it without quotes")


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
