"""Segment views with a finished field, write label pictures (COCO's JSON, too), and score them against true labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from .._check import check_range
from .._files import Names, as_path, atomic_path, check_output, file_stem, read_json
from ..cameras import Camera, as_cameras
from ..cameras.resample import resize_labels
from ..evaluation import evaluate_segmentation
from ..evaluation.coco import save_coco
from ..evaluation.label_pictures import VOID, load_label_map
from ..evaluation.segmentation import SegmentationReport, check_truth
from ..evaluation.views import labels_of_view
from ..fields import SemanticField
from ..labels import LabelSet, classify
from ..labels.label_set import class_rows
from ..scenes import Scene, list_images
from ..scenes.files import is_inside
from ..viz import FeatureColors, overlay_labels, palette
from ..viz.linked import evenly
from ..viz.palette import UNLABELLED
from ..viz.pictures import Array, draw_legend, picture_grid, save_picture

WIDTH = 480  # pixels of a picture in a sheet


def segment_scene(
    field: SemanticField,
    scene: Scene,
    classes: LabelSet,
    out: str | Path,
    *,
    split: str = "test",
    pictures: int = 4,
    truth: Mapping[str, Tensor] | None = None,
    progress: bool = False,
) -> dict[str, Tensor]:
    """Segment every view of a split (Sec. 3.4) and write the label maps and some pictures.

    Args:
        field: a finished field in the frame of `scene`. `field.paper` decodes every pixel, which takes seconds a view.
        scene: posed views without distortion.
        classes: names and embeddings in the teacher's space.
        out: receives `predicted/<stem>.png` (class numbers, 255 = none), `colored/<stem>.png` (the same in the classes'
            colours), and `sheets/<stem>.png` for some views: photograph, truth, field, and the field's features.
        split: which views.
        pictures: how many views, evenly spread, get a sheet.
        truth: from `true_labels`, for the sheets.
        progress: show a progress bar.

    Returns:
        The label map [H, W] of each view by its stem.
    """
    check_range("pictures", pictures, 0)
    truth = truth or {}
    for stem, known in truth.items():
        check_truth(known, len(classes), f"truth[{stem!r}]")
    views = scene.views(split)
    labels = segment_cameras(field, [scene.cameras[i] for i in views], classes, out, progress=progress)
    colors = FeatureColors.fit(field.latents) if pictures else None
    for k in evenly(len(views), pictures).tolist():
        stem, photo = scene.stem(views[k]), scene.image(views[k])
        drawn = ({"truth": truth[stem]} if stem in truth else {}) | {"field": labels[stem]}
        panels: dict[str, Any] = {"photograph": photo}
        for title, value in drawn.items():
            value = resize_labels(value, (photo.shape[0], photo.shape[1]))
            panels[title] = overlay_labels(photo, value, classes.names, legend=False)
        assert colors is not None
        with torch.no_grad():
            panels["features as colours"] = colors(field.render(scene.cameras[views[k]]).map)
        sheet = picture_grid([list(panels.values())], list(panels), width=WIDTH)
        present = torch.cat([value.unique() for value in drawn.values()])
        legend = draw_legend(present, classes.names, width=sheet.shape[1])
        save_picture(as_path(out) / "sheets" / f"{stem}.png", np.concatenate([sheet, legend]))
    return labels


def segment_cameras(
    field: SemanticField, cameras: Sequence[Camera], classes: LabelSet, out: str | Path, *, progress: bool = False
) -> dict[str, Tensor]:
    """Segment what any cameras see, and write label pictures: `segment_scene` without photographs.

    Args:
        field: a finished field.
        cameras: viewpoints without distortion in its frame, each with a name of its own: `path_cameras`,
            `orbit_cameras`, or your own.
        classes: names and embeddings in the teacher's space.
        out: receives `predicted/<name>.png` (class numbers, 255 = none) and `colored/<name>.png` (in the classes' colours).
        progress: show a progress bar.

    Returns:
        The label map [H, W] of each camera by its name, without a suffix such as .png.
    """
    cameras = as_cameras(cameras)
    names = [file_stem(camera.name or "") for camera in cameras]
    if len(set(names)) != len(names) or not all(map(is_inside, names)):
        raise ValueError(
            f"cameras: expected a name of its own for each, as pictures in a folder can have, got {names!r:.120}; name them "
            "with replace()"
        )
    out = check_output("out", out, "a folder")
    if len(classes) > VOID:
        raise ValueError(
            f"classes: expected at most {VOID} (label pictures hold a byte per pixel, {VOID} = none), got {len(classes)}; "
            "segment with fewer classes, or call SemanticField.segment, which has no such limit"
        )
    class_rows(classes, field.dim, field.info)  # checks them before the work
    unused = np.zeros((VOID - len(classes), 3), np.uint8)
    colors = np.vstack([palette(np.arange(len(classes)), classes.names), unused, [UNLABELLED]]).astype(np.uint8)
    labels = {}
    for name, camera in tqdm([*zip(names, cameras, strict=True)], desc="segment", unit="view", disable=not progress):
        labels[name] = field.segment(camera, classes)
        save_label_map(out / "predicted" / f"{name}.png", labels[name])
        save_label_map(out / "colored" / f"{name}.png", labels[name], colors)
    return labels


def save_label_map(
    path: Path,
    labels: Tensor,  # [H, W] int64
    colors: Array | None = None,  # [256, 3] uint8
) -> None:
    """Write labels as an 8-bit picture, -1 as 255; with `colors`, as an indexed PNG of the same values."""
    picture = Image.fromarray(torch.where(labels < 0, VOID, labels).to(torch.uint8).cpu().numpy())
    if colors is not None:
        picture.putpalette(colors.tobytes())  # mode P
    with atomic_path(path) as temporary:
        picture.save(temporary, format="PNG")


def write_coco(
    out: str | Path,
    labels: Mapping[str, Tensor],  # each [H, W] int64, -1 = none
    names: Sequence[str],
    picture: Callable[[str], Tensor | Array] | None = None,
) -> Path:
    """Write label maps by name as `coco/annotations.json`, and pictures to `coco/images/`; return the folder `coco`.

    `picture` gives the picture [H, W, 3] of a view, without lens distortion like its labels; None writes no pictures.
    """
    folder = check_output("out", as_path(out) / "coco", "a folder")
    if picture is not None:
        for name in labels:
            save_picture(folder / "images" / f"{name}.png", picture(name))
    save_coco(folder / "annotations.json", {f"{name}.png": value for name, value in labels.items()}, names)
    return folder


def scored_labels(scene: Path, classes: LabelSet, say: Callable[[str], None]) -> Path | None:
    """The folder of a scene's label pictures; None if there is none, or, with a note, if they count other classes."""
    folder = next((scene / name for name in ("labels_scored", "labels") if (scene / name).is_dir()), None)
    listed = scene / "classes.json"
    if folder is not None and listed.is_file() and tuple(read_json(listed)) != classes.names:
        say(f"note: not scored: {folder} counts the classes of {listed}, which are others")
        return None
    return folder


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


def score_scene(labels: dict[str, Tensor], truth: dict[str, Tensor], classes: LabelSet) -> SegmentationReport:
    """Score label maps of `segment_scene` against `true_labels` (protocol `kfgs-pooled/1`). Views without truth are left out."""
    known = {stem: target for stem, target in truth.items() if stem in labels}
    return evaluate_segmentation(labels.__getitem__, known, classes.names)


def score_teacher(
    maps: Callable[[str], Tensor], truth: dict[str, Tensor], classes: LabelSet, size: tuple[int, int]
) -> SegmentationReport:
    """Score the teacher itself: each pixel's best class by cosine, under the protocol of `score_scene`.

    `maps` returns a view's map [h, w, D] by its stem, undistorted like the views; its labels are resized to `size`, (height,
    width), before the comparison.
    """

    def predict(stem: str) -> Tensor:
        features = maps(stem)
        labels = classify(features.flatten(0, 1), classes.embeddings).labels
        return resize_labels(labels.view(features.shape[:2]), size)

    return evaluate_segmentation(predict, truth, classes.names)
