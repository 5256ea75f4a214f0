"""Edits of a colour field by a mask of its Gaussians: remove, extract, recolour. Each returns a new object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from .._check import check_choice, check_shapes
from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0, sh0_to_rgb
from .color import DARK, LUMINANCE, parse_color, same_luminance, tint

Mode = Literal["tint", "hue"]


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
    rgb: str | Sequence[float] | Tensor,  # [3] in [0, 1]
    mode: Mode = "tint",
) -> Gaussians:
    """Give the Gaussians under the mask one hue and keep their shading.

    Each Gaussian's luminance L (of its view-independent colour) is replaced by a colour T(L) on a curve from black over
    the shades of `rgb` to white (`color.Shades`), and its view-dependent luminance follows the curve's slope there:
    `color(v) = T(L) + T'(L) (L(v) - L)`. That is linear in the spherical harmonics, so it holds from every direction,
    and blending keeps it. Alpha, and with it the geometry, is untouched.

    - `"tint"` paints it: the object's middle luminance (the median by visible area) becomes `rgb`, and ratios of
      luminance stay, as when the albedo changes under the same light. Where the middle is below 1/255 there is no
      shading to keep and the colour is flat. White leaves no room above it: what was brighter than the middle becomes
      white as well.
    - `"hue"` keeps luminance from every direction and changes hue and saturation only: a dark plant stays dark. Where a
      channel lay outside [0, 1] before or does so after, the renderer's clamp changes what is seen, and luminance with it.

    Args:
        gaussians: a colour field (with `sh`).
        mask: which Gaussians to paint.
        rgb: the colour, in the same (display) space as the photographs; text as `parse_color` reads it.
        mode: what stays, see above.

    Raises:
        ValueError: if there is no `sh`, the mask is no mask of these Gaussians, or `rgb` is no colour.
        TypeError: if the mask is not boolean.

    Note:
        Nothing of the old hues is left: a red flower on a green stem becomes one hue. Select them apart to keep two.
        Luminance is Rec. 709 luma of display values. The paper says only "color modification".
    """
    _check_mask(gaussians, mask)
    check_choice("mode", mode, ("tint", "hue"))
    if gaussians.sh is None:
        raise ValueError(
            "gaussians.sh: expected spherical harmonics [N, K, 3], got None; pass the colour field, not the semantic one"
        )
    target = gaussians.sh.new_tensor(parse_color(rgb))
    if not bool(mask.any()):
        return gaussians
    sh = gaussians.sh[mask]
    weights = sh.new_tensor(LUMINANCE)
    luminance = sh0_to_rgb(sh[:, 0]) @ weights  # [n], may be slightly negative: 3DGS clamps after summing
    middle = _middle(luminance.detach(), gaussians.opacities[mask].detach(), gaussians.scales[mask].detach())
    painted = torch.zeros_like(sh)
    if mode == "tint" and float(middle) < DARK:
        painted[:, 0] = rgb_to_sh0(target)
    else:
        shades = same_luminance(target) if mode == "hue" else tint(target, middle)
        colors, slopes = shades(luminance)
        painted[:, 0] = rgb_to_sh0(colors)
        painted[:, 1:] = (sh[:, 1:] @ weights)[..., None] * slopes[:, None]
    recoloured = gaussians.sh.clone()
    recoloured[mask] = painted
    return gaussians.replace(sh=recoloured)


def _middle(luminance: Tensor, opacities: Tensor, scales: Tensor) -> Tensor:  # [n], [n], [n, 3] -> []
    """The median luminance, weighted by how much of a picture each Gaussian can cover."""
    sides = scales.topk(2, dim=1).values
    weights = (opacities * sides[:, 0] * sides[:, 1]).double()
    order = luminance.argsort()
    reached = weights[order].cumsum(0)
    return luminance[order][int(torch.searchsorted(reached, reached[-1] / 2).clamp(max=len(order) - 1))]


def _check_mask(gaussians: Gaussians, mask: Tensor) -> None:
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("mask", mask, "N"))
    if mask.dtype != torch.bool:
        raise TypeError(f"mask: expected a boolean mask, got {mask.dtype}; compare first, as in labels == 3")
