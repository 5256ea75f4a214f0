"""What the fields of other programs have in common: values per Gaussian that are splatted, then decoded per pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kfgs._check import check_shapes
from kfgs._rows import EPS, row_norms, unit_embeddings, unit_rows
from kfgs.evaluation.method import View
from kfgs.fields.decoders import CHUNK
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize

CHANNELS = 128  # splatted at once where no decoder needs them together: 0.3 GB for a 986x728 picture

Decode = Callable[[Tensor], Tensor]
"""Splatted values [M, d] to features [M, D] of any length."""


@dataclass(frozen=True, eq=False)
class Level:
    """One map of a field: Gaussians whose `features` are splatted, and what decodes them."""

    gaussians: Gaussians
    """With `features` [N, d], ready to be splatted; an all-zero row has learnt nothing."""
    decode: Decode | None = None
    """None: the splatted values are the features."""
    dim: int = 0
    """D, the length of a feature; 0: that of the values."""

    @property
    def values(self) -> Tensor:  # [N, d]
        """What is splatted."""
        assert self.gaussians.features is not None
        return self.gaussians.features


class SplattedMethod:
    """A field of another program as a `Method`: its values are splatted by kfgs's own engine, its decoder is applied.

    A pixel is unknown where no Gaussian is seen, or what is seen has learnt nothing. The feature of a Gaussian is its own
    value, decoded; it is unknown where the value is all zeros.

    Args:
        name: for tables.
        levels: one, or three for LangSplat and those that follow it (s, m, l). Their Gaussians may differ: `gaussians` are
            then those of any level, each once.
    """

    def __init__(self, name: str, levels: Sequence[Level]) -> None:
        if not levels:
            raise ValueError("levels: expected at least one, got none")
        self.name, self.parts = name, tuple(levels)
        self.dim = self.parts[0].dim or int(self.parts[0].values.shape[1])
        self.gaussians, self._rows = _join([level.gaussians for level in self.parts])

    def __repr__(self) -> str:
        return (
            f"SplattedMethod({self.name!r}, {self.levels} levels, {len(self.gaussians)} Gaussians, {self.dim} channels)"
        )

    @property
    def levels(self) -> int:
        """How many maps it has of a view."""
        return len(self.parts)

    def cosines(self, view: View, text: Tensor) -> Tensor:  # [K, D] -> [levels, H, W, K]
        """The cosine of each pixel's feature with each text; NaN where nothing is known.

        Raises:
            ValueError: if the text has another number of channels than the features.
        """
        unit = self._text(text)
        with torch.no_grad():
            return torch.stack([_view_cosines(level, view, unit) for level in self.parts])

    def gaussian_cosines(self, text: Tensor) -> Tensor:  # [K, D] -> [levels, N, K]
        """The cosine of each Gaussian's decoded value with each text; NaN where it has none.

        Raises:
            ValueError: if the text has another number of channels than the features.
        """
        unit = self._text(text)
        found = torch.full((self.levels, len(self.gaussians), len(unit)), torch.nan)
        with torch.no_grad():
            for i, (level, rows) in enumerate(zip(self.parts, self._rows, strict=True)):
                found[i, rows] = _cosines(level, level.values, unit)
        return found

    def _text(self, text: Tensor) -> Tensor:
        check_shapes(("text", text, "K D"))
        if text.shape[1] != self.dim:
            raise ValueError(
                f"text: expected [K, {self.dim}] as the features of {self.name}, got {tuple(text.shape)}; embed the texts with "
                "the encoder that its teacher belongs to"
            )
        return unit_embeddings(text, "text").float()


def _view_cosines(level: Level, view: View, unit: Tensor) -> Tensor:  # [H, W, K]
    if level.decode is not None:
        rendering = rasterize(level.gaussians, view.camera)
        found = _cosines(level, rendering.map.flatten(0, 1), unit)
        return found.view(*view.camera.size, -1).masked_fill((rendering.alpha <= 0)[..., None], torch.nan)
    products = torch.zeros(*view.camera.size, len(unit))  # features in parts: products and squares add up
    squares = torch.zeros(view.camera.size)
    for columns in torch.arange(level.values.shape[1]).split(CHANNELS):
        some = slice(int(columns[0]), int(columns[-1]) + 1)
        part = rasterize(level.gaussians.replace(features=level.values[:, some].contiguous(), sh=None), view.camera).map
        products += part @ unit[:, some].T
        squares += part.square().sum(-1)
    lengths = squares.sqrt()[..., None]
    return (products / lengths.clamp_min(EPS)).masked_fill(lengths <= EPS, torch.nan)


def _cosines(level: Level, values: Tensor, unit: Tensor) -> Tensor:  # [M, d] -> [M, K]
    decode = level.decode if level.decode is not None else unit_rows
    parts = [unit_rows(decode(part)) @ unit.T for part in values.split(CHUNK)]
    found = torch.cat(parts) if parts else torch.zeros(0, len(unit))
    return found.masked_fill((row_norms(values) <= EPS)[:, None], torch.nan)


def _join(clouds: Sequence[Gaussians]) -> tuple[Gaussians, list[Tensor]]:
    """The Gaussians of several clouds without features, each once, and where each cloud's are among them."""
    bare = [cloud.replace(features=None, labels=None) for cloud in clouds]
    first = bare[0]
    same = all(len(cloud) == len(first) and torch.equal(cloud.means, first.means) for cloud in bare[1:])
    if same:
        return first, [torch.arange(len(first))] * len(bare)
    both = Gaussians.cat([cloud.replace(sh=None).with_origin(first.origin) for cloud in bare])
    geometry = torch.cat([both.means, both.quats, both.scales, both.opacities[:, None]], 1).numpy()
    _, index, inverse = np.unique(geometry, axis=0, return_index=True, return_inverse=True)
    order = np.sort(index)  # as they come, not by their coordinates
    place = torch.from_numpy(np.searchsorted(order, index)[inverse.reshape(-1)])
    sh = None if any(cloud.sh is None for cloud in bare) else torch.cat([c.sh for c in bare if c.sh is not None])
    joined = both.replace(sh=sh) if sh is not None else both
    return joined.select(torch.from_numpy(order)), list(place.split([len(cloud) for cloud in bare]))
