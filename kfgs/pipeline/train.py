"""What training a semantic and a colour field share: the device, checks of the scene, points, and a stage that resumes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from .._arrays import read_safetensors, save_tensors
from .._files import write_json
from ..cameras.projection import project_points
from ..fields import Training
from ..fields.options import check_extent
from ..fields.train import FieldFit
from ..gaussians import Gaussians
from ..scenes import Scene, SceneError, SfmConfig, find_points
from ..scenes.scene import check_is_scene
from ..splat import available_engines
from .stages import Run, Stage, digest_pictures, digest_scene, origin_tensors

FEW_POINTS = 100
"""A scene with fewer points has lost them (a deleted or cut points file): a single photo gives COLMAP hundreds. 2 points start
a field that is 9 dB worse than one from triangulated points, since Gaussians as large as the scene must be split first."""


def training_device() -> torch.device:
    """CUDA if an engine runs on it, else the CPU. The variable CUDA_VISIBLE_DEVICES chooses a GPU, or with "" none."""
    return torch.device("cuda" if torch.cuda.is_available() and available_engines("cuda") else "cpu")


def training_views(scene: Scene, split: str) -> list[int]:
    """The views of a split, checked: see `check_scene`."""
    check_is_scene(scene)
    views = scene.views(split)
    check_scene(scene, views)
    return views


def check_scene(scene: Scene, views: Sequence[int], few: int = FEW_POINTS) -> None:
    """Raise a ValueError if some views cannot be trained on: a camera has a lens, or no different points are in sight.

    A scene with fewer points than `FEW_POINTS` passes: `with_points` finds some before the training, and checks again.
    """
    if scene.distorted:
        raise ValueError("scene: expected cameras without distortion, got a lens; pass scene.undistorted()")
    if len(scene.points) < few:
        return
    if bool((scene.points == scene.points[0]).all()):
        raise ValueError(
            f"scene: expected sparse points at different positions, got {len(scene.points)} at one; estimate the scene again "
            "(run_sfm)"
        )
    if not any(bool(project_points(scene.cameras[i], scene.points)[2].any()) for i in views):
        raise ValueError(
            f"scene: expected points that some view shows, got {len(scene.points)} out of sight of all {len(views)} views; "
            "do points and poses share one frame? is the up axis or the direction of the poses flipped?"
        )


def with_points(run: Run, scene: Scene, views: Sequence[int]) -> Scene:
    """The scene, with points if it had fewer than `FEW_POINTS`: triangulated from the known poses of some of its views.

    If `find_points` finds no more than there are, these stay. A SceneError if there are none, and pictures and poses do not
    fit together.
    """
    if len(scene.points) >= FEW_POINTS:
        return scene
    seen, everything = scene.select(views), range(len(views))
    inputs = {"pictures": digest_pictures(run, seen, everything), "scene": digest_scene(seen, everything)}

    def make(folder: Path) -> None:
        run.say(
            f"points: the scene has {len(scene.points)}, and training starts from points; they are triangulated from "
            f"{len(seen)} pictures and their poses"
        )
        made = scene
        try:
            made = find_points(seen, config=SfmConfig(seed=run.seed), progress=run.progress is True)
        except (SceneError, ImportError) as error:
            if len(scene.points) == 0:
                raise
            run.say(f"points: the few points of the scene are used: {error}")
        made = made if len(made.points) > len(scene.points) else scene
        save_tensors(folder / "points.safetensors", {"points": made.points, "colors": made.colors})

    tensors = read_safetensors(run.stage("points", inputs | {"seed": run.seed}, make).folder / "points.safetensors")[0]
    scene = replace(scene, points=tensors["points"], colors=tensors["colors"])
    check_scene(scene, views, few=1)
    return scene


def with_extent(options: Training, scene: Scene) -> Training:
    """The options with the scene's extent, unless they have one of their own."""
    return replace(options, extent=float(check_extent(scene.extent) if options.extent is None else options.extent))


def field_stage(
    run: Run, name: str, inputs: dict[str, Any], start: Callable[[], Gaussians], train: Callable[..., FieldFit]
) -> Stage:
    """Train a field as a stage of a run: `train`, a part of `fit_field`, from `start()`; after a kill it resumes."""
    checkpoint = run.scratch(name, inputs)

    def make(folder: Path) -> float:
        started, gaussians = time.perf_counter(), start().to(training_device())
        fit = train(gaussians, generator=run.generator(name), progress=run.progress, checkpoint=checkpoint)
        origin = dict(zip(("origin",), origin_tensors(fit.gaussians.origin), strict=False))
        save_tensors(folder / "gaussians.safetensors", fit.gaussians.tensors() | origin)
        write_json(folder / "history.json", fit.history)
        return max(0.0, fit.history[-1]["seconds"] - (time.perf_counter() - started))  # before it was killed

    stage = run.stage(name, inputs, make)
    checkpoint.unlink(missing_ok=True)
    return stage


def stage_gaussians(stage: Stage) -> Gaussians:
    """The Gaussians that a finished stage of `field_stage` has."""
    tensors = read_safetensors(stage.folder / "gaussians.safetensors")[0]
    return Gaussians(**tensors | {"origin": tensors.pop("origin", torch.zeros(3)).tolist()})
