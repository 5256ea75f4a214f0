"""Train an ordinary 3DGS colour field of a scene, as a stage of a run folder, to carry labels to and to edit."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_range, check_whole
from .._files import check_output, read_json
from .._progress import Progress, as_progress
from .._typed import typed
from ..cameras import Camera, resize_map
from ..fields import ColorLoss, FieldConfig, FieldFit, GaussianParams, fit_field
from ..formats import write_splats
from ..gaussians import Gaussians
from ..scenes import Scene
from .points import with_points
from .stages import (
    Run,
    Stage,
    describe_lens,
    digest_pictures,
    digest_scene,
    digest_tensors,
    is_whole,
    stage_generator,
)
from .train import check_scene, field_stage, stage_params, training_device, with_extent


@dataclass(frozen=True)
class ColorConfig:
    """Options of `fit_color`; the defaults are those of 3DGS."""

    seed: int = 0
    """Every random choice follows from it."""
    split: str = "train"
    """The split of training views; "all" trains on all views."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 3: how colour changes with the direction of sight."""
    picture_scale: float = 1.0
    """Train with pictures at this fraction of their size, at most 1."""
    ssim_weight: float = 0.2
    """Lambda of 3DGS: the share of 1 - SSIM in the loss, the rest being L1."""
    max_points: int | None = None
    """Start from at most this many of the scene's points, drawn at random; None = all."""
    field: FieldConfig = default(default_factory=FieldConfig)

    def __post_init__(self) -> None:
        check_whole("seed", self.seed, -math.inf)
        check_whole("sh_degree", self.sh_degree, 0, 3)
        check_range("picture_scale", self.picture_scale, 0, 1, closed=(False, True))
        check_range("ssim_weight", self.ssim_weight, 0, 1)
        if self.max_points is not None:
            check_whole("max_points", self.max_points, 2)

    @staticmethod
    def paper() -> ColorConfig:
        """The schedule of 3DGS: 30,000 steps at full size; hours on a CPU."""
        return ColorConfig()

    @staticmethod
    def cpu() -> ColorConfig:
        """A schedule for two CPU cores, minutes for a room: the method of 3DGS, an eighth of its steps at three times its rates.

        The first half of the steps compares pictures of half the size, which takes half of the time; the others add the
        detail, with rates that fall to a tenth (without that, 1 dB less on room_0). Growing ends early, is limited, and
        has a higher threshold. Opacities are not reset: there are too few steps to recover.
        """
        schedule: dict[str, Any] = {"steps": 3_600, "coarse": ((1_800, 2),), "sh_degree_every": 720}
        schedule |= {"densify_from": 80, "densify_until": 1_800, "densify_every": 50, "densify_gradient": 3e-4}
        schedule |= {"means_lr": 5e-4, "means_lr_final": 5e-6, "quats_lr": 0.003, "scales_lr": 0.015}
        schedule |= {"sh0_lr": 0.008, "sh_rest_lr": 4e-4, "rates_final": 0.1}
        return ColorConfig(sh_degree=2, field=replace(_CPU_FIELD, **schedule))

    @staticmethod
    def geometry() -> ColorConfig:
        """A schedule for Gaussians to fuse features onto: two minutes on two CPU cores.

        Pictures stay at half size, so colours are soft, but positions and sizes of Gaussians are right within a few pixels
        of a teacher's map. (room_0: 100,000 Gaussians; `docs/results.md` compares the mIoU with the `cpu` schedule.)
        """
        schedule: dict[str, Any] = {
            "densify_from": 100,
            "densify_until": 1_200,
            "densify_every": 50,
            "sh_degree_every": 700,
        }
        field = replace(_CPU_FIELD, steps=2_000, coarse=((2_000, 2),), max_gaussians=100_000, **schedule)
        return ColorConfig(sh_degree=1, field=field)

    @staticmethod
    def quick() -> ColorConfig:
        """A schedule for a small scene: a minute on two CPU cores for the toy room (48 views of 192x256).

        It has many Gaussians for its few pixels, because small Gaussians reach less across the border of a removed object.
        """
        schedule: dict[str, Any] = {
            "densify_from": 80,
            "densify_until": 1_000,
            "densify_every": 50,
            "densify_gradient": 4e-4,
            "sh_degree_every": 320,
        }
        field = replace(_CPU_FIELD, steps=1_600, coarse=((400, 2),), max_gaussians=100_000, **schedule)
        return ColorConfig(sh_degree=1, field=field)


_CPU_FIELD = FieldConfig(
    steps=5_000,
    means_lr=3.2e-4,
    means_lr_final=3.2e-6,
    quats_lr=0.002,
    scales_lr=0.01,
    sh0_lr=0.005,
    sh_rest_lr=0.005 / 20,
    sh_degree_every=1_000,
    coarse=((3_000, 2),),
    densify_from=200,
    densify_until=2_500,
    densify_every=100,
    densify_gradient=4e-4,
    reset_every=0,
    max_gaussians=150_000,
    checkpoint_every=500,
)


@dataclass(frozen=True, eq=False)
class ColorResult:
    """A finished colour field."""

    gaussians: Gaussians
    path: Path
    """The 3DGS PLY file it was saved to."""
    stages: list[Stage]

    __repr__ = short_repr

    @property
    def seconds(self) -> float:
        """Training time, including earlier processes."""
        return sum(stage.seconds for stage in self.stages)


class Photos(Sequence[Tensor]):
    """The training pictures at their training size: read at the first access, then kept as bytes.

    A picture is [h, w, 3] float32 in [0, 1], or [h, w, 4] if it has transparent pixels: colours before black, and
    opacity. A pixel is NaN if it does not count wholly (masked, or at the border of an undistorted picture). Bytes take a
    quarter of the memory: 0.9 MB for 639x479.

    Args:
        scene: the scene.
        views: indices of its views.
        cameras: one per view, with the training size.
    """

    def __init__(self, scene: Scene, views: Sequence[int], cameras: Sequence[Camera]) -> None:
        self._scene, self._views, self._sizes = scene, list(views), [camera.size for camera in cameras]
        self._kept: dict[int, tuple[Tensor, Tensor | None]] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, 3 or 4], one picture at a time
        if i not in self._kept:
            self._kept[i] = self._read(i)
        bytes_, known = self._kept[i]
        picture = bytes_.float() / 255
        return picture if known is None else picture.masked_fill(~known[..., None], torch.nan)

    def _read(self, i: int) -> tuple[Tensor, Tensor | None]:  # [h, w, 3 or 4] uint8, [h, w] bool
        view, size = self._views[i], self._sizes[i]
        picture, known, alpha = self._scene.image(view), self._scene.mask(view), self._scene.alpha(view)
        if alpha is not None:
            picture = torch.cat([picture, alpha[..., None]], dim=2)
        inside = known.float()[..., None]
        picture = resize_map(picture, size, antialias=True)
        inside = resize_map(inside, size, antialias=True)[..., 0]
        bytes_ = (picture.clamp(0, 1) * 255).round().to(torch.uint8)
        return bytes_, None if bool(known.all()) else inside > 1 - 1e-4


@typed
def fit_color(
    scene: Scene,
    folder: str | Path,
    config: ColorConfig | None = None,
    *,
    report: Callable[[str], None] | None = None,
    progress: Progress = False,
    device: str | torch.device = "auto",
) -> ColorResult:
    """Fit an ordinary 3DGS colour field to a scene's pictures, or resume it in a run folder.

    Spherical harmonics up to `config.sh_degree`, L1 + D-SSIM, cloning, splitting and pruning as in 3DGS, on black. Masked
    pixels do not count; where a picture is transparent, the field becomes empty.

    Args:
        scene: posed, undistorted views with their sparse points; without points, some are triangulated first.
        folder: the run folder; `folder/color.ply` receives the Gaussians, in place of those of an earlier fit.
            Its stage stays in the folder, so the earlier call brings them back at once.
        config: the schedule; that of 3DGS when not given.
        report: receives one line per stage.
        progress: True shows a bar; a function receives the rows of the history as they appear.
        device: where to train, see `training_device`; the result lies on the CPU.

    Raises:
        ValueError: if a camera has distortion, there is no such device, the scene's points are out of sight, the
            split has no views, or another process works in `folder`.
    """
    config, progress = config or ColorConfig.paper(), as_progress(progress)
    check_scene(scene, scene.views(config.split))
    run, target = Run(check_output("folder", folder, "a folder"), report), training_device(device)
    with run.locked():
        scene = with_points(run, scene, scene.views(config.split), config.seed, progress)
        return make_color(run, scene, config, target, progress, overwrite=True)


def make_color(
    run: Run, scene: Scene, config: ColorConfig, device: torch.device, progress: Progress, *, overwrite: bool
) -> ColorResult:
    """The colour stage of a run, and the PLY file of its Gaussians.

    Args:
        overwrite: replace a `color.ply` that is there.
    """
    path = run.folder / "color.ply"
    params = _color_stage(run, scene, scene.views(config.split), config, device, progress)
    result = ColorResult(params.activated().detach(), path, run.stages)
    if overwrite or not os.path.lexists(path):
        write_splats(result.gaussians, path)
    return result


def find_color(run: Run, scene: Scene, config: ColorConfig) -> tuple[Gaussians, int] | None:
    """Gaussians and steps of the longest colour stage in the run, if it has this scene and more steps than `config`; else None.

    `kfgs color` makes such a stage in the same run folder.
    """
    views = scene.views(config.split)
    wanted = json.loads(json.dumps(_inputs(run, scene, views, config) | {"config": None}))
    best: tuple[int, Path] | None = None
    for about in _whole_stages(run):
        inputs = read_json(about)["inputs"]
        if inputs | {"config": None} != wanted:  # another scene, split or pictures
            continue
        steps = int(inputs["config"]["field"]["steps"])
        if best is None or steps > best[0]:
            best = steps, about.parent
    if best is None or best[0] <= config.field.steps:
        return None
    run.say(f"geometry: the colours of {best[0]:,} steps that are in {run.folder}")
    return stage_params(best[1]).activated().detach(), best[0]


def _whole_stages(run: Run) -> list[Path]:
    """The descriptions of the colour stages in the run that are not damaged."""
    found = sorted((run.folder / "stages").glob("color-*/stage.json"))
    return [about for about in found if is_whole(about.parent)]


def _inputs(run: Run, scene: Scene, views: Sequence[int], config: ColorConfig) -> dict[str, Any]:
    """What decides the colour stage."""
    options = asdict(config) | {"field": with_extent(config.field, scene).identity()}
    extent = options["field"].pop("extent")
    return {
        "pictures": digest_pictures(run, scene, views),
        "lenses": None if scene.lenses is None else [describe_lens(scene.lenses[i]) for i in views],
        "scene": digest_scene(scene, views),
        "colors": digest_tensors(scene.colors),
        "extent": extent,
        "config": options,
    }


def _color_stage(
    run: Run,
    scene: Scene,
    views: Sequence[int],
    config: ColorConfig,
    device: torch.device,
    progress: Progress,
) -> GaussianParams:
    """The stage's parameters."""
    inputs = _inputs(run, scene, views, config)

    def train(checkpoint: Path) -> FieldFit:
        generator = stage_generator(config.seed, "color")
        start = GaussianParams.from_points(
            scene.points,
            colors=scene.colors,
            sh_degree=config.sh_degree,
            max_points=config.max_points,
            generator=generator,
        )
        cameras = training_cameras(scene, views, config.picture_scale)
        return fit_field(
            start.map(lambda value: value.to(device)),
            cameras,
            Photos(scene, views, cameras),
            with_extent(config.field, scene),
            loss=ColorLoss(config.ssim_weight, config.field.engine),
            generator=generator,
            progress=progress,
            checkpoint=checkpoint,
        )

    return field_stage(run, "color", inputs, train)[0]


def training_cameras(scene: Scene, views: Sequence[int], scale: float) -> list[Camera]:
    """The cameras of these views, with pictures made smaller by `scale`."""
    cameras = [scene.cameras[i] for i in views]
    if scale == 1:
        return cameras
    return [camera.resized(*(max(1, round(n * scale)) for n in camera.size)) for camera in cameras]
