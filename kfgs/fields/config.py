"""The options for training a field of Gaussians; the defaults are the published values."""

from __future__ import annotations

import math
import numbers
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from .._check import check_choice, check_range

_POSITIVE = (False, False)


@dataclass(frozen=True)
class FieldConfig:
    """Options of `fit_field`. The defaults are those of the paper (Sec. 4.1) and of 3DGS, which it builds on.

    Steps are counted from 1. `fit_field` densifies at step s when `densify_from < s < densify_until` and s is a multiple
    of `densify_every`, and resets opacities when `s < densify_until` and s is a multiple of `reset_every`.
    """

    steps: int = 30_000
    """Optimisation steps, `views_per_step` views each."""
    views_per_step: int = 1
    """Views whose gradients are averaged in a step. Several processes (`kfgs.pipeline.together`) share them, so set it to a
    multiple of their number; the result does not depend on that number."""
    extent: float | None = None
    """Size of the scene in world units; it scales the means' learning rate and what counts as a large Gaussian. None computes
    it: `fit` and `fit_color` take `Scene.extent`, `fit_field` the same formula for its own cameras."""
    means_lr: float = 1.6e-4
    """Learning rate of the means at step 0, in units of the scene extent."""
    means_lr_final: float = 1.6e-6
    """Learning rate of the means at the last step; exponential in between."""
    quats_lr: float = 0.001
    scales_lr: float = 0.005
    """Learning rate of the log-scales."""
    opacities_lr: float = 0.05
    """Learning rate of the opacity logits."""
    features_lr: float = 0.005
    sh0_lr: float = 0.0025
    """Learning rate of the colours (coefficients of degree 0)."""
    sh_rest_lr: float = 0.0025 / 20
    """Learning rate of the higher harmonics."""
    rates_final: float = 1.0
    """Factor on all other rates at the last step. They fall exponentially from the middle of the steps on; 1: constant, as in
    3DGS. Short schedules with high rates need it."""
    sh_degree_every: int = 1_000
    """Raise the SH degree by one every so many steps, starting at the degree that the input uses: 0 for points, its degree for
    a loaded splat. 0 = all degrees from the start."""
    coarse: tuple[tuple[int, int], ...] = ()
    """Pairs (last step, divisor): up to this step pictures are compared at size // divisor, where a pixel is the mean of
    divisor x divisor ones. After the last pair (or if empty) they have full size. A divisor is at most a picture's smaller
    side. Only for targets of the cameras' size."""
    adam_eps: float = 1e-15
    """Adam's epsilon: tiny, because gradients of a mean over all pixels are tiny."""
    render_scale: float | None = None
    """None renders at the camera's size (the paper). A number renders at this multiple of the target map's size, never
    larger than the camera's; the resize of Eq. 4 follows either way."""
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    densify_gradient: float = 2e-4
    """A Gaussian is cloned or split if the mean norm of its screen-space gradient, in NDC units, is at least this."""
    densify_gradient_size: Literal["render", "target"] = "render"
    """The map whose half-size converts pixel gradients to NDC: the rendered map (correct), or the target map as in the
    released script (a stricter threshold: 1.33 times at 639x479 against 480x360)."""
    percent_dense: float = 0.01
    """Gaussians up to this fraction of the scene extent are cloned, larger ones are split."""
    prune_opacity: float = 0.005
    """Gaussians below this opacity are dropped when densifying."""
    prune_extent: float = 0.1
    """Gaussians whose largest scale exceeds this fraction of the extent are dropped, once opacities were reset."""
    reset_every: int = 3_000
    """Steps between opacity resets; 0 = never (nor is anything pruned by size then)."""
    reset_opacity: float = 0.01
    """A reset lowers opacities to at most this value."""
    max_gaussians: int | None = None
    """The most Gaussians after densifying; those with the strongest gradients grow first. None = no limit."""
    engine: str = "auto"
    """Compositing engine, as `kfgs.splat.rasterize` takes it."""
    report_every: int = 50
    """Steps between entries of the history (and calls of a `progress` function)."""
    checkpoint_every: int = 1_000
    """Steps between checkpoints, when `fit_field` is given a file for them."""

    def __post_init__(self) -> None:
        for name in ("steps", "views_per_step", "densify_every", "report_every", "checkpoint_every"):
            _check_count(name, getattr(self, name), 1)
        for name in ("densify_from", "densify_until", "reset_every", "sh_degree_every"):
            _check_count(name, getattr(self, name), 0)
        if self.max_gaussians is not None:
            _check_count("max_gaussians", self.max_gaussians, 1)
        if self.extent is not None:
            if not isinstance(self.extent, numbers.Real) or isinstance(self.extent, bool):
                raise TypeError(
                    f"extent: expected a number in world units, got {self.extent!r:.60}; pass a float, or None"
                )
            check_range("extent", self.extent, 0, closed=_POSITIVE)
        for name in ("means_lr", "means_lr_final", "adam_eps", "rates_final"):
            check_range(name, getattr(self, name), 0, closed=_POSITIVE)
        rates = ("quats_lr", "scales_lr", "opacities_lr", "features_lr", "sh0_lr", "sh_rest_lr")
        for name in (*rates, "densify_gradient", "percent_dense"):
            check_range(name, getattr(self, name), 0, closed=(True, False))
        check_range("prune_extent", self.prune_extent, 0, closed=_POSITIVE)
        check_range("prune_opacity", self.prune_opacity, 0, 1, closed=(True, False))
        check_range("reset_opacity", self.reset_opacity, 0, 1, closed=_POSITIVE)
        check_choice("densify_gradient_size", self.densify_gradient_size, ("render", "target"))
        if self.render_scale is not None:
            check_range("render_scale", self.render_scale, 0, closed=_POSITIVE)
        object.__setattr__(self, "coarse", tuple(map(tuple, self.coarse)))  # JSON gives lists
        _check_coarse(self.coarse)
        if self.coarse and self.render_scale is not None:
            raise ValueError(
                f"coarse: expected () with render_scale = {self.render_scale}, got {self.coarse}; use one of the two"
            )

    def identity(self) -> dict[str, Any]:
        """The options as JSON, to tell fits apart. `views_per_step` counts if it is not 1: older fits did not have it."""
        options = asdict(self)
        if self.views_per_step == 1:
            del options["views_per_step"]
        return options

    def divisor(self, step: int) -> int:
        """The divisor of picture sizes at a step (`coarse`)."""
        return next((divisor for last, divisor in self.coarse if step <= last), 1)

    def sh_degree(self, step: int, start: int = 0) -> int:
        """The highest SH degree used at a step; `start` is the degree used at the start."""
        return start + step // self.sh_degree_every if self.sh_degree_every else 3

    @classmethod
    def paper(cls, **changes: Any) -> FieldConfig:
        """The published values (the same as `FieldConfig()`), with the given changes."""
        return cls(**changes)

    @classmethod
    def cpu(cls, **changes: Any) -> FieldConfig:
        """A short run for a CPU: a fifteenth of the steps, a schedule compressed to match, and faster learning rates.

        The rates are higher because few steps must bring features from 0 to their values and Gaussians to their places.
        Maps are rendered at twice the target's size: a field trained at the target's size looks worse if rendered larger.
        The threshold for growing is higher than the paper's, because few small views are overfitted soon. Opacities are
        not reset: there are too few steps to recover. (Toy room, 24 views of 48x64, ideal labels, 1,000 steps: test mIoU
        0.77 at scale 1 and 2e-4, 0.79 at 1 and 6e-4, 0.89 at 2 and 6e-4.)
        """
        preset = cls(
            steps=2_000,
            means_lr=4e-4,
            means_lr_final=4e-6,
            quats_lr=0.002,
            scales_lr=0.01,
            features_lr=0.01,
            render_scale=2.0,
            densify_from=100,
            densify_until=1_000,
            densify_every=50,
            densify_gradient=8e-4,
            reset_every=0,
            max_gaussians=60_000,
            report_every=20,
            checkpoint_every=500,
        )
        return replace(preset, **changes)

    def with_steps(self, steps: int) -> FieldConfig:
        """The same schedule stretched or compressed to another number of steps; `densify_every` stays.

        If pairs of `coarse` then end at the same step, the last one is kept.
        """
        ratio = steps / self.steps
        names = ("densify_from", "densify_until", "reset_every", "sh_degree_every")
        coarse = tuple({max(1, round(last * ratio)): divisor for last, divisor in self.coarse}.items())
        scaled: dict[str, Any] = {name: round(getattr(self, name) * ratio) for name in names}
        return replace(self, steps=steps, coarse=coarse, **scaled)


def check_extent(extent: float) -> float:
    """Return the extent computed for a scene; a ValueError if it is 0 or not finite."""
    if not (math.isfinite(extent) and extent > 0):
        raise ValueError(
            f"cameras: expected views that tell the size of the scene, got an extent of {extent}; pass its size with "
            "FieldConfig(extent=...)"
        )
    return extent


def _check_count(name: str, value: object, low: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{name}: expected a whole number of at least {low}, got {value!r}")


def _check_coarse(coarse: tuple[tuple[int, int], ...]) -> None:
    for pair in coarse:
        if len(pair) != 2:
            raise ValueError(f"coarse: expected pairs (last step, divisor), got {pair!r}; give two whole numbers each")
        _check_count("coarse: last step", pair[0], 1)
        _check_count("coarse: divisor", pair[1], 1)
    lasts = [last for last, _ in coarse]
    if lasts != sorted(set(lasts)):
        raise ValueError(f"coarse: expected pairs in increasing order of their last step, got {coarse}; sort them")
