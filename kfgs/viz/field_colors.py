"""One projection to colours for each scene: which features it is fitted to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .pictures import FeatureColors

if TYPE_CHECKING:
    from ..fields import SemanticField


def feature_colors(field: SemanticField) -> FeatureColors:
    """One projection of this field's features to RGB, the same for every view of it, for `SemanticField.render(...).map`.

    Of d latents it is fitted to those of the codewords, and of features near codewords to the codewords: stray Gaussians
    do not shape it. A field without codebook has its Gaussians' features alone, of which those that left their start at 0
    count.

    Raises:
        ValueError: if these are not finite, or there are none.
    """
    if field.codebook is None:
        return learnt_colors(field.features)
    if field.autoencoder is None:
        return FeatureColors.fit(field.codebook.codewords)
    with torch.no_grad():
        return FeatureColors.fit(field.autoencoder.encode(field.codebook.codewords))


def learnt_colors(
    features: Tensor,  # [N, D]
) -> FeatureColors:
    """The projection of Gaussians of which nothing else is known, fitted to all features that are not 0.

    Raises:
        ValueError: if one is not finite, or there are none.
    """
    learnt = features.detach().any(dim=-1)
    return FeatureColors.fit(features[learnt] if bool(learnt.any()) else features)
