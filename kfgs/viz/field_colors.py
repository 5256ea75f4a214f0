"""Features as colours: one projection for each scene, the same in every view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_shapes
from .pictures import Array, as_bytes

if TYPE_CHECKING:
    from ..fields import SemanticField


@dataclass(frozen=True, eq=False)
class FeatureColors:
    """One linear projection of features to RGB for a whole scene: equal features have equal colours in every view.

    Fit it once, on the codewords or on the Gaussians' features. If you fit it on each frame, the principal axes change
    from view to view, and the colours with them.
    """

    mean: Tensor  # [D]
    axes: Tensor  # [D, 3] principal directions, strongest first
    low: Tensor  # [3] projection that becomes 0
    high: Tensor  # [3] projection that becomes 255

    __repr__ = short_repr

    @staticmethod
    def fit(
        features: Tensor,  # [N, D]
    ) -> FeatureColors:
        """Fit the three principal axes; colours range from the 1st to the 99th percentile along each axis.

        The sign of an axis makes its largest entry positive, so that refitting gives the same colours. With fewer than
        three channels, or on an axis without spread, the missing colours stay in the middle.

        Raises:
            ValueError: if there are no features or one is not finite.
        """
        features = as_tensor("features", features, floating=True)
        check_shapes(("features", features, "N D"))
        rows = features.detach().double()
        if len(rows) == 0 or not bool(torch.isfinite(rows).all()):
            raise ValueError(
                f"features: expected at least one row of finite numbers, got {tuple(features.shape)} with "
                f"{int((~torch.isfinite(rows)).sum())} not finite; remove such rows first"
            )
        mean = rows.mean(dim=0)
        covariance = torch.cov(rows.T, correction=0).reshape(rows.shape[1], rows.shape[1])
        axes = torch.linalg.eigh(covariance).eigenvectors.flip(-1)[:, :3]
        largest = axes.gather(0, axes.abs().argmax(dim=0, keepdim=True))
        axes = torch.nn.functional.pad(axes * largest.sign(), (0, 3 - axes.shape[1]))
        projected = ((rows - mean) @ axes).cpu().numpy()
        low, high = torch.from_numpy(np.percentile(projected, [1, 99], axis=0)).to(rows.device)
        flat = (high - low) <= 1e-9 * mean.norm().clamp_min(1)
        return FeatureColors(mean, axes, torch.where(flat, -1, low), torch.where(flat, 1, high))

    def __call__(
        self,
        features: Tensor,  # [..., D], usually a map [H, W, D]
    ) -> Array:  # [..., 3] uint8
        """Colour features; projections outside the fitted range are clipped.

        Raises:
            ValueError: if D is not the fitted number of channels.
        """
        features = as_tensor("features", features, floating=True)
        if features.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"features: expected [..., D] with D = {len(self.mean)} (from fit), got {tuple(features.shape)}; "
                "fit on features of the same kind"
            )
        axes = self.axes / (self.high - self.low)
        offset = self.mean @ axes + self.low / (self.high - self.low)
        unit = features.detach() @ axes.to(features) - offset.to(features)
        return as_bytes(unit)


def feature_colors(field: SemanticField) -> FeatureColors:
    """The projection of a field's features to RGB, for `SemanticField.render(...).map` of every view.

    With a codebook, it is fitted to the codewords' latents (mode adc: to the codewords), so that stray Gaussians have no
    influence. Without a codebook, as in a fused field, it is fitted to the Gaussians' latents that are not all-zero.

    Note:
        Latents are not normalised, so the colour of a rendered blend is the blend of the colours. Normalising would gain
        nothing: on room_0 (17 latents, lengths 0.43 to 0.96) no colour channel correlates with the length by more than
        0.11, and normalised latents separate the classes no better (91, 79 and 80 % of a channel's variance lies between
        classes, with both).

    Raises:
        TypeError: if it is no field.
        ValueError: if features are missing or not finite.
    """
    if not hasattr(field, "codebook"):
        raise TypeError(
            f"field: expected a SemanticField, got {type(field).__name__}; FeatureColors.fit(features) takes features"
        )
    if field.codebook is None:
        return colors_of_features(field.features)
    if field.autoencoder is None:
        return FeatureColors.fit(field.codebook.codewords)
    with torch.no_grad():
        return FeatureColors.fit(field.autoencoder.encode(field.codebook.codewords))


def colors_of_features(
    features: Tensor,  # [N, D]
) -> FeatureColors:
    """The projection for Gaussians without a codebook, fitted to all features that are not all-zero."""
    learnt = features.detach().any(dim=-1)
    return FeatureColors.fit(features[learnt] if bool(learnt.any()) else features)
