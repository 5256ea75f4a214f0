"""The colour of each Gaussian: by class, harmonics, feature, score or opacity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_array, as_tensor, check_choice, check_range, check_shapes
from ..gaussians import Gaussians
from ..labels import OfClass, Selection
from ..labels.selection import Rule, as_selection, class_names
from ..splat.sh import sh0_to_rgb
from .palette import UNLABELLED, palette
from .pictures import Array, as_bytes

SOURCES = {
    "label": "labels", "class": "labels", "score": "scores", "rgb": "sh", "view": "sh", "feature": "features",
    "opacity": "opacities",
}  # fmt: skip
USUAL = ("label", "rgb", "feature", "opacity")  # the first of these that there is
ColorBy = str | Selection | Rule | Tensor | Array | None
COLORMAP = "cividis"  # brightness rises evenly; looks the same to colour-blind eyes


@dataclass(frozen=True, eq=False)
class FeatureColors:
    """One linear projection of features to RGB for a whole scene: equal features have equal colours in every view.

    Fit it once, on the Gaussians' features or on codewords. If you fit it on each frame, the principal axes change from
    view to view, and the colours with them.
    """

    mean: Tensor  # [D]
    axes: Tensor  # [D, 3] principal directions, strongest first
    low: Tensor  # [3] projection that becomes 0
    high: Tensor  # [3] projection that becomes 255

    __repr__ = short_repr

    @staticmethod
    def fit(features: Tensor) -> FeatureColors:  # [N, D]
        """Fit the three principal axes; colours range from the 1st to the 99th percentile along each axis.

        Rows that are all zero (a Gaussian that learnt nothing) are left out. The sign of an axis makes its largest entry
        positive, so that refitting gives the same colours. With fewer than three channels, or on an axis without spread,
        the missing colours stay in the middle.

        Raises:
            ValueError: if there are no features or one is not finite.
        """
        features = as_tensor("features", features, floating=True)
        check_shapes(("features", features, "N D"))
        rows = features.detach().double()
        if len(rows) == 0 or not bool(torch.isfinite(rows).all()):
            raise ValueError(
                f"features: expected finite numbers, got {tuple(features.shape)} with others; remove such rows"
            )
        learnt = rows.any(dim=1)
        rows = rows[learnt] if bool(learnt.any()) else rows
        mean = rows.mean(dim=0)
        covariance = torch.cov(rows.T, correction=0).reshape(rows.shape[1], rows.shape[1])
        axes = torch.linalg.eigh(covariance).eigenvectors.flip(-1)[:, :3]
        largest = axes.gather(0, axes.abs().argmax(dim=0, keepdim=True))
        axes = torch.nn.functional.pad(axes * largest.sign(), (0, 3 - axes.shape[1]))
        projected = ((rows - mean) @ axes).cpu().numpy()
        low, high = torch.from_numpy(np.percentile(projected, [1, 99], axis=0)).to(rows.device)
        flat = (high - low) <= 1e-9 * mean.norm().clamp_min(1)
        return FeatureColors(mean, axes, torch.where(flat, -1, low), torch.where(flat, 1, high))

    def __call__(self, features: Tensor) -> Array:  # [..., D], usually a map [H, W, D] -> [..., 3] uint8
        """Colour features with the fitted number of channels; projections outside the fitted range are clipped."""
        features = as_tensor("features", features, floating=True)
        if features.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"features: expected [..., D] with D = {len(self.mean)} (from fit), got {tuple(features.shape)}; "
                "fit on features of the same kind"
            )
        axes = self.axes / (self.high - self.low)
        offset = self.mean @ axes + self.low / (self.high - self.low)
        return as_bytes(features.detach() @ axes.to(features) - offset.to(features))


class CloudColors(NamedTuple):
    """Colours and their meaning."""

    rgb: Array  # [N, 3] uint8
    name: str  # what the colours show
    values: Array | None  # [N] the values shown, if each Gaussian has one
    clim: tuple[float, float] | None  # the values of the darkest and the brightest colour; None: not a scale


def cloud_colors(
    gaussians: Gaussians,
    color_by: ColorBy,
    feature_colors: FeatureColors | None = None,
    clim: tuple[float, float] | None = None,
    cmap: str = COLORMAP,
) -> CloudColors:
    """Colour a cloud; arguments and errors are those of `add_cloud`."""
    if color_by is None:
        color_by = next(name for name in USUAL if getattr(gaussians, SOURCES[name]) is not None)
    color_by = as_selection(color_by, gaussians).scores if isinstance(color_by, Selection | Rule) else color_by
    if isinstance(color_by, str):
        names = class_names(gaussians)
        check_choice("color_by", color_by, (*SOURCES, *names))
        source = SOURCES.get(color_by, "labels")
        values = getattr(gaussians, source)
        if values is None:
            raise ValueError(f"gaussians.{source}: expected some, got None for color_by={color_by!r}; choose another")
        if source == "labels":
            if color_by not in SOURCES:
                values = values.where(OfClass(color_by).select(gaussians).mask, -1)
            return CloudColors(palette(values, names), "label", as_array(values).astype(np.int64), None)
        if color_by in ("rgb", "view"):
            return CloudColors(as_bytes(sh0_to_rgb(values[:, 0].detach())), "sh", None, None)
        if color_by == "feature":
            return CloudColors((feature_colors or FeatureColors.fit(values))(values), "feature", None, None)
        return _scale(color_by, as_array(values), clim or (0.0, 1.0), cmap)
    values = as_array(color_by, "color_by")
    if values.ndim == 2:
        check_shapes(("gaussians", gaussians.opacities, "N"), ("color_by", values, "N 3"))
        return CloudColors(as_bytes(values), "rgb", None, None)
    check_shapes(("gaussians", gaussians.opacities, "N"), ("color_by", values, "N"))
    if values.dtype.kind in "fb":  # of a mask, 0 and 1
        return _scale("score", values * 1.0, clim, cmap)
    if not np.issubdtype(values.dtype, np.integer):
        raise TypeError(f"color_by: expected labels (integers) or scores (floats), got {values.dtype}; convert it")
    return CloudColors(palette(values), "label", values.astype(np.int64), None)


def _scale(name: str, values: Array, clim: tuple[float, float] | None, cmap: str) -> CloudColors:
    """Values through the colour map, by default from their 1st to their 99th percentile; those not finite are grey."""
    from matplotlib import colormaps

    finite = np.isfinite(values)
    if clim is None:
        known = values[finite] if finite.any() else np.zeros(1)
        low, high = (float(end) for end in np.quantile(known, (0.01, 0.99)))
        clim = (low, high) if low < high else (float(known.min()) - 0.5, float(known.max()) + 0.5)
    check_range("clim[0]", clim[0], -np.inf, closed=(False, False))
    check_range("clim[1]", clim[1], clim[0], closed=(False, False))
    unit = np.where(finite, (values - clim[0]) / (clim[1] - clim[0]), 0.0)
    rgb: Array = colormaps[cmap](unit, bytes=True)[:, :3]
    return CloudColors(np.where(finite[:, None], rgb, np.array(UNLABELLED, np.uint8)), name, values, clim)
