"""Give Gaussians one hue and keep their shading; colours are read from text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from PIL import ImageColor
from torch import Tensor

from .._card import short_repr
from .._check import as_tensor, check_choice, check_shapes
from ..gaussians import Gaussians
from ..splat.sh import rgb_to_sh0, sh0_to_rgb

Mode = Literal["tint", "hue"]
MODES: tuple[Mode, ...] = get_args(Mode)
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 weights of R, G, B, on display values, in which blending is linear
DARK = 1 / 255  # an object darker than one 8-bit step has no shading


def parse_color(color: str | Sequence[float] | Tensor, name: str = "rgb") -> tuple[float, float, float]:
    """A colour as (red, green, blue) in [0, 1].

    Args:
        color: `"#c04040"`, a CSS name like `"teal"`, `"rgb(192, 64, 64)"`; or three numbers in [0, 1].
        name: the argument's name in errors (ValueError).

    Example:
        >>> parse_color("#ff0080") == parse_color("rgb(255, 0, 128)") == (1.0, 0.0, 128 / 255)
        True
    """
    if isinstance(color, str):
        try:
            channels = ImageColor.getrgb(color.strip())
        except ValueError as error:
            raise ValueError(
                f"{name}: expected a colour like '#c04040', 'teal' or 'rgb(192, 64, 64)', got {color!r:.80}; "
                "write one of these"
            ) from error
        if len(channels) != 3:
            raise ValueError(f"{name}: expected a colour without alpha, got {color!r}; use the Opacity edit for that")
        return channels[0] / 255, channels[1] / 255, channels[2] / 255
    plain: Any = color.tolist() if hasattr(color, "tolist") else color
    numbers = isinstance(plain, Sequence) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in plain)
    if not numbers or len(plain) != 3 or not all(0 <= value <= 1 for value in plain):
        raise ValueError(f"{name}: expected three numbers in [0, 1], got {color!r:.80}; divide 8-bit colours by 255")
    return float(plain[0]), float(plain[1]), float(plain[2])


def recolor(
    gaussians: Gaussians,
    mask: Tensor,  # [N] bool
    rgb: str | Sequence[float] | Tensor,  # [3] in [0, 1]
    mode: Mode = "tint",
) -> Gaussians:
    """Give the Gaussians under the mask one hue and keep their shading.

    Each Gaussian's luminance L (Rec. 709, of its view-independent colour) is replaced by a colour T(L) on a curve from
    black over the shades of `rgb` to white (`Shades`), and its view-dependent luminance follows the curve's slope there:
    `color(v) = T(L) + T'(L) (L(v) - L)`. That is linear in the spherical harmonics, so it holds from every direction,
    and blending keeps it. The paper says only "color modification".

    - `"tint"` paints it: the object's middle luminance (the median by visible area) becomes `rgb`, and ratios of
      luminance stay, as if the albedo changed under the same light. If the middle is below 1/255, the colour is flat.
    - `"hue"` keeps luminance from every direction and changes hue and saturation only: a dark plant stays dark.

    Raises:
        ValueError: if there is no `sh`, the mask has another length, or `rgb` is not a colour (see `parse_color`).
        TypeError: if the mask is not boolean.
    """
    mask = as_tensor("mask", mask)
    check_shapes(("gaussians.means", gaussians.means, "N 3"), ("mask", mask, "N"))
    if mask.dtype != torch.bool:
        raise TypeError(f"mask: expected a boolean mask, got {mask.dtype}; compare first, as in labels == 3")
    check_choice("mode", mode, MODES)
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


class Shades(NamedTuple):
    """The colour that replaces each luminance: a curve from black to white through the shades and tints of one hue.

    The old luminance L first becomes a tone t(L): `gain L` up to the bend, then linear to white at L = 1. A tone is its
    luminance in the given hue, as saturated as the display allows: `peak t / knee` up to the knee, then linear to white.
    """

    peak: Tensor  # [3] the brightest colour of the hue and saturation: its largest channel is 1
    knee: Tensor  # [] its luminance
    gain: Tensor  # [] ratio of new to old luminance
    bend: Tensor  # [] old luminance up to which the ratio holds; infinite if it holds throughout

    def __repr__(self) -> str:
        return short_repr(self)

    def __call__(self, luminance: Tensor) -> tuple[Tensor, Tensor]:  # [n] -> [n, 3], [n, 3]
        """The colour of each luminance, and by how much it changes per unit of luminance."""
        bent = luminance > self.bend
        straight = (1 - self.gain * self.bend) / (1 - self.bend) if bool(bent.any()) else self.gain
        tone = self.gain * luminance.clamp(max=self.bend) + straight * (luminance - self.bend).clamp(min=0)
        rate = torch.where(bent, straight, self.gain)
        above = (tone > self.knee)[:, None]
        rest = 1 - self.knee
        to_white = (1 - self.peak) / rest if float(rest) > 1e-6 else torch.ones_like(self.peak)  # greys stay grey
        slopes = torch.where(above, to_white, self.peak / self.knee)
        colors = torch.where(above, self.peak + to_white * (tone - self.knee)[:, None], slopes * tone[:, None])
        return colors, slopes * rate[:, None]


def same_luminance(rgb: Tensor) -> Shades:  # rgb: [3]
    """Shades that keep every luminance and take the hue of `rgb` (black has none: greys)."""
    brightest = rgb.max()
    peak = rgb / brightest if float(brightest) > 0 else torch.ones_like(rgb)
    knee = peak @ rgb.new_tensor(LUMINANCE)
    return Shades(peak, knee, torch.ones_like(knee), torch.full_like(knee, torch.inf))


def tint(rgb: Tensor, middle: Tensor) -> Shades:  # [3], []
    """Shades that turn the luminance `middle` (> 0) into `rgb` and keep ratios, as a change of albedo does.

    A darker colour than before keeps all ratios. A brighter one could leave the display's range: then ratios hold until
    the hue is at its brightest, or halfway to white, and brighter values go linearly to white.
    """
    shades = same_luminance(rgb)
    target = rgb @ rgb.new_tensor(LUMINANCE)
    gain = target / middle
    if float(gain) <= 1:
        return shades._replace(gain=gain)
    return shades._replace(gain=gain, bend=torch.minimum(shades.knee, (1 + target) / 2) / gain)
