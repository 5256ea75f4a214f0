"""Helpers for training semantic and colour fields: the device, checks of the scene, and a fit that can be resumed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from .._arrays import read_safetensors
from .._check import ORIGIN, as_origin
from .._files import write_json
from .._tensors import save_tensors
from ..cameras.projection import project_points
from ..fields import FieldConfig, FieldFit, GaussianParams
from ..fields.config import check_extent
from ..scenes import Scene
from ..splat import available_engines
from .stages import Run, Stage, origin_tensors

PARAMS = "params.safetensors"

FEW_POINTS = 100
"""A scene with fewer points has lost them (a deleted or cut points file): a single photo gives COLMAP hundreds. 2 points start
a field that is 9 dB worse than one from triangulated points, since Gaussians as large as the scene must be split first."""


def training_device(device: str | torch.device = "auto") -> torch.device:
    """The device of a name; a ValueError if it is no device, or there is no such GPU.

    Args:
        device: `auto` takes CUDA if torch sees it and an engine runs on it, else the CPU; `cpu`, `cuda`, `cuda:1`.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() and available_engines("cuda") else "cpu")
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"device: expected auto, cpu or cuda, got {device!r}; name one of them") from error
    if chosen.type not in ("cpu", "cuda"):
        raise ValueError(f"device: expected auto, cpu or cuda, got {device!r}; engines run on these only")
    if chosen.type == "cuda" and (chosen.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"device: expected a GPU that torch sees ({torch.cuda.device_count()} are there), got {device!r}; "
            "use cpu, or install a torch for CUDA"
        )
    return chosen


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
            "(`kfgs sfm`)"
        )
    if not any(bool(project_points(scene.cameras[i], scene.points)[2].any()) for i in views):
        raise ValueError(
            f"scene: expected points that some view shows, got {len(scene.points)} out of sight of all {len(views)} views; "
            "do points and poses share one frame? is the up axis or the direction of the poses flipped?"
        )


def with_extent(config: FieldConfig, scene: Scene) -> FieldConfig:
    """The options with the scene's extent, unless they have one of their own."""
    return replace(config, extent=float(check_extent(scene.extent) if config.extent is None else config.extent))


def field_stage(
    run: Run,
    name: str,
    inputs: dict[str, Any],
    train: Callable[[Path], FieldFit],
) -> tuple[GaussianParams, Stage]:
    """Train a field as a stage of a run; after a kill it resumes from its checkpoint.

    Args:
        run: the run folder.
        name: of the stage.
        inputs: everything that decides the result.
        train: fits the field, with the given file for its checkpoint.
    """
    scratch = run.scratch(name, inputs)

    def make(folder: Path) -> float:
        started = time.perf_counter()
        fit = train(scratch)
        origin = dict(zip(("origin",), origin_tensors(fit.params.origin), strict=False))
        save_tensors(folder / PARAMS, fit.params.to_tensors() | origin)
        write_json(folder / "history.json", fit.history)
        return max(0.0, fit.history[-1]["seconds"] - (time.perf_counter() - started))  # before it was killed

    stage = run.stage(name, inputs, make)
    scratch.unlink(missing_ok=True)
    return stage_params(stage.folder), stage


def stage_params(folder: Path) -> GaussianParams:
    """The parameters that a finished stage of `field_stage` has."""
    tensors = read_safetensors(folder / PARAMS)[0]
    origin = as_origin(tensors["origin"].tolist()) if "origin" in tensors else ORIGIN
    return replace(GaussianParams.from_tensors(tensors), origin=origin)
