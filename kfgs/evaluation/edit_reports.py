"""What the protocols of edits say of one: shares and decibels, how much was measured, and whether the edit passed."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

REMOVAL = (
    "kfgs-removal/1: held-out views of a scene with exact labels and surfaces. A Gaussian shows the class if its centre is "
    "nearest to the class's surface. Pixels of the class that such Gaussians gave at least 1/4 of their light: gone = less "
    "than half of that light is left; changed = some channel moved by 8/255. Pixels of other classes: untouched = no "
    "channel moved by 8/255. Surface points whose density (sum of o exp(-d^2 / 2)) was at least 0.05: of the class, gone = "
    "less than half is left; of others, kept = at least half is left. As a protocol, the lowest of the four shares leads"
)
RECOLOR = (
    "kfgs-recolor/1: test views of a scene with exact labels. Outside = PSNR of after against before over all pixels of "
    "other classes and channels; inside = share of the class's coloured pixels whose hue is within 20 degrees of the target"
)
# Thresholds of `passed`: shares, and decibels.
GONE, UNTOUCHED, OUTSIDE = 0.95, 0.98, 35.0
CHANGED = (
    0.8  # a class that looks as before is not gone, wherever its Gaussians went; but some things match their background
)
HUE_INSIDE = 0.8
MEASURED = 0.5  # a report that measured less does not pass


@dataclass(frozen=True)
class RemovalReport:
    """Shares in [0, 1] (NaN if nothing could be measured), and how much was measured."""

    name: str
    """The class that was to be removed."""
    gone_pixels: float
    """Of the class's pixels: those that no longer show it."""
    changed_pixels: float
    """Of the same pixels: those that look different, by at least 8/255 in some channel."""
    untouched_pixels: float
    """Of the pixels of other classes: those that did not change."""
    untouched_off_border: float
    """The same without the pixels within 2 of the class, where soft edges mix the two."""
    gone_points: float
    """Of the class's surface: where its density is gone."""
    kept_points: float
    """Of the other surfaces: where the density stayed."""
    measured_pixels: float
    """Of the class's pixels: those that the object's Gaussians showed before the edit."""
    measured_points: float
    """Of the class's surface points: those that the cloud covered before the edit."""
    pixels: int
    """Pixels of the class in the views."""
    views: int
    protocol: str = REMOVAL

    @property
    def passed(self) -> bool:
        """Whether at least 0.95 of the class is removed and 0.98 of the rest is unchanged, in pictures and on surfaces.

        Also, 0.8 of the class's pixels must have changed, and at least half of its pixels and of its surface must have
        been measured.
        """
        gone = (
            self.gone_pixels >= GONE and self.gone_points >= GONE and self.changed_pixels >= CHANGED
        )  # NaN passes nothing
        kept = self.untouched_pixels >= UNTOUCHED and self.kept_points >= UNTOUCHED
        return gone and kept and self.measured_pixels >= MEASURED and self.measured_points >= MEASURED

    def __str__(self) -> str:
        return (
            f"{self.name} removed: {self.gone_pixels:.4f} of its pixels gone ({self.changed_pixels:.4f} changed), "
            f"{self.gone_points:.4f} of its surface; "
            f"untouched elsewhere: {self.untouched_pixels:.4f} of the pixels ({self.untouched_off_border:.4f} off its "
            f"border), {self.kept_points:.4f} of the surface ({self.protocol.split(':')[0]}, {self.views} views)"
        )

    @property
    def text(self) -> str:
        """The same, and what the protocol says."""
        return f"{self}\n{self.protocol}"

    def to_json(self) -> dict[str, Any]:
        """The report as plain values; NaN becomes null."""
        return _plain(self)


@dataclass(frozen=True)
class RecolorReport:
    """How far a recolouring stayed inside its object, and whether it got its colour."""

    name: str
    """The class that was to be recoloured."""
    rgb: tuple[float, float, float]
    """The colour that was asked for, in [0, 1]."""
    psnr_outside: float
    """Decibels over all pixels of other classes; infinite if nothing changed there."""
    psnr_off_border: float
    """The same without the pixels within 2 of the class, where soft edges mix the two."""
    hue_inside: float
    """Of the class's coloured pixels: those with the target's hue."""
    hue_before: float
    """The same before the edit: a brown chair is hardly moved by red."""
    measured_pixels: float
    """Of the class's pixels: those with enough colour after the edit to have a hue."""
    pixels: int
    """Pixels of the class in the views."""
    views: int
    protocol: str = RECOLOR

    @property
    def passed(self) -> bool:
        """Whether no other object changed (at least 35 dB outside) and at least 0.8 of the class has the new hue."""
        return self.psnr_outside >= OUTSIDE and self.hue_inside >= HUE_INSIDE and self.measured_pixels >= MEASURED

    def __str__(self) -> str:
        return (
            f"{self.name} recoloured: PSNR outside {self.psnr_outside:.1f} dB ({self.psnr_off_border:.1f} off its "
            f"border), {self.hue_inside:.4f} of its coloured pixels have the hue ({self.hue_before:.4f} before) "
            f"({self.protocol.split(':')[0]}, {self.views} views)"
        )

    @property
    def text(self) -> str:
        """The same, and what the protocol says."""
        return f"{self}\n{self.protocol}"

    def to_json(self) -> dict[str, Any]:
        """The report as plain values; what could not be measured, and an infinite PSNR, is null."""
        return _plain(self)


def _plain(report: RemovalReport | RecolorReport) -> dict[str, Any]:
    values = asdict(report) | {"passed": report.passed}
    return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in values.items()}
