"""Use a finished field: segment views, score them, label Gaussians and clouds, plot the training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from .._check import ORIGIN, check_range
from .._files import Names, as_path, atomic_path, check_output, write_json
from .._origin import recounted
from .._typed import typed
from ..cameras import resize_labels
from ..evaluation import SegmentationReport, evaluate_segmentation, load_label_map
from ..evaluation.label_pictures import VOID
from ..evaluation.segmentation import check_truth
from ..evaluation.views import labels_of_view
from ..fields import SemanticField
from ..formats.ply import Columns, other_elements, points_from_columns, read_ply, write_ply
from ..formats.ply_3dgs import columns_from_gaussians, label_column
from ..formats.render_mode import comments_of_mode
from ..formats.sidecar import write_names
from ..gaussians import Gaussians
from ..labels import LabelSet, OfClass, Selection, Transfer, classify, nearest_labels
from ..labels.questions import class_rows
from ..scenes import Scene, list_images
from ..viz import FeatureColors, overlay_labels, palette, save_picture
from ..viz.palette import UNLABELLED
from ..viz.pictures import Array
from .sheets import segmentation_sheet, teacher_labels

SEGMENTED = ("predicted", "colored", "sheets", "overlay", "features")
"""The folders that `segment_scene` makes."""
COMMENTS = {"gaussians.ply": "kfgs labelled Gaussians", "cloud.ply": "labels carried by kfgs"}
"""What the headers of the files of `kfgs label` say."""


def save_label_map(path: Path, labels: Tensor) -> None:  # [H, W] int64
    """Write labels as an 8-bit picture, -1 as 255."""
    _save_bytes(path, labels)


def save_colored_labels(path: Path, labels: Tensor, names: Sequence[str]) -> None:  # [H, W] int64
    """Write labels as an indexed PNG: pixel values as in `save_label_map`, shown in the classes' colours."""
    colors = np.vstack(
        [palette(np.arange(len(names)), names), np.zeros((VOID - len(names), 3), np.uint8), [UNLABELLED]]
    )
    _save_bytes(path, labels, colors.astype(np.uint8))


def check_classes(field: SemanticField, classes: LabelSet) -> None:
    """Check before any file is written that label pictures can hold the classes, and that the field knows their space."""
    if len(classes) > VOID:
        raise ValueError(
            f"classes: expected at most {VOID} (label pictures hold a byte per pixel, {VOID} = none), got {len(classes)}; "
            "segment with fewer classes, or call SemanticField.segment, which has no such limit"
        )
    class_rows(classes, field.dim, field.info)


def _save_bytes(path: Path, labels: Tensor, colors: Array | None = None) -> None:
    picture = Image.fromarray(torch.where(labels < 0, VOID, labels).to(torch.uint8).cpu().numpy())
    if colors is not None:
        picture.putpalette(colors.tobytes())  # mode P
    with atomic_path(path) as temporary:
        picture.save(temporary, format="PNG")


@typed
def segment_scene(
    field: SemanticField,
    scene: Scene,
    classes: LabelSet,
    out: str | Path,
    *,
    split: str = "test",
    pictures: int = 4,
    truth: Mapping[str, Tensor] | None = None,
    maps: Path | None = None,
    progress: bool = False,
) -> dict[str, Tensor]:
    """Segment every view of a split (Sec. 3.4) and write the label maps and some pictures.

    Args:
        field: a finished field in the frame of `scene`. `field.paper` decodes every pixel, which takes seconds a view.
        scene: posed views without distortion.
        classes: names and embeddings in the teacher's space.
        out: receives `predicted/<stem>.png` (class numbers, 255 = none), `colored/<stem>.png` (the same in the classes'
            colours) and, for `pictures` evenly spread views, `sheets/`, `overlay/` and `features/`.
        split: which views.
        pictures: how many views get a sheet, an overlay and a feature picture.
        truth: from `true_labels`, for the sheets.
        maps: folder of the teacher's maps, for the sheets; views without a map have no teacher there.
        progress: show a progress bar.

    Returns:
        The label map [H, W] of each view by its stem.
    """
    out = as_path(out)
    check_range("pictures", pictures, 0)
    check_output("out", out, "a folder")
    check_classes(field, classes)
    for stem, known in (truth or {}).items():
        check_truth(known, len(classes), f"truth[{stem!r}]")
    views = scene.views(split)
    shown = {views[i] for i in np.linspace(0, len(views) - 1, min(pictures, len(views))).round().astype(int)}
    colors = FeatureColors.fit(field.features)
    results: dict[str, Tensor] = {}
    for i in tqdm(views, desc="segment", unit="view", disable=not progress):
        camera, stem = scene.cameras[i], scene.stem(i)
        labels = field.segment(camera, classes)
        save_label_map(out / "predicted" / f"{stem}.png", labels)
        save_colored_labels(out / "colored" / f"{stem}.png", labels, classes.names)
        if i in shown:
            photo = scene.image(i)
            with torch.no_grad():
                features = colors(field.render(camera).map)
            teacher = None if maps is None else teacher_labels(scene, i, maps, classes)
            target = None if truth is None else truth.get(stem)
            sheet = segmentation_sheet(photo, labels, classes.names, truth=target, teacher=teacher, features=features)
            for name, picture in (
                ("sheets", sheet),
                ("overlay", overlay_labels(photo, labels, classes.names)),
                ("features", features),
            ):
                save_picture(out / name / f"{stem}.png", picture)
        results[stem] = labels
    return results


@typed
def true_labels(scene: Scene, folder: str | Path, split: str) -> dict[str, Tensor]:
    """The label pictures of a split's views by stem, as [H, W] with -1 = void; views without one are left out.

    If the scene is undistorted, the label pictures are undistorted too. Masked and transparent pixels are void.
    """
    truth = {}
    names = Names(name for name in list_images(folder) if name.lower().endswith(".png"))
    stems = names.find_each(f"{scene.stem(i)}.png" for i in range(len(scene)))
    whole = names.find_each(camera.name for camera in scene.cameras)
    for i in scene.views(split):
        name = stems[i] or whole[i]
        if name is not None:
            truth[scene.stem(i)] = labels_of_view(scene, i, load_label_map(as_path(folder) / name))
    return truth


@typed
def score_scene(labels: dict[str, Tensor], truth: dict[str, Tensor], classes: LabelSet) -> SegmentationReport:
    """Score segmented views against their true labels (protocol `kfgs-pooled/1`). Views without truth are left out.

    Args:
        labels: the label map of each view by its stem, from `segment_scene`.
        truth: true labels by stem, from `true_labels`.
        classes: what the labels mean.
    """
    known = {stem: target for stem, target in truth.items() if stem in labels}
    return evaluate_segmentation(labels.__getitem__, known, classes.names)


@typed
def score_teacher(
    maps: Callable[[str], Tensor], truth: dict[str, Tensor], classes: LabelSet, size: tuple[int, int]
) -> SegmentationReport:
    """Score the teacher itself: each pixel's best class by cosine, under the protocol of `score_scene`.

    Args:
        maps: returns a view's teacher map [h, w, D] by its stem, undistorted like the views.
        truth: the result of `true_labels`.
        classes: names and embeddings.
        size: (height, width); the teacher's labels are resized to it before the comparison.
    """

    def predict(stem: str) -> Tensor:
        features = maps(stem)
        labels = classify(features.flatten(0, 1), classes.embeddings).labels
        return resize_labels(labels.view(features.shape[:2]), size)

    return evaluate_segmentation(predict, truth, classes.names)


@typed
def select_labelled(splats: Gaussians, name: str, threshold: float | None = None) -> Selection:
    """The Gaussians of a labelled splat that have one class.

    Args:
        splats: with labels and class names.
        name: the class.
        threshold: take only Gaussians with a `score` above it.

    Raises:
        ValueError: if the splat has no labels or no such class, or there are no scores to compare with a threshold.
    """
    selected = OfClass(name).select(splats)
    if splats.scores is None:
        if threshold is not None:
            raise ValueError("threshold: expected a splat with scores, got none; leave it out")
        return selected
    mask = selected.mask if threshold is None else selected.mask & (splats.scores > threshold)
    return Selection(mask, splats.scores, threshold, selected.how)


@typed
def save_labelled(
    path: str | Path, gaussians: Gaussians, scores: Tensor, classes: LabelSet, *, rule: str
) -> list[Path]:
    """Write labelled Gaussians as PLY (`class_id`, `score`, label colours), with a JSON file next to it.

    Args:
        path: the PLY file to write.
        gaussians: with labels.
        scores: one per Gaussian.
        classes: names for the JSON file.
        rule: how labels and scores were found, for the JSON file.
    """
    path = as_path(path)
    assert gaussians.labels is not None
    columns = columns_from_gaussians(gaussians) | label_columns(gaussians.labels, classes.names, scores)
    write_ply(path, columns, comments=(COMMENTS["gaussians.ply"], *comments_of_mode(gaussians)))
    return [path, write_names(path, classes.names, **{"labelled by": rule})]


def label_columns(
    labels: Tensor,  # [N]
    names: Sequence[str],
    scores: Tensor | None = None,  # [N]
) -> Columns:
    """PLY columns of labels: class_id (-1 = none), label colours, and scores if given."""
    rgb = palette(labels, names)
    columns: Columns = {"class_id": label_column(labels)}
    columns |= {name: np.ascontiguousarray(rgb[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    if scores is not None:
        columns["score"] = scores.to(torch.float32).numpy()
    return columns


def read_cloud(path: str | Path) -> Columns:
    """Read a PLY file whose points can be labelled.

    Raises:
        ValueError: if it has no x, y, z, or holds more than points (faces would be lost).
    """
    columns = read_ply(path)
    try:
        points_from_columns(columns)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; give a point cloud or a 3DGS file") from error
    others = other_elements(path)
    if others:
        raise ValueError(
            f"{path}: expected nothing but points, got {', '.join(others)} too, which labelling would lose; save the "
            "vertices as a point cloud"
        )
    return columns


@typed
def label_cloud(
    gaussians: Gaussians,
    cloud: Columns,
    out: str | Path,
    classes: LabelSet,
    *,
    distance: float | None = None,
    comments: tuple[str, ...] = (),
) -> tuple[Transfer, list[Path]]:
    """Carry labels to points or Gaussians by distance (Sec. 3.4), keeping all their other columns.

    Label colours are added if the cloud has no colours; `class_id` is replaced.

    Args:
        gaussians: labelled Gaussians of the semantic field.
        cloud: the result of `read_cloud`, in the same frame.
        out: the PLY file to write.
        classes: names for the JSON file next to it.
        distance: lambda of Sec. 3.4, in world units; None: from the clouds' spacing.
        comments: those of the cloud's file (`formats.ply.read_comments`), which may say how it is drawn.
    """
    assert gaussians.labels is not None
    points = recounted(points_from_columns(cloud), ORIGIN, gaussians.origin)
    moved = nearest_labels(gaussians.means, gaussians.labels, points, distance)
    added = label_columns(moved.labels, classes.names)
    if {"red", "green", "blue"} & set(cloud):
        added = {"class_id": added["class_id"]}
    write_ply(out, cloud | added, comments=(COMMENTS["cloud.ply"], *comments))
    return moved, [
        as_path(out),
        write_names(out, classes.names, **{"distance": moved.distance, "distance from": moved.how}),
    ]


def write_report(path: Path, **parts: Any) -> None:
    """Write scores and details of a run as one JSON file; reports become plain numbers."""
    write_json(path, {name: part.to_json() if hasattr(part, "to_json") else part for name, part in parts.items()})
