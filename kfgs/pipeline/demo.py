"""The whole main job on a room that the package makes itself, with exact ground truth to score against."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..evaluation import load_label_set
from ..formats.ply import write_ply
from ..gaussians import Gaussians
from ..labels import transfer_labels
from ..scenes import load_scene
from ..scenes.toy import ToyConfig, make_toy_room
from ..teachers import FeatureFolder
from .apply import (
    label_columns,
    label_field,
    save_labelled,
    score_scene,
    score_teacher,
    segment_scene,
    true_labels,
    write_report,
)
from .fit import FitConfig, fit_scene
from .pictures import write_training_pictures

SURFACE_PROTOCOL = (
    "kfgs-surface/1: share of the ground-truth surface points, each seen by some training view, that receive their true "
    "class from the nearest labelled Gaussian within lambda; points out of reach count as wrong"
)


def run(
    out: str | Path,
    config: FitConfig | None = None,
    *,
    room: ToyConfig | None = None,
    report: Callable[[str], None] | None = None,
    progress: bool = False,
) -> list[Path]:
    """Make the room, fit it, segment its unseen views, label its surface; return the files written.

    Args:
        out: receives `scene/`, `run/`, `segmentation/` and `scores.json`.
        config: how to fit; the CPU preset when not given.
        room: what to build; the default room when not given.
        report: receives one line per step.
        progress: show progress bars.
    """
    out, say = Path(out), report or (lambda text: None)
    config = config or FitConfig.cpu()
    say("making the toy room")
    folder = make_toy_room(out / "scene", room or ToyConfig())
    scene = load_scene(folder)
    classes = load_label_set(folder / "classes.json", folder / "text.npy")

    maps = FeatureFolder(folder / "features", [scene.stem(i) for i in scene.views("train")])
    fitted = fit_scene(scene, maps, out / "run", config, report=say, progress=progress)
    say(fitted.field.summary())

    found = segment_scene(fitted.field, scene, classes, out / "segmentation", progress=progress)
    truth = true_labels(scene, folder / "labels", "test")
    scores = score_scene(found, truth, classes)
    test_maps = FeatureFolder(folder / "features", list(found))
    size = scene.cameras[scene.views("test")[0]].size
    teacher = score_teacher(lambda stem: test_maps[list(found).index(stem)], truth, classes, size)
    say(f"unseen views: {scores}")
    say(f"the teacher on the same views: {teacher.miou}")

    gaussians, shares = label_field(fitted.field, classes, [scene.cameras[i] for i in scene.views("train")])
    written = save_labelled(out / "gaussians.ply", gaussians, shares, classes, rule="votes of the training views")
    surface = {"votes of the training views": _label_surface(gaussians, folder, out / "surface.ply")}
    surface["own latents (Sec. 3.4)"] = _label_surface(label_field(fitted.field, classes)[0], folder, None)
    for rule, facts in surface.items():
        say(f"surface points, Gaussians labelled by {rule}: {facts['agreement']:.4f} agree ({SURFACE_PROTOCOL})")
    write_report(out / "scores.json", unseen_views=scores, teacher=teacher, surface=surface, seconds=fitted.seconds)
    segmentation = out / "segmentation"
    return [
        fitted.field_path,
        segmentation / "predicted",
        segmentation / "overlay",
        segmentation / "features",
        *written,
        out / "surface.ply",
        *write_training_pictures(fitted),
        out / "scores.json",
    ]


def _label_surface(gaussians: Gaussians, folder: Path, out: Path | None) -> dict[str, Any]:
    """Carry the Gaussians' labels to the room's true surface points and score them (protocol `kfgs-surface/1`)."""
    assert gaussians.labels is not None
    with np.load(folder / "surface.npz") as surface:
        points, true = torch.from_numpy(surface["points"]).float(), torch.from_numpy(surface["labels"]).long()
    moved = transfer_labels(gaussians.means, gaussians.labels, points)
    if out is not None:
        columns = {name: points[:, i].contiguous().numpy() for i, name in enumerate("xyz")}
        write_ply(out, columns | label_columns(moved.labels), comments=("labels carried by kfgs",))
    return {
        "protocol": SURFACE_PROTOCOL,
        "agreement": float((moved.labels == true).float().mean()),
        "distance": moved.distance,
        "distance from": moved.how,
        "labelled": moved.labelled,
        "points": len(points),
    }
