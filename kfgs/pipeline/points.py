"""Points for scenes that have poses and no points, or only a few, as a stage of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from .._arrays import read_safetensors
from .._progress import Progress
from .._tensors import save_tensors
from ..scenes import Scene, SceneError, SfmConfig, find_points
from .stages import Run, describe_lens, digest_pictures, digest_scene
from .train import FEW_POINTS, check_scene


def with_points(run: Run, scene: Scene, views: Sequence[int], seed: int, progress: Progress) -> Scene:
    """The scene, with points if it had fewer than `FEW_POINTS`: triangulated from the known poses of some of its views.

    If `find_points` finds no more than there are, these stay.

    Raises:
        SceneError: if there are no points, and pictures and poses do not fit together.
        ValueError: if no view shows the points.
    """
    if len(scene.points) >= FEW_POINTS:
        return scene
    seen = scene.select(views)
    inputs = {
        "pictures": digest_pictures(run, seen, range(len(seen))),
        "lenses": None if seen.lenses is None else [describe_lens(lens) for lens in seen.lenses],
        "scene": digest_scene(seen, range(len(seen))),
        "seed": seed,
    }

    def make(folder: Path) -> None:
        count = f"only {len(scene.points)} points" if len(scene.points) else "none"
        run.say(
            f"points: the scene has {count}, and training starts from points; "
            f"they are triangulated from {len(seen)} pictures and their poses (`kfgs sfm SCENE --out OUT` does the same once for "
            "all runs)"
        )
        found = scene
        try:
            found = find_points(seen, config=SfmConfig(seed=seed), progress=progress is True)
        except (SceneError, ImportError) as error:
            if len(scene.points) == 0:
                raise
            run.say(f"points: the few points of the scene are used: {error}")
        found = found if len(found.points) > len(scene.points) else scene
        save_tensors(folder / "points.safetensors", {"points": found.points, "colors": found.colors})

    tensors = read_safetensors(run.stage("points", inputs, make).folder / "points.safetensors")[0]
    scene = replace(scene, points=tensors["points"], colors=tensors["colors"])
    check_scene(scene, views, few=1)
    return scene
