"""Edits of a colour field by a mask of its Gaussians: remove, extract, recolour. Each returns a new object."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .._check import check_shapes
from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0, sh0_to_rgb

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 weights of R, G, B
DARK = 1 / 255  # below one 8-bit step an object's mean luminance says nothing about its shading


def remove(gaussians: Gaussians, mask: Tensor) -> Gaussians:  # mask: [N] bool
    """The Gaussians without those under the mask ("delete the chair")."""
    _check_mask(gaussians, mask)
    return gaussians.select(~mask)


def extract(gaussians: Gaussians, mask: Tensor) -> Gaussians:  # mask: [N] bool
    """Only the Gaussians under the mask."""
    _check_mask(gaussians, mask)
    return gaussians.select(mask)


def recolor(
    gaussians: Gaussians,
    mask: Tensor,  # [N] bool
    rgb: Sequence[float] | Tensor,  # [3] in [0, 1]
) -> Gaussians:
    """Give the Gaussians under the mask one hue and keep their shading.

    With L(v) the luminance of a Gaussian seen from direction v and L0 the mean view-independent luminance under the
    mask, the new colour is `rgb L(v) / L0`: linear in the spherical harmonics, so it holds from every direction, and the
    mean colour under the mask becomes `rgb`. Where L0 is below 1/255 there is no shading to keep and the colour is flat.

    Args:
        gaussians: a colour field (with `sh`).
        mask: which Gaussians to paint.
        rgb: the colour, in the same (display) space as the photographs.

    Raises:
        ValueError: if there is no `sh`, the mask is no mask of these Gaussians, or `rgb` is not three numbers in [0, 1].
        TypeError: if the mask is not boolean.

    Note:
        Highlights may exceed 1; renderers clip them. The paper says only "color modification".
    """
    _check_mask(gaussians, mask)
    if gaussians.sh is None:
        raise ValueError(
            "gaussians.sh: expected spherical harmonics [N, K, 3], got None; pass the colour field, not the semantic one"
        )
    sh = gaussians.sh
    target = torch.as_tensor(rgb, dtype=sh.dtype, device=sh.device)
    if target.shape != (3,) or not bool(((target >= 0) & (target <= 1)).all()):
        raise ValueError(f"rgb: expected three numbers in [0, 1], got {rgb!r}; divide 8-bit colours by 255")
    if not bool(mask.any()):
        return gaussians
    weights = torch.tensor(LUMINANCE, dtype=sh.dtype, device=sh.device)
    luminance = sh0_to_rgb(sh[mask, 0]) @ weights  # [n], may be slightly negative: 3DGS clamps after summing
    mean = luminance.mean()
    painted = torch.zeros_like(sh[mask])
    if float(mean) < DARK:
        painted[:, 0] = rgb_to_sh0(target)
    else:
        painted[:, 0] = rgb_to_sh0(target * (luminance / mean)[:, None])
        painted[:, 1:] = (sh[mask, 1:] @ weights)[..., None] * target / mean
    recoloured = sh.clone()
    recoloured[mask] = painted
    return gaussians.replace(sh=recoloured)


def _check_mask(gaussians: Gaussians, mask: Tensor) -> None:
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("mask", mask, "N"))
    if mask.dtype != torch.bool:
        raise TypeError(f"mask: expected a boolean mask, got {mask.dtype}; compare first, as in labels == 3")
