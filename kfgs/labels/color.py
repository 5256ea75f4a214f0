"""Colours for recolouring: read from text, and spread over an object's light and dark without losing its shading."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from PIL import ImageColor
from torch import Tensor

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 weights of R, G, B, on display values: what blending is linear in
DARK = 1 / 255  # below one 8-bit step an object's luminance says nothing about its shading


def parse_color(color: str | Sequence[float] | Tensor, name: str = "rgb") -> tuple[float, float, float]:
    """A colour as (red, green, blue) in [0, 1].

    Args:
        color: `"#c04040"`, `"#c44"`, a CSS name such as `"teal"`, `"rgb(192, 64, 64)"`, `"hsl(0, 50%, 50%)"`; or three
            numbers in [0, 1].
        name: the argument that errors speak of.

    Raises:
        ValueError: if it is no such colour, or has an alpha channel.

    Example:
        >>> parse_color("#ff0080") == parse_color("rgb(255, 0, 128)") == (1.0, 0.0, 128 / 255)
        True
    """
    if isinstance(color, str):
        try:
            channels = ImageColor.getrgb(color.strip())
        except ValueError as error:
            raise ValueError(
                f"{name}: expected a colour such as '#c04040', 'teal' or 'rgb(192, 64, 64)', got {color!r:.80}; "
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


class Shades(NamedTuple):
    """Which colour replaces each luminance: a curve from black to white through the shades and tints of one hue.

    A tone t(L) comes first: `gain L` up to the bend, then straight on to white at L = 1. The colour of a tone is the one
    of that luminance and hue, as saturated as the display shows it: `peak t / knee` up to the knee, then straight on to
    white. Both rise, so what was darker stays darker, and from [0, 1] neither leaves the display's range; only a tone that
    reaches white at its bend (`tint` to white) is flat from there on.
    """

    peak: Tensor  # [3] the brightest colour of the hue and saturation: its largest channel is 1
    knee: Tensor  # [] its luminance
    gain: Tensor  # [] ratio of new to old luminance
    bend: Tensor  # [] old luminance up to which the ratio holds; infinite where it holds throughout

    def __call__(self, luminance: Tensor) -> tuple[Tensor, Tensor]:  # [n] -> [n, 3], [n, 3]
        """The colour of each luminance, and by how much it changes per unit of luminance."""
        bent = luminance > self.bend
        straight = (1 - self.gain * self.bend) / (1 - self.bend) if bool(bent.any()) else self.gain
        tone = self.gain * luminance.clamp(max=self.bend) + straight * (luminance - self.bend).clamp(min=0)
        rate = torch.where(bent, straight, self.gain)
        above = (tone > self.knee)[:, None]
        rest = 1 - self.knee
        to_white = (1 - self.peak) / rest if float(rest) > 1e-6 else torch.ones_like(self.peak)  # greys go on as greys
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

    A darker colour than before keeps all ratios. A brighter one could leave the display's range: there they hold until
    `rgb` is at its most brilliant, or half-way to white, and what is brighter still goes straight on to white. To white
    itself they hold up to `middle`, and all above it is white.
    """
    shades = same_luminance(rgb)
    target = rgb @ rgb.new_tensor(LUMINANCE)
    gain = target / middle
    if float(gain) <= 1:
        return shades._replace(gain=gain)
    return shades._replace(gain=gain, bend=torch.minimum(shades.knee, (1 + target) / 2) / gain)
