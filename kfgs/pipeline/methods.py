"""The two methods of `fit` and their options."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, is_dataclass
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
    """The paper's method (Sec. 3): compress the maps per pixel, then train Gaussians on them.

    Codebook and autoencoder are the paper's, the field's schedule is one for a CPU. See also `paper` and `grown`.
    """

    codebook: PaperCodebook | GrownCodebook | None = field(default_factory=PaperCodebook)
    """Adaptive Data Compression (Sec. 3.3.1). None, with `autoencoder=None`: raw features, "just decouple" of Table 1."""
    autoencoder: AutoencoderConfig | None = field(default_factory=AutoencoderConfig.paper)
    """Semantic Compression (Sec. 3.3.2). None: a Gaussian has all D channels, the row "decouple+ADC" of Table 1."""
    training: Training = field(default_factory=Training.cpu)
    """Training of the decoupled field (Eq. 4)."""

    def __post_init__(self) -> None:
        if not isinstance(self.codebook, PaperCodebook | GrownCodebook | None):
            raise TypeError(f"codebook: expected PaperCodebook, GrownCodebook or None, got {self.codebook!r}; pass one")
        if self.codebook is None and self.autoencoder is not None:
            expected = "None with codebook=None, since it learns from codewords"
            raise ValueError(f"autoencoder: expected {expected}, got options; pass None for both")

    @staticmethod
    def paper(**changes: Any) -> Paper:
        """With the paper's schedule of the field, too: 30,000 steps. For a workstation."""
        return Paper(**({"training": Training()} | changes))

    @staticmethod
    def grown(**changes: Any) -> Paper:
        """With kfgs's own codebook, and an autoencoder that learns blends of codewords as well."""
        options: dict[str, Any] = {"codebook": GrownCodebook(), "autoencoder": AutoencoderConfig()}
        return Paper(**(options | changes))

    def options(self) -> dict[str, Any]:
        """The options as JSON."""
        return {"method": "paper", **asdict(self)}


def changes(ours: Any, papers: Any, place: str = "") -> Iterator[str]:
    """Options that decide the result and differ from the paper's, as `codebook.maximum=50`."""
    for (name, own), printed in zip(vars(ours).items(), vars(papers).values(), strict=True):
        if is_dataclass(own) and type(own) is type(printed):
            yield from changes(own, printed, f"{place}{name}.")
        elif own != printed and name not in ("engine", "report_every", "checkpoint_every"):
            yield f"{place}{name}={own}"
