"""Options of `fit_scene`: the method, and the options of every stage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from dataclasses import field as default
from typing import Any, Literal

from .._check import check_choice, check_whole
from ..fields import FieldConfig, UpliftConfig
from ..quant import AutoencoderConfig, GrownCodebook, PaperCodebook
from .color import ColorConfig

Method = Literal["fuse", "paper"]
METHODS: tuple[Method, ...] = ("fuse", "paper")
Mode = Literal["decouple", "adc", "adc+sc"]
MODES: tuple[Mode, ...] = ("decouple", "adc", "adc+sc")


@dataclass(frozen=True)
class FitConfig:
    """Options of `fit_scene`."""

    method: Method = "fuse"
    """`fuse`: features are averaged onto sharp Gaussians in 3-D, then merged and compressed (`fields.uplift_maps`).
    `paper`: maps are compressed per pixel, and Gaussians are trained on them (Sec. 3)."""
    mode: Mode = "adc+sc"
    """For method `paper`, rows of Table 1: `decouple` (raw features), `adc` (+ codebook), `adc+sc` (+ codebook + autoencoder)."""
    seed: int = 0
    """Every random choice of the run follows from it."""
    split: str = "train"
    """The split of training views; "all" trains on all views."""
    device: str = "auto"
    """Where to train a field, see `training_device`; the other stages and the result stay on the CPU."""
    undistorted_features: bool = False
    """Whether the teacher saw undistorted pictures; if not, its maps are undistorted like the pictures."""
    uplift: UpliftConfig = default(default_factory=UpliftConfig.field)
    """Of method `fuse`."""
    color: ColorConfig = default(default_factory=ColorConfig.geometry)
    """For method `fuse` without a splat: how to train Gaussians to fuse onto."""
    codebook: GrownCodebook | PaperCodebook = default(default_factory=GrownCodebook)
    """This and the rest: of method `paper`."""
    autoencoder: AutoencoderConfig = default(default_factory=AutoencoderConfig)
    field: FieldConfig = default(default_factory=FieldConfig)

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("mode", self.mode, MODES)
        check_whole("seed", self.seed, -math.inf)

    @property
    def needs_maps(self) -> bool:
        """Whether the field is trained on the dense maps, so that they must be stored."""
        return self.method == "paper" and self.mode == "decouple"

    @staticmethod
    def paper(**changes: Any) -> FitConfig:
        """The paper's method and schedule: 28 epochs, 5,000 autoencoder steps, 30,000 field steps. For a workstation."""
        options: dict[str, Any] = {"codebook": PaperCodebook(), "autoencoder": AutoencoderConfig.paper()}
        return FitConfig(**{"method": "paper", **options, **changes})

    @staticmethod
    def cpu(**changes: Any) -> FitConfig:
        """For two CPU cores: `FitConfig()`, with 2,000 field steps for the paper's method."""
        return FitConfig(**{"field": FieldConfig.cpu(), **changes})
