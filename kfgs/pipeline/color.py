"""Train an ordinary 3DGS colour field of a scene, as a stage of a run folder, to carry labels to and to edit."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._check import Progress, as_progress, check_range, check_whole
from .._files import check_output, locked
from ..cameras import Camera, resize_map
from ..fields import ColorLoss, Densify, Rates, Training, fit_field, gaussians_from_points
from ..fields.train import digest_tensors
from ..formats import write_splats
from ..gaussians import Gaussians
from ..scenes import Scene
from .stages import LOCK, Run, digest_pictures, digest_scene
from .train import field_stage, stage_gaussians, training_views, with_extent, with_points


@dataclass(frozen=True)
class ColorConfig:
    """Options of `fit_color`; the defaults are those of 3DGS: 30,000 steps at full size, hours on a CPU."""

    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 3: how colour changes with the direction of sight."""
    picture_scale: float = 1.0
    """Train with pictures at this fraction of their size, at most 1."""
    ssim_weight: float = 0.2
    """Lambda of 3DGS: the share of 1 - SSIM in the loss, the rest being L1."""
    training: Training = field(default_factory=Training)

    def __post_init__(self) -> None:
        check_whole("sh_degree", self.sh_degree, 0, 3)
        check_range("picture_scale", self.picture_scale, 0, 1, closed=(False, True))
        check_range("ssim_weight", self.ssim_weight, 0, 1)

    @staticmethod
    def cpu() -> ColorConfig:
        """A schedule for two CPU cores, minutes for a room: the method of 3DGS, an eighth of its steps at three times its rates.

        The first half of the steps compares pictures of half the size, which takes half of the time; in the others the rates
        fall to a tenth (without that, 1 dB less on room_0). Opacities are not reset: there are too few steps to recover.
        """
        rates = Rates(5e-4, 5e-6, quats=0.003, scales=0.015, sh0=0.008, sh_rest=4e-4, final=0.1)
        densify = Densify(80, 1_800, 50, 3e-4, reset_every=0, maximum=150_000)
        training = Training(3_600, rates, densify, half_until=1_800, sh_degree_every=720, checkpoint_every=500)
        return ColorConfig(sh_degree=2, training=training)

    @staticmethod
    def geometry() -> ColorConfig:
        """A schedule for Gaussians to fuse features onto: two minutes on two CPU cores.

        Pictures stay at half size, so colours are soft, but positions and sizes of Gaussians are right within a few pixels
        of a teacher's map.
        """
        densify = Densify(100, 1_200, 50, 4e-4, reset_every=0, maximum=100_000)
        training = Training(2_000, _RATES, densify, half_until=2_000, sh_degree_every=700, checkpoint_every=500)
        return ColorConfig(sh_degree=1, training=training)

    @staticmethod
    def quick() -> ColorConfig:
        """A schedule for a small scene: a minute on two CPU cores for the toy room (48 views of 192x256).

        It has many Gaussians for its few pixels, because small Gaussians reach less across the border of a removed object.
        """
        densify = Densify(80, 1_000, 50, 4e-4, reset_every=0, maximum=100_000)
        training = Training(1_600, _RATES, densify, half_until=400, sh_degree_every=320, checkpoint_every=500)
        return ColorConfig(sh_degree=1, training=training)


_RATES = Rates(3.2e-4, 3.2e-6, quats=0.002, scales=0.01, sh0=0.005, sh_rest=0.005 / 20)


class TrainingPictures(Sequence[Tensor]):
    """The pictures of some views at the sizes of their cameras: read at the first access, then kept as bytes.

    A picture is [h, w, 3] float32 in [0, 1], or [h, w, 4] if it has transparent pixels: colours before black, and
    opacity. A pixel is NaN if it does not count wholly (masked, or at the border of an undistorted picture). Bytes take a
    quarter of the memory: 0.9 MB for 639x479.
    """

    def __init__(self, scene: Scene, views: Sequence[int], cameras: Sequence[Camera]) -> None:
        self._scene, self._views, self._sizes = scene, list(views), [camera.size for camera in cameras]
        self._kept: dict[int, tuple[Tensor, Tensor | None]] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, 3 or 4], one picture at a time
        if i not in self._kept:
            view, size = self._views[i], self._sizes[i]
            picture, known, alpha = self._scene.image(view), self._scene.mask(view), self._scene.alpha(view)
            if alpha is not None:
                picture = torch.cat([picture, alpha[..., None]], dim=2)
            bytes_ = (resize_map(picture, size, antialias=True).clamp(0, 1) * 255).round().to(torch.uint8)
            inside = resize_map(known.float()[..., None], size, antialias=True)[..., 0]
            self._kept[i] = bytes_, None if bool(known.all()) else inside > 1 - 1e-4
        bytes_, counts = self._kept[i]
        picture = bytes_.float() / 255
        return picture if counts is None else picture.masked_fill(~counts[..., None], torch.nan)


def fit_color(
    scene: Scene,
    folder: str | Path,
    config: ColorConfig | None = None,
    *,
    split: str = "train",
    seed: int = 0,
    report: Callable[[str], None] | None = None,
    progress: Progress = False,
) -> Gaussians:
    """Fit an ordinary 3DGS colour field to a scene's pictures, or resume it in a run folder.

    Spherical harmonics up to `config.sh_degree`, L1 + D-SSIM, cloning, splitting and pruning as in 3DGS, on black. Masked
    pixels do not count; where a picture is transparent, the field becomes empty.

    Args:
        scene: posed, undistorted views with their sparse points; without points, some are triangulated first.
        folder: the run folder; `folder/color.ply` receives the Gaussians, in place of those of an earlier fit. Its stage
            stays in the folder, so the earlier call brings them back at once.
        config: the schedule; None: that of 3DGS.
        split: the training views; "all" trains on all views.
        seed: every random choice follows from it.
        report: receives one line per stage.
        progress: True shows a bar; a function receives the rows of the history as they appear.

    Returns:
        The Gaussians, on the CPU. Training takes place on the GPU if there is one.

    Raises:
        ValueError: if a camera has distortion, the scene's points are out of sight, the split has no views, or another
            process works in `folder`.
    """
    config = config or ColorConfig()
    views = training_views(scene, split)
    run = Run(check_output("folder", folder, "a folder"), report, seed, as_progress(progress))
    with locked(run.folder, LOCK):
        gaussians = color_stage(run, with_points(run, scene, views), views, config)
        write_splats(gaussians, run.folder / "color.ply")
    return gaussians


def color_stage(run: Run, scene: Scene, views: Sequence[int], config: ColorConfig) -> Gaussians:
    """The Gaussians of a colour field, as a stage of a run."""
    cameras = [scene.cameras[i] for i in views]
    if config.picture_scale != 1:
        sizes = [[max(1, round(n * config.picture_scale)) for n in camera.size] for camera in cameras]
        cameras = [camera.resized(*size) for camera, size in zip(cameras, sizes, strict=True)]
    start = partial(gaussians_from_points, scene.points, colors=scene.colors, sh_degree=config.sh_degree)
    pictures, loss = TrainingPictures(scene, views, cameras), ColorLoss(config.ssim_weight)
    training = with_extent(config.training, scene)
    train = partial(fit_field, cameras=cameras, targets=pictures, training=training, loss=loss)
    return stage_gaussians(field_stage(run, "color", _inputs(run, scene, views, config), start, train))


def find_color(run: Run, scene: Scene, views: Sequence[int], config: ColorConfig) -> tuple[Gaussians, int] | None:
    """Gaussians and steps of the longest colour stage of this scene in the run, if it has more steps than `config`."""
    free: dict[str, None] = {"config": None, "seed": None}
    wanted = json.loads(json.dumps(_inputs(run, scene, views, config) | free))
    alike = [stage for stage in run.finished("color") if stage.inputs | free == wanted]
    fitting = {int(stage.inputs["config"]["training"]["steps"]): stage for stage in alike}
    steps = max(fitting, default=0)
    if steps <= config.training.steps:
        return None
    run.say(f"geometry: the colours of {steps:,} steps that are in {run.folder}")
    return stage_gaussians(fitting[steps]), steps


def _inputs(run: Run, scene: Scene, views: Sequence[int], config: ColorConfig) -> dict[str, Any]:
    """What decides the colour stage."""
    training = asdict(with_extent(config.training, scene))
    extent = training.pop("extent")
    return {
        "pictures": digest_pictures(run, scene, views),
        "scene": digest_scene(scene, views),
        "colors": digest_tensors(scene.colors),
        "extent": extent,
        "seed": run.seed,
        "config": asdict(config) | {"training": training},
    }
