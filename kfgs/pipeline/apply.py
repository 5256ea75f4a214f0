"""What a finished field is used for: segmented views with scores and pictures, labelled Gaussians, labelled clouds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from .._files import atomic_path, write_json
from ..cameras import Camera, resize_labels
from ..evaluation import LabelSet, SegmentationReport, evaluate_segmentation
from ..evaluation.segmentation import VOID
from ..fields import SemanticField
from ..gaussians import Gaussians
from ..labels import Transfer, transfer_labels
from ..quant import unit_rows
from ..scenes import Scene
from ..scenes.ply import Columns, columns_from_gaussians, points_from_columns, read_ply, write_ply
from ..viz import FeatureColors, overlay_labels, palette, save_picture

Decode = Literal["exact", "latent"]


def save_label_map(path: Path, labels: Tensor) -> None:  # [H, W] int64
    """Write labels as an 8-bit picture, -1 as 255."""
    values = torch.where(labels < 0, VOID, labels).to(torch.uint8).cpu().numpy()
    with atomic_path(path) as temporary:
        Image.fromarray(values).save(temporary, format="PNG")


def feature_colors(field: SemanticField) -> FeatureColors:
    """One projection of this field's features to RGB, the same for every view of it."""
    assert field.gaussians.features is not None
    if field.codebook is None:
        return FeatureColors.fit(field.gaussians.features)
    if field.autoencoder is None:
        return FeatureColors.fit(field.codebook.codewords)
    with torch.no_grad():
        return FeatureColors.fit(field.autoencoder.encode(field.codebook.codewords))


def segment_scene(
    field: SemanticField,
    scene: Scene,
    classes: LabelSet,
    out: str | Path,
    *,
    split: str = "test",
    decode: Decode = "latent",
    pictures: int = 4,
    progress: bool = False,
) -> dict[str, Tensor]:
    """Segment every view of a split (Sec. 3.4) and write the label maps and some pictures.

    Args:
        field: a finished field in the frame of `scene`.
        scene: posed views without distortion.
        classes: names and embeddings in the teacher's space.
        out: receives `labels/<stem>.png` and, for `pictures` evenly spread views, `overlay/` and `features/`.
        split: which views.
        decode: `exact` decodes every pixel as the paper does; `latent` asks the same of the latents: much faster, and
            no worse (`docs/results.md`).
        pictures: how many views get an overlay and a feature picture.
        progress: show a progress bar.

    Returns:
        The label map [H, W] of each view by its stem.
    """
    out = Path(out)
    views = scene.views(split)
    shown = (
        {views[i] for i in np.linspace(0, len(views) - 1, min(pictures, len(views))).round().astype(int)}
        if views
        else set()
    )
    colors = feature_colors(field)
    results: dict[str, Tensor] = {}
    for i in tqdm(views, desc="segment", unit="view", disable=not progress):
        camera, stem = scene.cameras[i], scene.stem(i)
        labels = field.segment(camera, classes.embeddings, decode=decode)
        save_label_map(out / "labels" / f"{stem}.png", labels)
        if i in shown:
            picture = overlay_labels(scene.image(i), labels, list(classes.names))
            save_picture(out / "overlay" / f"{stem}.png", picture)
            with torch.no_grad():
                save_picture(out / "features" / f"{stem}.png", colors(field.render(camera).map))
        results[stem] = labels
    return results


def score_scene(labels: dict[str, Tensor], truth: Path, classes: LabelSet) -> SegmentationReport:
    """Score segmented views against the label pictures of a folder; views without one are left out."""
    known = {stem: truth / f"{stem}.png" for stem in labels if (truth / f"{stem}.png").is_file()}
    return evaluate_segmentation(lambda stem: labels[stem], known, classes.names)


def score_teacher(
    maps: Callable[[str], Tensor], truth: dict[str, Path], classes: LabelSet, size: tuple[int, int]
) -> SegmentationReport:
    """Score the teacher itself: each pixel's best class by cosine, under the protocol of `score_scene`."""
    rows = unit_rows(classes.embeddings)

    def predict(stem: str) -> Tensor:
        return resize_labels((unit_rows(maps(stem)) @ rows.T).argmax(-1), size)

    return evaluate_segmentation(predict, truth, classes.names)


def label_field(
    field: SemanticField, classes: LabelSet, cameras: Sequence[Camera] | None = None
) -> tuple[Gaussians, Tensor]:
    """The field's Gaussians with their classes, and a score [N] in [0, 1] or a cosine for each.

    Args:
        field: a finished field.
        classes: names and embeddings.
        cameras: views that vote on each Gaussian (`classify_by_views`; the score is the winner's share). Without them
            each Gaussian's own latent decides, as in Sec. 3.4 (the score is its cosine with the class).
    """
    if cameras is None:
        labels, scores = field.classify(classes.embeddings)
    else:
        labels, scores, _ = field.classify_by_views(classes.embeddings, cameras)
    return field.gaussians.replace(labels=labels), scores


def query_field(
    field: SemanticField, classes: LabelSet, name: str, threshold: float | None = None
) -> tuple[Gaussians, Tensor, str]:
    """The field's Gaussians with one class labelled: those whose similarity to it exceeds gamma (Sec. 3.4).

    Returns:
        The labelled Gaussians, the similarities [N], and a sentence that names gamma and where it came from.
    """
    target = classes.index(name)
    found = field.query(classes.embeddings[target], threshold)
    labels = torch.where(found.mask, target, -1)
    how = f"{name}: {int(found.mask.sum())} Gaussians above gamma = {found.threshold:.4f} ({found.how})"
    return field.gaussians.replace(labels=labels), found.scores, how


def save_labelled(path: str | Path, gaussians: Gaussians, scores: Tensor, classes: LabelSet) -> list[Path]:
    """Write labelled Gaussians as PLY (`class_id`, `score`, label colours) with a JSON file of names beside it."""
    path = Path(path)
    assert gaussians.labels is not None
    columns = columns_from_gaussians(gaussians) | label_columns(gaussians.labels, scores)
    write_ply(path, columns, comments=("kfgs labelled Gaussians",))
    names = path.with_suffix(".classes.json")
    write_json(names, {"class_id": dict(enumerate(classes.names)), "none": -1})
    return [path, names]


def label_columns(labels: Tensor, scores: Tensor | None = None) -> Columns:
    """PLY columns of labels: class_id (int, -1 = none), label colours, and scores when given."""
    rgb = palette(labels)
    columns: Columns = {"class_id": labels.to(torch.int32).numpy()}
    columns |= {name: np.ascontiguousarray(rgb[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    if scores is not None:
        columns["score"] = scores.to(torch.float32).numpy()
    return columns


def label_cloud(
    gaussians: Gaussians, cloud: str | Path, out: str | Path, classes: LabelSet, *, distance: float | None = None
) -> tuple[Transfer, list[Path]]:
    """Carry labels to the points or Gaussians of a PLY file by distance (Sec. 3.4), keeping all its other columns.

    Args:
        gaussians: labelled Gaussians of the semantic field.
        cloud: a PLY file of points or of a colour field, in the same frame.
        out: the PLY file to write.
        classes: names for the JSON file beside it.
        distance: the paper's lambda, in world units; from the clouds' spacing when not given.
    """
    assert gaussians.labels is not None
    columns = read_ply(cloud)
    moved = transfer_labels(gaussians.means, gaussians.labels, points_from_columns(columns), distance)
    write_ply(out, columns | label_columns(moved.labels), comments=("labels carried by kfgs",))
    names = Path(out).with_suffix(".classes.json")
    write_json(names, {"class_id": dict(enumerate(classes.names)), "none": -1, "distance": moved.distance})
    return moved, [Path(out), names]


def write_report(path: Path, **parts: Any) -> None:
    """Write scores and facts of a run as one JSON file; reports are turned into plain numbers."""
    write_json(path, {name: part.to_json() if hasattr(part, "to_json") else part for name, part in parts.items()})
