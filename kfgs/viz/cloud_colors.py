"""The colour of each Gaussian: by class, harmonics, latent, score or opacity."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_array, check_choice, check_range, check_shapes
from ..gaussians import Gaussians, check_gaussians
from ..splat.sh import evaluate_sh, sh0_to_rgb
from .field_colors import FeatureColors, colors_of_features
from .palette import UNLABELLED, palette
from .pictures import as_bytes

Array = np.ndarray[Any, Any]
ColorBy = Literal["label", "rgb", "view", "opacity", "feature"]
COLORMAP = "cividis"  # brightness rises evenly; looks the same to colour-blind eyes


class CloudColors(NamedTuple):
    """Colours and their meaning."""

    rgb: Array  # [N, 3] uint8
    name: str  # what the colours show
    values: Array | None  # [N] the values shown, if each Gaussian has one
    clim: tuple[float, float] | None  # the values of the darkest and the brightest colour; None: not a scale

    def __repr__(self) -> str:
        return short_repr(self)


def cloud_colors(
    gaussians: Gaussians,
    color_by: ColorBy | Tensor | Array | None,
    feature_colors: FeatureColors | None = None,
    clim: tuple[float, float] | None = None,
) -> CloudColors:
    """Colour a cloud; the arguments are those of `add_cloud`.

    Raises:
        ValueError: if what to colour by is missing or has the wrong size.
        TypeError: if an array holds neither integers nor floats, or `gaussians` is something else.
    """
    check_gaussians(gaussians)
    if color_by is None:
        color_by, feature_colors = color_by_default(gaussians, feature_colors)
    if isinstance(color_by, str):
        check_choice("color_by", color_by, get_args(ColorBy))
        return _named(gaussians, color_by, feature_colors, clim)
    values = as_array(color_by, "color_by")
    if values.ndim == 2:
        check_shapes(("gaussians", gaussians.opacities, "N"), ("color_by", values, "N 3"))
        return CloudColors(as_bytes(values), "rgb", None, None)
    check_shapes(("gaussians", gaussians.opacities, "N"), ("color_by", values, "N"))
    if np.issubdtype(values.dtype, np.floating):
        return _scale("score", values, clim)
    if not np.issubdtype(values.dtype, np.integer):
        raise TypeError(
            f"color_by: expected labels (integers) or scores (floats), got {values.dtype}; convert it first"
        )
    return CloudColors(palette(values), "label", values.astype(np.int64), None)


def color_by_default(
    gaussians: Gaussians, feature_colors: FeatureColors | None
) -> tuple[Literal["label", "rgb", "feature", "opacity"], FeatureColors | None]:
    """The default of `color_by`: classes, else colours, else features, else opacity."""
    if gaussians.labels is not None:
        return "label", feature_colors
    if gaussians.sh is not None:
        return "rgb", feature_colors
    if gaussians.features is not None:
        return "feature", feature_colors or colors_of_features(gaussians.features)
    return "opacity", None


def seen_from(gaussians: Gaussians, center: Array) -> Array:  # center: [3] -> [N, 3] uint8
    """The colours of `sh` as a camera at `center` sees them."""
    assert gaussians.sh is not None
    place = torch.as_tensor(center, dtype=gaussians.means.dtype, device=gaussians.means.device)
    with torch.no_grad():
        return as_bytes(evaluate_sh(gaussians.sh, gaussians.means - place))


def _named(
    gaussians: Gaussians, color_by: str, feature_colors: FeatureColors | None, clim: tuple[float, float] | None
) -> CloudColors:
    if color_by == "label":
        if gaussians.labels is None:
            raise ValueError(
                "gaussians.labels: expected labels to colour by, got None; label them or choose another color_by"
            )
        return CloudColors(palette(gaussians.labels), "label", as_array(gaussians.labels).astype(np.int64), None)
    if color_by in ("rgb", "view"):
        if gaussians.sh is None:
            raise ValueError("gaussians.sh: expected harmonics to colour by, got None; a semantic field has no colour")
        return CloudColors(as_bytes(sh0_to_rgb(gaussians.sh[:, 0].detach())), "rgb", None, None)
    if color_by == "feature":
        if gaussians.features is None or feature_colors is None:
            missing = "gaussians.features" if gaussians.features is None else "feature_colors"
            raise ValueError(
                f"{missing}: expected it to colour by features, got None; fit FeatureColors once per scene"
            )
        return CloudColors(feature_colors(gaussians.features), "feature", None, None)
    return _scale("opacity", as_array(gaussians.opacities), clim or (0.0, 1.0))


def _scale(name: str, values: Array, clim: tuple[float, float] | None) -> CloudColors:
    """Values through the colour map; values that are not finite are grey."""
    from matplotlib import colormaps

    finite = np.isfinite(values)
    if clim is None:
        clim = _middle_range(values[finite])
    check_range("clim[0]", clim[0], -np.inf, closed=(False, False))
    check_range("clim[1]", clim[1], clim[0], closed=(False, False))
    unit = np.where(finite, (values - clim[0]) / (clim[1] - clim[0]), 0.0)
    rgb: Array = colormaps[COLORMAP](unit, bytes=True)[:, :3]
    return CloudColors(np.where(finite[:, None], rgb, np.array(UNLABELLED, np.uint8)), name, values, clim)


def _middle_range(values: Array) -> tuple[float, float]:
    """The 1st to the 99th percentile; if they are equal, all values; if these are equal too, one unit around them."""
    if values.size == 0:
        return 0.0, 1.0
    for outer in (1, 0):
        low, high = (float(end) for end in np.percentile(values, [outer, 100 - outer]))
        if high > low:
            return low, high
    return low - 0.5, high + 0.5
