"""Carry features of 2-D maps to Gaussians without training: average in 3-D, correct, then compress.

Each Gaussian takes the mean of the pixels that show it, weighted by its rendering weight w = T alpha. Every rendered pixel
is a blend of Gaussians, so near a border the mean contains some of the neighbours. A few passes of the simultaneous iterative
reconstruction technique (SIRT, Gilbert 1972) remove that: render, compare with the maps, carry the difference back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import check_range, check_whole
from .._progress import as_bar
from .._rows import row_norms, unit_rows
from ..cameras import Camera
from ..formats.values import check_splats
from ..gaussians import Gaussians
from ..quant import FeatureMaps
from ..quant.linear import LinearLatents, fit_linear_latents
from .decoders import Linear
from .merge import FAINT, merge_gaussians
from .semantic_field import Seen, SemanticField
from .uplift_passes import average, correct, per_weight, some
from .working_maps import WorkingMaps, working_directions

SPARSE = 0.3  # share of the views' pixels: a splat of the scene fills nearly all of them


@dataclass(frozen=True)
class UpliftConfig:
    """Options of `uplift_maps`. The defaults keep every Gaussian; `UpliftConfig.field()` makes a small field."""

    max_gaussians: int | None = None
    """Prune and merge to at most this many (`merge_gaussians`). None keeps every Gaussian unchanged."""
    keep: float = 0.995
    """Share of the fused features' variation around their main direction that latents keep; it decides their number."""
    max_latents: int = 32
    """Most latents of a Gaussian."""
    corrections: int = 1
    """Passes of SIRT over all views; if there is any, one more follows after merging. A second pass helps a little for blurred
    maps, and harms as much for sharp and noisy ones."""
    pixels: int = 80_000
    """Most pixels of a working view. Views are rendered at the largest whole multiple of the map's size within it; larger maps
    are shrunk by a whole factor."""
    faint: float = FAINT
    """Before merging, the faintest Gaussians, which together fill this share of all pixels, are dropped (`merge_gaussians`)."""

    def __post_init__(self) -> None:
        if self.max_gaussians is not None:
            check_whole("max_gaussians", self.max_gaussians, 1)
        check_range("keep", self.keep, 0, 1, closed=(False, True))
        check_range("faint", self.faint, 0, 1, closed=(True, False))
        check_whole("max_latents", self.max_latents, 1)
        check_whole("corrections", self.corrections, 0)
        check_whole("pixels", self.pixels, 64)

    @staticmethod
    def field(**changes: Any) -> UpliftConfig:
        """At most 50,000 Gaussians; `changes` are other options. With 30,000, room_0 loses 0.2 to 0.5 mIoU, the toy room 1.3."""
        return UpliftConfig(**({"max_gaussians": 50_000} | changes))


def uplift_maps(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    maps: FeatureMaps,  # C maps [h, w, D]
    config: UpliftConfig | None = None,
    *,
    latents: LinearLatents | None = None,
    generator: torch.Generator | None = None,
    scratch: Path | None = None,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> SemanticField:
    """Average feature maps onto Gaussians by rendering weight, correct for blending, and keep few linear latents.

    Only the directions of features matter. No classes are used, so the result answers any text. Each map is read once for
    the average and, for at most 32 views, once before to find the working directions. Memory holds 2 x [N, 65] numbers; the
    maps in the working directions, at most 20 MB each, are in files.

    Args:
        gaussians: any cloud in the cameras' frame; its colours and features are not used.
        cameras: C posed cameras without distortion.
        maps: one per camera, covering its picture at any size; all-zero features mean "unknown".
        config: see `UpliftConfig`.
        latents: those of other fields (`sample_latents`), with which these shall agree; None: fitted to this scene.
        generator: draws the first centres of merging; None: seed 0.
        scratch: a folder for these files, used for these maps only; files of a killed process are used again. The caller
            deletes it. None: a temporary folder.
        progress: show a bar.
        report: called with a line per step.

    Returns:
        A field with a `Linear` decoder. Latents are all-zero where no view shows the Gaussian. `seen.agreement` of merged
        Gaussians is the mean over their members.

    Raises:
        TypeError: if `progress` is a function: there are no rows to call it with.
        ValueError: if counts or shapes disagree, `write_splats` would refuse the Gaussians, a map is not finite, no map has
            features, or no view shows any Gaussian.

    Note:
        To continue by training, start `fit_field` with `GaussianParams.from_gaussians(field.gaussians)` and the maps
        `field.decoder.latents.encode(unit features)`.
    """
    config, progress, count = config or UpliftConfig(), as_bar(progress), len(cameras)
    say = report if report is not None else lambda text: None
    if count == 0 or count != len(maps):
        raise ValueError(
            f"maps: expected one per camera ({count}, at least one), got {len(maps)}; pass the views that have maps"
        )
    if len(gaussians) == 0:
        raise ValueError("gaussians: expected at least one, got none; there is nothing to carry features to")
    cloud = gaussians.replace(sh=None, features=None, labels=None, scores=None, names=(), extra={}).detach()
    check_splats(cloud)
    cloud = cloud.to(torch.promote_types(cloud.means.dtype, torch.float32))
    passes = 1 + config.corrections + (config.max_gaussians is not None and config.corrections > 0)
    with torch.no_grad(), tqdm(total=count * passes, desc="uplift", unit="view", disable=not progress) as bar:
        directions = (working_directions(maps) if latents is None else latents.basis).to(cloud.means)
        with WorkingMaps(cameras, maps, directions, config.pixels, scratch) as views:
            sums, shown = average(cloud, views, bar)
            if not bool((shown > 0).any()):
                raise ValueError(
                    "cameras: expected views that show the Gaussians, got none that does; do both share one frame?"
                )
            filled = float(shown.sum()) / sum(camera.width * camera.height for camera in cameras)
            if filled < SPARSE:
                say(f"note: the Gaussians fill {filled:.0%} of the views; are they in the cameras' frame?")
            means = per_weight(sums.sum(0))
            agreement = row_norms(means).clamp_max(1)
            if latents is None:
                options: dict[str, Any] = {"keep": config.keep, "maximum": config.max_latents}
                fitted = fit_linear_latents(unit_rows(means), _capped(shown), **options).basis
                views.project(fitted)
                sums = torch.cat([sums[..., :-1] @ fitted, sums[..., -1:]], dim=-1)
                latents = LinearLatents((directions.double() @ fitted.double()).to(directions))
            say(f"fused {count} maps of {latents.dim} channels as {latents.latent} latents")
            for _ in range(config.corrections):
                sums = correct(cloud, sums, views, bar)
            if config.max_gaussians is not None:
                cloud = cloud.replace(features=per_weight(sums.sum(0)))
                merged = merge_gaussians(cloud, shown, config.max_gaussians, faint=config.faint, generator=generator)
                say(f"{len(merged.gaussians)} of {len(cloud)} Gaussians left")
                agreement = merged.pool(agreement * shown) / some(merged.weights)
                cloud, shown, sums = merged.gaussians, merged.weights, torch.stack([merged.pool(half) for half in sums])
                if config.corrections:
                    sums = correct(cloud, sums, views, bar)
    fused = cloud.replace(features=per_weight(sums.sum(0)))
    return SemanticField(fused, Linear(latents), tuple(cameras), seen=Seen(shown, agreement))


def sample_latents(maps: FeatureMaps, *, count: int = 32, views: int = 256) -> LinearLatents:
    """Latents for several fields of one teacher: the main directions of features that are sampled from their maps.

    Args:
        maps: of all scenes together, or of all parts of a scene.
        count: of the latents; fewer if features have fewer channels.
        views: most maps that are read, evenly chosen.

    Raises:
        ValueError: if a map is not finite, or all are zero.
    """
    return LinearLatents(working_directions(maps, count, views))


def _capped(weights: Tensor) -> Tensor:
    """Weights capped at their 0.99 quantile, so that a few wall-sized Gaussians do not decide all latents."""
    sample = weights[weights > 0]
    sample = sample[:: max(1, len(sample) // 100_000)]
    return weights.clamp_max(torch.quantile(sample, 0.99))
