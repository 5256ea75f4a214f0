"""Give Gaussians one hue and keep their shading; colours are read from text."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from PIL import ImageColor
from torch import Tensor

from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0, sh0_to_rgb
from .selection import three_numbers

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 weights of R, G, B, on display values, in which blending is linear
DARK = 1 / 255  # an object darker than one 8-bit step has no shading


def parse_color(color: str | Sequence[float] | Tensor, name: str = "rgb") -> tuple[float, ...]:
    """A colour as (red, green, blue) in [0, 1], from `"#c04040"`, a CSS name, `"rgb(192, 64, 64)"`, or three numbers in [0, 1].

    `name` is the argument's name in errors (ValueError).

    Example:
        >>> parse_color("#ff0080") == parse_color("rgb(255, 0, 128)") == (1.0, 0.0, 128 / 255)
        True
    """
    if isinstance(color, str):
        try:
            channels = ImageColor.getrgb(color.strip())
        except ValueError as error:
            raise ValueError(f"{name}: expected a colour like '#c04040' or 'teal', got {color!r:.80}") from error
        if len(channels) != 3:
            raise ValueError(f"{name}: expected a colour without alpha, got {color!r}; use the Opacity edit for that")
        return channels[0] / 255, channels[1] / 255, channels[2] / 255
    rgb = three_numbers(name, color)
    if not all(0 <= value <= 1 for value in rgb):
        raise ValueError(f"{name}: expected three numbers in [0, 1], got {color!r:.80}; divide 8-bit colours by 255")
    return rgb


def recolor(
    gaussians: Gaussians,
    mask: Tensor,  # [N] bool
    rgb: Sequence[float],  # [3] in [0, 1]
) -> Gaussians:
    """Give the Gaussians under the mask one hue and keep their shading: what the edit `Recolor` does.

    Each Gaussian's luminance L (Rec. 709, of its view-independent colour) is replaced by a colour T(L) on a curve from
    black over the shades of `rgb` to white (`shades`), and its view-dependent luminance follows the curve's slope there:
    `color(v) = T(L) + T'(L) (L(v) - L)`. That is linear in the spherical harmonics, so it holds from every direction, and
    blending keeps it. The object's middle luminance (the median by visible area) becomes `rgb`; if it was below 1/255, the
    colour is flat. The paper says only "color modification".
    """
    if gaussians.sh is None:
        raise ValueError("gaussians.sh: expected spherical harmonics [N, K, 3], got None; pass the colour field")
    sh, target = gaussians.sh[mask], gaussians.sh.new_tensor(rgb)
    weights = sh.new_tensor(LUMINANCE)
    luminance = sh0_to_rgb(sh[:, 0]) @ weights  # [n], may be slightly negative: 3DGS clamps after summing
    middle = _middle(luminance.detach(), gaussians.opacities[mask].detach(), gaussians.scales[mask].detach())
    painted = torch.zeros_like(sh)
    if float(middle) < DARK:
        painted[:, 0] = rgb_to_sh0(target)
    else:
        colors, slopes = shades(luminance, target, middle)
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


def shades(luminance: Tensor, rgb: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:  # [n], [3], [] -> [n, 3] x 2
    """What replaces each luminance, a colour on the curve from black to white through the shades and tints of one hue.

    And the change of the colours per unit of luminance. The old luminance L first becomes a tone t(L) = gain L, so that the
    middle becomes `rgb` and ratios stay, as at a change of albedo. If the new colour is brighter, ratios hold up to a bend
    (the hue at its brightest, or halfway to white), and t goes linearly to 1 at L = 1. A tone is shown as saturated as
    possible: `peak t / knee` up to the knee, then linear to white. Black gives greys.
    """
    weights = rgb.new_tensor(LUMINANCE)
    peak = rgb / rgb.max() if float(rgb.max()) > 0 else torch.ones_like(rgb)  # the brightest colour of this hue
    knee = peak @ weights
    gain = rgb @ weights / middle
    bend = torch.minimum(knee, (1 + rgb @ weights) / 2) / gain if float(gain) > 1 else torch.full_like(knee, torch.inf)
    straight = (1 - gain * bend) / (1 - bend) if float(gain) > 1 else gain
    to_white = (1 - peak) / (1 - knee) if float(1 - knee) > 1e-6 else torch.ones_like(peak)  # greys stay grey
    tone = gain * luminance.clamp(max=bend) + straight * (luminance - bend).clamp(min=0)
    above = (tone > knee)[:, None]
    slopes = torch.where(above, to_white, peak / knee)
    colors = torch.where(above, peak + to_white * (tone - knee)[:, None], slopes * tone[:, None])
    return colors, slopes * torch.where(luminance > bend, straight, gain)[:, None]
