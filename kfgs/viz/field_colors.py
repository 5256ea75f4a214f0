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

    Of a trained field with codebook it is fitted to the codewords' latents (mode adc: to the codewords), so that stray
    Gaussians do not shape it. A fused field, and one without codebook, has no codewords: it is fitted to the Gaussians'
    latents, without those that are all-zero.

    Note:
        Linear latents share a main direction. The colours come from what varies about their mean, so nothing is normalised:
        on room_0 (17 latents, lengths 0.43 to 0.96) no colour channel correlates with the length by more than 0.11, and
        normalised latents separate the classes no better (91, 79 and 80 % of a channel's variance lies between classes,
        with both). Unnormalised, the colour of a rendered blend is the blend of the colours.

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
