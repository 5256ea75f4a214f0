"""The two methods of `fit` and their options."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..fields import Training, UpliftConfig
from ..gaussians import Gaussians
from ..quant import AutoencoderConfig, GrownCodebook, LinearLatents, PaperCodebook
from .color import ColorConfig


@dataclass(frozen=True)
class Uplift:
    """Average the features onto sharp Gaussians in 3-D, then merge and compress (`fields.uplift_maps`).

    Features of a real network are noisy per pixel and right on average: they are fused first and compressed after.
    """

    splat: Gaussians | str | Path | None = None
    """The Gaussians to average onto, in the scene's frame, or a splat file; None: they are trained on the pictures."""
    uplift: UpliftConfig = field(default_factory=UpliftConfig.field)
    """How to average. `UpliftConfig()` keeps every Gaussian of the splat."""
    color: ColorConfig = field(default_factory=ColorConfig.geometry)
    """How to train Gaussians if there is no splat; `ColorConfig()` is the published schedule. If `fit_color` trained for longer
    in the same run folder, its Gaussians are used instead."""
    latents: LinearLatents | None = None
    """Latents of other fields (`fields.working_maps.sample_latents`), which this one shall share; None: its own."""

    def options(self) -> dict[str, Any]:
        """The options as JSON, without the Gaussians and latents."""
        return {"method": "uplift", "uplift": asdict(self.uplift), "color": asdict(self.color)}


@dataclass(frozen=True)
class Paper:
    """Compress the maps per pixel, then train Gaussians on them (Sec. 3). The defaults are for a CPU; see `paper`."""

    codebook: GrownCodebook | PaperCodebook | None = field(default_factory=GrownCodebook)
    """Adaptive Data Compression (Sec. 3.3.1). None, with `autoencoder=None`: the field is trained on the raw features, the
    row "just decouple" of Table 1."""
    autoencoder: AutoencoderConfig | None = field(default_factory=AutoencoderConfig)
    """Semantic Compression (Sec. 3.3.2). None: a Gaussian has all D channels, the row "decouple+ADC" of Table 1."""
    training: Training = field(default_factory=Training.cpu)
    """Training of the decoupled field (Eq. 4)."""

    def __post_init__(self) -> None:
        if self.codebook is None and self.autoencoder is not None:
            raise ValueError(
                "autoencoder: expected None with codebook=None, since it learns from codewords, got options; pass None for both"
            )

    @staticmethod
    def paper(**changes: Any) -> Paper:
        """The paper's values: 28 epochs, 5,000 steps of the autoencoder, 30,000 of the field. For a workstation."""
        options: dict[str, Any] = {
            "codebook": PaperCodebook(),
            "autoencoder": AutoencoderConfig.paper(),
            "training": Training(),
        }
        return Paper(**(options | changes))

    def options(self) -> dict[str, Any]:
        """The options as JSON."""
        return {"method": "paper", **asdict(self)}
