"""What labels carried to a colour scene are worth, class by class.

python benchmarks/edits.py toy DEMO                   # DEMO: what `kfgs demo --out DEMO` wrote
python benchmarks/edits.py real ROOM_0 FIELD COLOR    # FIELD: RUN/field.kfgs, COLOR: a splat in the same frame
python benchmarks/edits.py uncovered CLASS SCENE LABELLED [SCENE LABELLED ...]    # LABELLED: a splat from `kfgs attach`

Prints which rule labels the colour cloud best (mIoU, and mIoU weighted by what each Gaussian shows), and, for the toy room,
the removal and the recolouring of every class (`kfgs-removal/1`, `kfgs-recolor/1`). `uncovered` removes a class (or several:
table,bottle), without and with `fill`, and compares with the scene without it (`kfgs-uncovered/1`): a toy room (DEMO/scene,
DEMO/color.ply), or a room of benchmarks/rooms.py. It scores a recolouring of the first class, too, and a move if the room
has `moved/` (`kfgs-moved/1`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from editing import score_recolor, score_removal, score_uncovered
from scipy.spatial import cKDTree
from torch import Tensor

from kfgs import SemanticField, attach, load_label_set, load_scene, read_splats
from kfgs._files import read_json
from kfgs.cameras import Camera
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.views import labels_of_view
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList, LabelSet, Move, Recolor, Remove, transfer_labels
from kfgs.scenes import Scene
from kfgs.splat import average_views, vote_labels

REACH = 0.05  # metres: a Gaussian farther from every true surface point has no true class
BLUE = (0.1, 0.3, 0.9)  # a hue that no class of the toy room has


def miou(labels: Tensor, truth: Tensor, classes: int, weights: Tensor) -> float:
    """Mean IoU over the classes that occur, in percent; Gaussians without a true class are left out."""
    known = truth >= 0
    labels, truth, weights = labels[known], truth[known], weights[known].double()
    ious = []
    for c in range(classes):
        union = float(weights[(labels == c) | (truth == c)].sum())
        if union > 0:
            ious.append(float(weights[(labels == c) & (truth == c)].sum()) / union)
    return 100 * sum(ious) / len(ious)


def compare_rules(
    field: SemanticField, cloud: Gaussians, truth: Tensor, weights: Tensor, classes: LabelSet, cameras: list[Camera]
) -> None:
    """Print how well `transfer_labels` carries the semantic Gaussians' classes."""
    print(f"{'semantic Gaussians by':24s} {'rule':12s}  mIoU  weighted  without label")
    sources = {
        "what the views show": field.classify(classes).labels,
        "own latents (Sec. 3.4)": field.paper.classify(classes).labels,
    }
    for who, labels in sources.items():
        carried = transfer_labels(field.gaussians.replace(labels=labels), cloud).labels
        assert carried is not None
        scores = [miou(carried, truth, len(classes), w) for w in (torch.ones_like(weights), weights)]
        without = float((carried < 0).float().mean())
        print(f"{who:24s} {'nearest':12s} {scores[0]:5.1f}  {scores[1]:8.1f}  {without:8.1%}")


def compare_views(
    field: SemanticField, splats: Gaussians, truth: Tensor, weights: Tensor, classes: LabelSet, cameras: list[Camera]
) -> Gaussians:
    """The same for `attach(by="views")`; the labelled splat."""
    found = attach(field, splats, classes, cameras=cameras, by="views")
    scores = [miou(found.labels, truth, len(classes), w) for w in (torch.ones_like(weights), weights)]
    none = float((found.labels < 0).float().mean())
    print(f"{'attach by views':24s} {'-':12s} {scores[0]:5.1f}  {scores[1]:8.1f}  {none:8.1%}")
    return found.gaussians


def edit_every_class(splats: Gaussians, folder: Path) -> None:
    """Print the removal and the recolouring of each class of the toy room."""
    print(
        "\nclass      gone: pixels surface | kept: pixels (off border) surface | pass | recolour: dB outside, hue inside"
    )
    before = splats
    for name in splats.names:
        removed = score_removal(before, EditList().then(Remove(name)).apply(splats), folder, name)
        painted = EditList().then(Recolor(name, BLUE)).apply(splats)
        colored = score_recolor(before, painted, folder, name, BLUE)
        print(
            f"{name:10s}       {removed.gone_pixels:.3f}   {removed.gone_points:.3f} |       {removed.untouched_pixels:.3f} "
            f"({removed.untouched_off_border:.3f})    {removed.kept_points:.3f}   | {'yes' if removed.passed else 'no ':4s} | "
            f"{colored.psnr_outside:.1f} {colored.hue_inside:.3f}{'' if colored.passed else ' (no pass)'}"
        )


def labelled_views(scene: Scene, folder: Path) -> Iterator[tuple[Camera, Tensor]]:
    """The training views with their label pictures."""
    for i in scene.views("train"):
        labels = load_label_map(folder / f"{scene.stem(i)}.png")
        yield scene.cameras[i], labels_of_view(scene, i, labels)


def toy(demo: Path) -> None:
    """The toy room that `kfgs demo` made: truth is the class of the nearest surface point."""
    folder = demo / "scene"
    scene, classes = load_scene(folder), load_label_set(folder / "classes.json", folder / "text.npy")
    field, splats = SemanticField.load(demo / "run" / "field.kfgs"), read_splats(demo / "run" / "color.ply")
    cameras = [scene.cameras[i] for i in scene.views("train")]
    with np.load(folder / "surface.npz") as surface:
        distance, nearest = cKDTree(surface["points"]).query(splats.means.numpy())
        truth = torch.from_numpy(np.where(distance < REACH, surface["labels"][nearest].astype(np.int64), -1))
    weights = splats.opacities
    compare_rules(field, splats, truth, weights, classes, cameras)
    edit_every_class(compare_views(field, splats, truth, weights, classes, cameras), folder)


def real(folder: Path, field_path: Path, color: Path) -> None:
    """A real scene: truth is a vote of the labelled pixels of its training views."""
    scene = load_scene(folder).undistorted()
    classes = load_label_set(folder / "classes.json", folder / "text.npy")
    field, splats = SemanticField.load(field_path), read_splats(color)
    cameras = [scene.cameras[i] for i in scene.views("train")]
    truth = vote_labels(splats, labelled_views(scene, folder / "labels"), len(classes), min_share=0.0).labels
    shown = average_views(splats, ((camera, torch.ones(*camera.size, 1)) for camera in cameras)).weights
    compare_rules(field, splats, truth, shown, classes, cameras)
    compare_views(field, splats, truth, shown, classes, cameras)


def uncovered(name: str, pairs: list[tuple[Path, Path]]) -> None:
    """What a class covered, in one or several scenes; the mean of several comes last."""
    print("scene | rule | PSNR | SSIM | untouched | Gaussians more | seconds")
    rows: dict[str, list[list[float]]] = {}
    for folder, labelled in pairs:
        before = read_splats(labelled)
        rules = {"as it was": EditList()} | {
            f"fill={fill}": EditList((Remove(name.split(","), fill),)) for fill in (False, True)
        }
        if (folder / "moved").is_dir():
            by = read_json(folder / "plan.json")["options"]["moved"]
            rules["moved"] = EditList((Move(name.split(","), translation=by),))
        for rule, edits in rules.items():
            started = time.perf_counter()
            after = edits.apply(before)
            seconds = time.perf_counter() - started
            score = score_uncovered(before, after, folder, name, moved=rule == "moved")
            row = [score.psnr, score.ssim, score.untouched_pixels, len(after) - len(before), seconds]
            rows.setdefault(rule, []).append(row)
            print(
                f"{folder} | {rule} | {row[0]:.2f} | {row[1]:.3f} | {row[2]:.4f} | {row[3]:+,} | {row[4]:.1f}",
                flush=True,
            )
        first = name.split(",")[0]
        print(
            f"{folder} | {score_recolor(before, Recolor(first, BLUE).apply(before), folder, first, BLUE)}", flush=True
        )
    if len(pairs) > 1:
        for rule, table in rows.items():
            mean, spread = np.mean(table, axis=0), np.std(table, axis=0, ddof=1)
            shown = " | ".join(f"{m:.3f} +- {s:.3f}" for m, s in zip(mean[:3], spread[:3], strict=True))
            print(f"mean of {len(pairs)} | {rule} | {shown}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["toy"] and len(sys.argv) == 3:
        toy(Path(sys.argv[2]))
    elif sys.argv[1:2] == ["real"] and len(sys.argv) == 5:
        real(*map(Path, sys.argv[2:]))
    elif sys.argv[1:2] == ["uncovered"] and len(sys.argv) >= 5 and len(sys.argv) % 2 == 1:
        paths = list(map(Path, sys.argv[3:]))
        uncovered(sys.argv[2], list(zip(paths[::2], paths[1::2], strict=True)))
    else:
        raise SystemExit(__doc__)
