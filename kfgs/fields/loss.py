"""What a rendered map is compared by."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..cameras import resize_map

Loss = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(rendered map [H, W, D], its alpha [H, W], target [h, w, D]) -> a scalar."""


def l1_loss(
    rendered: Tensor,  # [H, W, D]
    alpha: Tensor,  # [H, W], not used
    target: Tensor,  # [h, w, D]
) -> Tensor:  # []
    """Eq. 4: the rendered map F_r, resized bilinearly to the target's size, against the latent map F_l.

    The mean of the absolute differences over pixels and channels: the paper writes a norm, its released script takes
    the mean, and the learning rates and the densification threshold of 3DGS are made for a mean. Pixels whose target is
    NaN are not known and count nowhere.
    """
    height, width, channels = target.shape
    known = ~target[..., 0].isnan()
    difference = torch.where(known[..., None], resize_map(rendered, (height, width)) - target, 0)
    return difference.abs().sum() / (known.sum() * channels).clamp_min(1)
