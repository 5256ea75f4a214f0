"""The stages of the default method: find sharp Gaussians and fuse features onto them. Also fused features of trained fields."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from .._files import real_path, write_json
from .._progress import Progress
from .._typed import typed
from ..cameras import Camera
from ..fields import SemanticField, UpliftConfig, fuse_views, scene_classes, uplift_maps
from ..fields.store import NAME
from ..formats import read_splats
from ..formats.folders import splat_file_of
from ..gaussians import Gaussians
from ..quant import LinearLatents
from ..scenes import Scene
from .color import ColorConfig, find_color, make_color
from .config import FitConfig
from .maps import Maps, check_readable, maps_of_views
from .stages import Run, digest_cameras, digest_shape, stage_generator


def find_geometry(
    run: Run,
    scene: Scene,
    splat: Gaussians | str | Path | None,
    config: ColorConfig,
    device: torch.device,
    progress: Progress,
) -> tuple[Gaussians, dict[str, Any]]:
    """The Gaussians to fuse onto, and their origin, for the field's `info`.

    Without a splat they are those of the scene's own splat, or else the colour field of the run. Its stage is found again
    if it is there. A longer colour field of the same scene, as `kfgs color` makes it in the same run folder, is taken
    instead. A shorter one is not, but its `color.ply` stays.
    """
    splat = scene.splat if splat is None else splat
    if isinstance(splat, Gaussians):
        return splat, {"geometry": "given"}
    if splat is not None:
        return read_splats(splat), {"geometry": str(splat_file_of(splat))}
    found = find_color(run, scene, config)
    if found is None:
        found = make_color(run, scene, config, device, progress, overwrite=False).gaussians, config.field.steps
    gaussians, steps = found
    return gaussians, {"geometry": "trained on the pictures", "steps": {"color": steps}}


def uplift_stage(
    run: Run,
    geometry: Gaussians,
    cameras: Sequence[Camera],
    maps: Maps,
    config: UpliftConfig,
    inputs: dict[str, Any],
    progress: bool,
    latents: LinearLatents | None = None,
) -> SemanticField:
    """Fuse the maps onto the Gaussians, merge and compress, as a stage of a run.

    `inputs` are those in addition to Gaussians and cameras: `features` (the maps), `config`, `seed`, and the digest of
    `latents` if there are some.
    """
    inputs = {"geometry": digest_shape(geometry), "cameras": digest_cameras(cameras), **inputs}
    pictures = {"features": inputs["features"], "cameras": inputs["cameras"], "pixels": config.pixels}
    pictures |= {name: inputs[name] for name in ("latents",) if name in inputs}
    scratch = run.scratch("uplift", pictures)

    def make(folder: Path) -> None:
        check_readable(maps, "the uplift")
        options: dict[str, Any] = {"scratch": scratch, "progress": progress, "report": run.report, "latents": latents}
        generator = stage_generator(inputs["seed"], "uplift")
        field = uplift_maps(geometry.to("cpu"), cameras, maps, config, generator=generator, **options)
        field.save(folder / NAME)
        write_json(folder / "facts.json", {"gaussians": len(field), "latents": field.decoder.latent})

    stage = run.stage("uplift", inputs, make)
    shutil.rmtree(scratch, ignore_errors=True)
    return SemanticField.load(stage.folder)


@typed
def uplift(
    scene: Scene,
    maps: Maps,  # teacher maps of the views of `config.split`, in their order
    splat: Gaussians | SemanticField | str | Path,
    config: FitConfig | None = None,
    *,
    progress: bool = False,
    report: Callable[[str], None] | None = None,
) -> SemanticField:
    """Give the Gaussians of any splat or field the features of a teacher, without training (`fields.uplift_maps`).

    Args:
        scene: posed, undistorted views in the splat's frame.
        maps: one teacher map per view, of the original pictures; read one at a time.
        splat: the Gaussians, a splat file, or a field.
        config: only `uplift`, `split`, `undistorted_features` and `seed` are used. None: the training views, and every
            Gaussian stays unchanged.
        progress: show a bar.
        report: called with a line per step.

    Raises:
        ValueError: if counts disagree, a camera has distortion, a map's file does not fit, or no view shows any Gaussian.
    """
    if hasattr(maps, "check_files"):
        maps.check_files()
    config = config or FitConfig(uplift=UpliftConfig())
    cameras = tuple(scene.cameras[i] for i in scene.views(config.split))
    if scene.distorted:
        raise ValueError("scene: expected cameras without distortion, got a lens; pass scene.undistorted()")
    if isinstance(splat, str | Path):
        splat = read_splats(splat)
    cloud = splat if isinstance(splat, Gaussians) else splat.gaussians
    options: dict[str, Any] = {"generator": stage_generator(config.seed, "uplift"), "progress": progress}
    viewed = maps_of_views(scene, scene.views(config.split), maps, undistorted=config.undistorted_features)
    field = uplift_maps(cloud.to("cpu"), cameras, viewed, config.uplift, report=report, **options)
    teacher = getattr(maps, "identity", None)
    info = {
        "method": "uplift",
        "views": [camera.name for camera in cameras],
        **({"teacher": teacher} if teacher else {}),
        **({} if scene.folder is None else {"scene": str(real_path(scene.folder))}),
        "kfgs": version("kfgs"),
    }
    classes = None if scene.folder is None else scene_classes(scene.folder, field.dim)
    return replace(field, info=info, classes=classes)


def answers_stage(run: Run, field: SemanticField, cameras: Sequence[Camera]) -> SemanticField:
    """Compute the fused features of a trained field, as a stage of a run."""
    field_stage = next(stage for stage in reversed(run.stages) if stage.name == "field")
    inputs = {"field": field_stage.key}
    return SemanticField.load(
        run.stage("answers", inputs, lambda folder: fuse_views(field, cameras).save(folder / NAME)).folder
    )
