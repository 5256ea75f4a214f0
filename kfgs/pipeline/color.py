"""An ordinary 3DGS colour field of a scene, as a stage of a run folder: what labels are carried to, and what is edited."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from .._check import check_range, check_whole
from .._files import write_json
from ..cameras import Camera, resize_map
from ..fields import ColorLoss, FieldConfig, GaussianParams, fit_field
from ..formats import read_splats, write_splats
from ..gaussians import Gaussians
from ..scenes import Scene
from .fit import _generator, _scene_digest, _tensor_digest
from .stages import Run, Stage


@dataclass(frozen=True)
class ColorConfig:
    """How a colour field is trained; the defaults are those of 3DGS."""

    seed: int = 0
    """Every random choice follows from it."""
    split: str = "train"
    """Which views of the scene are learnt from."""
    sh_degree: int = 3
    """Highest degree of the spherical harmonics, 0 to 3: how colour changes with the direction of sight."""
    picture_scale: float = 1.0
    """Pictures are learnt at this fraction of their size, at most 1."""
    ssim_weight: float = 0.2
    """Lambda of 3DGS: the share of 1 - SSIM in the loss, the rest being L1."""
    max_points: int | None = None
    """Start from at most this many of the scene's points, drawn at random; None = all."""
    field: FieldConfig = default(default_factory=FieldConfig)

    def __post_init__(self) -> None:
        check_whole("sh_degree", self.sh_degree, 0, 3)
        check_range("picture_scale", self.picture_scale, 0, 1, closed=(False, True))
        check_range("ssim_weight", self.ssim_weight, 0, 1)
        if self.max_points is not None:
            check_whole("max_points", self.max_points, 2)

    @staticmethod
    def paper() -> ColorConfig:
        """The schedule of 3DGS: 30,000 steps at full size. For a workstation with a GPU."""
        return ColorConfig()

    @staticmethod
    def cpu() -> ColorConfig:
        """A schedule for two CPU cores, minutes for a room: the method of 3DGS, a tenth of its steps at twice its rates.

        Most steps compare pictures of half the size, which takes a quarter of the time; the last ones bring the detail.
        Growing is over early, bounded, and asks for a higher threshold; opacities are not reset, since there are too few
        steps to recover.
        """
        return ColorConfig(sh_degree=2, field=_CPU_FIELD)

    @staticmethod
    def quick() -> ColorConfig:
        """A minute on two CPU cores for a small scene, such as the toy room (48 views of 192x256)."""
        field = replace(_CPU_FIELD.with_steps(1_200), densify_every=50, coarse=((600, 2),), max_gaussians=40_000)
        return ColorConfig(sh_degree=1, field=field)


_CPU_FIELD = FieldConfig(
    steps=3_000,
    means_lr=3.2e-4,
    means_lr_final=3.2e-6,
    quats_lr=0.002,
    scales_lr=0.01,
    sh0_lr=0.005,
    sh_rest_lr=0.005 / 20,
    sh_degree_every=800,
    coarse=((2_000, 2),),
    densify_from=200,
    densify_until=2_000,
    densify_every=100,
    densify_gradient=4e-4,
    reset_every=0,
    max_gaussians=120_000,
    checkpoint_every=500,
)


@dataclass(frozen=True, eq=False)
class ColorResult:
    """A finished colour field."""

    gaussians: Gaussians
    path: Path
    """The 3DGS PLY file it was saved to."""
    stages: list[Stage]

    @property
    def seconds(self) -> float:
        """Time spent on it, also by earlier processes."""
        return sum(stage.seconds for stage in self.stages)


class Pictures(Sequence[Tensor]):
    """The training pictures at their training size: read when first asked for, then kept as bytes.

    A picture is [h, w, 3] float32 in [0, 1], NaN where nothing was recorded (the border of an undistorted one).
    """

    def __init__(self, scene: Scene, views: Sequence[int], cameras: Sequence[Camera]) -> None:
        self._scene, self._views, self._sizes = scene, list(views), [camera.size for camera in cameras]
        self._kept: dict[int, tuple[Tensor, Tensor | None]] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, i: int) -> Tensor:  # type: ignore[override]  # [h, w, 3], one picture at a time
        if i not in self._kept:
            self._kept[i] = self._read(i)
        bytes_, known = self._kept[i]
        picture = bytes_.float() / 255
        return picture if known is None else picture.masked_fill(~known[..., None], torch.nan)

    def _read(self, i: int) -> tuple[Tensor, Tensor | None]:  # [h, w, 3] uint8, [h, w] bool
        view, size = self._views[i], self._sizes[i]
        picture, known = self._scene.image(view), self._scene.mask(view)
        inside = known.float()[..., None]
        picture = resize_map(picture, size, antialias=True)
        inside = resize_map(inside, size, antialias=True)[..., 0]
        bytes_ = (picture.clamp(0, 1) * 255).round().to(torch.uint8)
        return bytes_, None if bool(known.all()) else inside > 1 - 1e-4


def fit_color(
    scene: Scene,
    folder: str | Path,
    config: ColorConfig | None = None,
    *,
    report: Callable[[str], None] | None = None,
    progress: bool = False,
    callback: Callable[[dict[str, Any]], None] | None = None,
) -> ColorResult:
    """Fit an ordinary 3DGS colour field to a scene's pictures, resuming what a run folder already holds.

    Spherical harmonics up to `config.sh_degree`, L1 + D-SSIM, cloning, splitting and pruning as 3DGS does, on black.

    Args:
        scene: posed, undistorted views with their sparse points.
        folder: the run folder; `folder/color.ply` receives the Gaussians.
        config: the schedule; that of 3DGS when not given.
        report: receives one line per stage.
        progress: show a bar.
        callback: receives the rows of the history as they appear.

    Raises:
        ValueError: if a camera has distortion, the scene has no points to start from, or no view is in the split.
    """
    config = config or ColorConfig.paper()
    views = scene.views(config.split)
    _check_scene(scene)
    cameras = [_training_camera(scene.cameras[i], config.picture_scale) for i in views]
    run = Run(Path(folder), report)
    inputs = {
        "pictures": run.digests([scene.image_paths[i] for i in views]),
        "lenses": None if scene.lenses is None else [_describe_lens(scene.lenses[i]) for i in views],
        "scene": _scene_digest(scene, views),
        "colors": _tensor_digest(scene.colors),
        "extent": float(scene.extent),
        "config": asdict(config),
    }
    stage = run.stage(
        "color",
        inputs,
        lambda made: _make(
            made, scene, views, cameras, config, run, inputs, {"progress": progress, "callback": callback}
        ),
    )
    run.scratch("color", inputs).unlink(missing_ok=True)
    params = GaussianParams.from_tensors(load_file(stage.folder / "params.safetensors"))
    result = ColorResult(params.activated().detach(), Path(folder) / "color.ply", run.stages)
    if not _is_saved(result):
        write_splats(result.path, result.gaussians)
    return result


def _is_saved(result: ColorResult) -> bool:
    """Whether this very cloud lies there already; a file that has since been given labels is left as it is."""
    try:
        saved = read_splats(result.path).gaussians
    except (OSError, ValueError):
        return False
    assert result.gaussians.sh is not None
    exact = saved.sh is not None and len(saved) == len(result.gaussians) and torch.equal(saved.sh, result.gaussians.sh)
    return exact and all(
        torch.equal(getattr(saved, name), getattr(result.gaussians, name)) for name in ("means", "quats")
    )


def _check_scene(scene: Scene) -> None:
    if scene.distorted:
        raise ValueError("scene: expected cameras without distortion, got a lens; pass scene.undistorted()")
    if len(scene.points) < 2:
        raise ValueError(
            f"scene: expected sparse points to start from, got {len(scene.points)}; a transforms.json needs a "
            "ply_file_path, or estimate the scene with `kfgs sfm`"
        )


def _describe_lens(lens: Camera) -> list[Any]:
    return [lens.K.tolist(), lens.size, asdict(lens.distortion) if lens.distortion else None]


def _training_camera(camera: Camera, scale: float) -> Camera:
    return camera.resized(*(max(1, round(n * scale)) for n in camera.size)) if scale != 1 else camera


def _make(
    folder: Path,
    scene: Scene,
    views: Sequence[int],
    cameras: Sequence[Camera],
    config: ColorConfig,
    run: Run,
    inputs: dict[str, Any],
    options: dict[str, Any],
) -> float:
    started = time.perf_counter()
    generator = _generator(config.seed, "color")
    start = GaussianParams.from_points(
        scene.points,
        colors=scene.colors,
        sh_degree=config.sh_degree,
        max_points=config.max_points,
        generator=generator,
    )
    fit = fit_field(
        start,
        cameras,
        Pictures(scene, views, cameras),
        config.field,
        extent=scene.extent,
        loss=ColorLoss(config.ssim_weight),
        generator=generator,
        checkpoint=run.scratch("color", inputs),
        **options,
    )
    tensors = {name: value.contiguous() for name, value in fit.params.to_tensors().items()}
    save_file(tensors, folder / "params.safetensors")
    write_json(folder / "history.json", fit.history)
    return max(0.0, fit.history[-1]["seconds"] - (time.perf_counter() - started))  # before it was killed
