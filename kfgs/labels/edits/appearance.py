"""Edits of how it looks: colour and opacity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from ..._check import check_choice, check_range
from ...formats.splat_file import SplatFile
from .._json import number_of
from ..color import parse_color
from ..edit import Mode, recolor
from ..where import Where
from .base import Edit, as_where, selected
from .presence import check_flag

HIDDEN = 1e-6  # an opacity that every renderer skips (alpha < 1/255) and every file can hold


@dataclass(frozen=True)
class Recolor(Edit):
    """Give Gaussians one hue and keep their shading; see `kfgs.labels.recolor`."""

    op: ClassVar[str] = "recolor"
    where: Where
    rgb: tuple[float, float, float]
    """Red, green, blue in [0, 1]; text such as `"#c04040"` or `"teal"` will do."""
    mode: Mode = "tint"
    """`"tint"`: the object's middle luminance becomes `rgb`. `"hue"`: every luminance stays that the display can show."""
    allow_empty: bool = False
    """False: an empty selection is an error."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "where", as_where(self.where))
        object.__setattr__(self, "rgb", parse_color(self.rgb))
        check_choice("mode", self.mode, ("tint", "hue"))
        check_flag("allow_empty", self.allow_empty)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = selected(self.where, splats, self.allow_empty)
        return splats.replace(gaussians=recolor(splats.gaussians, mask, self.rgb, self.mode))


@dataclass(frozen=True)
class Opacity(Edit):
    """Multiply opacities: 1 changes nothing, 0 hides.

    Hidden Gaussians stay in the cloud, with opacity 1e-6 (or what they had, if that was less): no renderer draws them, no
    index shifts, and files that hold logits can hold them. `Remove` takes them out.
    """

    op: ClassVar[str] = "opacity"
    where: Where
    factor: float
    """In [0, 1]."""
    allow_empty: bool = False
    """False: an empty selection is an error."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "where", as_where(self.where))
        object.__setattr__(self, "factor", number_of("factor", self.factor))
        check_range("factor", self.factor, 0, 1)
        check_flag("allow_empty", self.allow_empty)

    def apply(self, splats: SplatFile) -> SplatFile:
        """See `Edit.apply`."""
        mask = selected(self.where, splats, self.allow_empty)
        opacities = splats.gaussians.opacities.clone()
        old = opacities[mask]
        opacities[mask] = torch.maximum(old * self.factor, old.clamp(max=HIDDEN))
        return splats.replace(gaussians=splats.gaussians.replace(opacities=opacities))
