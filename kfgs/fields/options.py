"""Options for training a field of Gaussians; the defaults are the published values."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from .._check import check_range, check_whole


@dataclass(frozen=True)
class Rates:
    """Learning rates of Adam (3DGS, and Sec. 4.1 for the features)."""

    means: float = 1.6e-4
    """At step 0, in units of the scene's extent."""
    means_final: float = 1.6e-6
    """At the last step; exponential in between."""
    quats: float = 0.001
    scales: float = 0.005
    """Of the log-scales."""
    opacities: float = 0.05
    """Of the opacity logits."""
    features: float = 0.005
    sh0: float = 0.0025
    """Of the colours (coefficients of degree 0)."""
    sh_rest: float = 0.0025 / 20
    """Of the higher harmonics."""
    final: float = 1.0
    """Factor on all other rates at the last step. They fall exponentially from the middle of the steps on; 1: constant, as in
    3DGS. Short schedules with high rates need it."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(name, value, 0, closed=(name not in ("means", "means_final", "final"), False))


@dataclass(frozen=True)
class Densify:
    """Adaptive density control of 3DGS, at steps between `start` and `stop` (exclusive, counted from 1)."""

    start: int = 500
    stop: int = 15_000
    every: int = 100
    gradient: float = 2e-4
    """A Gaussian is cloned or split if the mean norm of its screen-space gradient, in NDC units, is at least this."""
    percent_dense: float = 0.01
    """Gaussians up to this fraction of the scene's extent are cloned, larger ones are split."""
    prune_opacity: float = 0.005
    """Gaussians below this opacity are dropped."""
    prune_extent: float = 0.1
    """Gaussians whose largest scale exceeds this fraction of the extent are dropped, once opacities were reset."""
    reset_every: int = 3_000
    """Steps between resets of all opacities to at most 0.01, before `stop`; 0 = never (nor is anything pruned by size then)."""
    maximum: int | None = None
    """The most Gaussians; those with the strongest gradients grow first. None = no limit."""

    def __post_init__(self) -> None:
        for name, least in {"start": 0, "stop": 0, "reset_every": 0, "every": 1}.items():
            check_whole(name, getattr(self, name), least)
        check_whole("maximum", 1 if self.maximum is None else self.maximum, 1)
        check_range("gradient", self.gradient, 0)
        check_range("percent_dense", self.percent_dense, 0)
        check_range("prune_extent", self.prune_extent, 0, closed=(False, False))
        check_range("prune_opacity", self.prune_opacity, 0, 1, closed=(True, False))


@dataclass(frozen=True)
class Training:
    """Options of `fit_field`. The defaults are those of the paper (Sec. 4.1) and of 3DGS, which it builds on."""

    steps: int = 30_000
    """Optimisation steps, one view each."""
    rates: Rates = field(default_factory=Rates)
    densify: Densify | None = field(default_factory=Densify)
    """None: the number of Gaussians stays."""
    extent: float | None = None
    """Size of the scene in world units; it scales the means' learning rate and what counts as a large Gaussian. None computes
    it: a fit of a scene takes `Scene.extent`, `fit_field` the same formula for its own cameras."""
    half_until: int = 0
    """Up to this step pictures are compared at half size, where a pixel is the mean of 2 x 2. Only for targets of the cameras'
    size."""
    render_scale: float | None = None
    """None renders at the camera's size (the paper). A number renders at this multiple of the target map's size, never
    larger than the camera's; the resize of Eq. 4 follows either way."""
    sh_degree_every: int = 1_000
    """Raise the SH degree by one every N steps, starting at the degree that the input uses: 0 for points, its degree for
    a loaded splat. 0 = all degrees from the start."""
    engine: str = "auto"
    """Compositing engine, as `kfgs.splat.rasterize` takes it."""
    report_every: int = 50
    """Steps between entries of the history (and calls of a `progress` function)."""
    checkpoint_every: int = 1_000
    """Steps between checkpoints, when `fit_field` is given a file for them."""

    def __post_init__(self) -> None:
        least = {"steps": 1, "report_every": 1, "checkpoint_every": 1, "half_until": 0, "sh_degree_every": 0}
        for name, low in least.items():
            check_whole(name, getattr(self, name), low)
        for name in ("extent", "render_scale"):
            check_range(name, 1.0 if getattr(self, name) is None else getattr(self, name), 0, closed=(False, False))
        if self.half_until and self.render_scale is not None:
            raise ValueError(
                f"half_until: expected 0 with render_scale = {self.render_scale}, got {self.half_until}; use one of the two"
            )

    @staticmethod
    def cpu() -> Training:
        """A short run for a CPU: a fifteenth of the steps, a schedule compressed to match, and faster learning rates.

        Few steps must bring features from 0 to their values. Maps are rendered at twice the target's size: a field trained at
        the target's size looks worse if rendered larger. The threshold for growing is higher than the paper's, because few small
        views are overfitted soon. Opacities are not reset: there are too few steps to recover. (Toy room, 1,000 steps: test mIoU
        0.77 at scale 1 and gradient 2e-4, 0.79 at 1 and 6e-4, 0.89 at 2 and 6e-4.)
        """
        return Training(
            steps=2_000,
            rates=Rates(means=4e-4, means_final=4e-6, quats=0.002, scales=0.01, features=0.01),
            densify=Densify(start=100, stop=1_000, every=50, gradient=8e-4, reset_every=0, maximum=60_000),
            render_scale=2.0,
            report_every=20,
            checkpoint_every=500,
        )

    def with_steps(self, steps: int) -> Training:
        """The same schedule stretched or compressed to another number of steps; `densify.every` stays."""
        ratio = steps / self.steps

        def stretched(options: Any, *names: str) -> Any:
            return options and replace(options, **{name: round(getattr(options, name) * ratio) for name in names})

        densify = stretched(self.densify, "start", "stop", "reset_every")
        return replace(stretched(self, "half_until", "sh_degree_every"), steps=steps, densify=densify)

    def with_maximum(self, count: int | None) -> Training:
        """The same with at most `count` Gaussians; 0 is no limit, None changes nothing."""
        if count is None or self.densify is None:
            return self
        return replace(self, densify=replace(self.densify, maximum=count or None))


def check_extent(extent: float) -> float:
    """Return the extent computed for a scene; a ValueError if it is 0 or not finite."""
    if not (math.isfinite(extent) and extent > 0):
        raise ValueError(
            f"cameras: expected views that tell the size of the scene, got an extent of {extent}; pass its size with "
            "Training(extent=...)"
        )
    return extent
