"""How exactly a packed field keeps each of its numbers: one name for a user, one bound for each attribute."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from .._check import check_range

PrecisionName = Literal["lossless", "fine", "small", "tiny"]


@dataclass(frozen=True)
class Rounding:
    """The errors that packing may make. A packed file states the bound of each attribute in its own units."""

    means: float
    """Of each coordinate, as a share of the median radius of the cloud's Gaussians."""
    scales: float
    """Share of a scale, plus the same share of twice the largest error of a coordinate. Thinner Gaussians look no different."""
    degrees: float
    """Angle between a rotation and its stored one. Axes may change their order: the ellipsoid is the same."""
    opacities: float
    """Of an opacity, and of the agreement of the training views."""
    latents: float
    """Root mean square error of a fused latent, as a share of the median length; it turns a feature by about so many radians.
    Each number is within sqrt(3 / channels) times this share. Trained latents get half of it."""
    decoder: float
    """Root mean square error of a row of basis, codebook or text table, as a share of the row. Weights of an
    autoencoder get a quarter: their errors add up from layer to layer."""
    pixels: float
    """Share of a count of pixels (`SemanticField.seen`), plus as much of one pixel."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(name, value, 0, 30 if name == "degrees" else 1, closed=(False, True))


FINE = Rounding(1 / 128, 0.02, 0.5, 1 / 512, 0.02, 0.004, 0.05)
SMALL = Rounding(1 / 24, 0.08, 3.0, 1 / 40, 0.07, 0.02, 0.25)
TINY = Rounding(1 / 8, 0.15, 8.0, 1 / 30, 0.2, 0.04, 0.5)
PRECISIONS: dict[str, Rounding | None] = {"lossless": None, "fine": FINE, "small": SMALL, "tiny": TINY}
"""By name. None: bit for bit, in the same order; the others sort the Gaussians and give float32."""
CUSTOM = "custom"
"""The name of any other `Rounding`, in the file."""
