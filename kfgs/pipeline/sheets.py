"""One sheet for a segmented view: photograph, truth, teacher, field and its errors, with a legend."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..cameras import resize_labels
from ..labels import LabelSet, classify
from ..scenes import FeatureFolder, Scene
from ..viz import overlay_labels
from ..viz.pictures import Array, legend_strip, picture_grid, resize_photo
from .maps import maps_of_views

WIDTH = 480  # pixels of a panel
WRONG = (0.835, 0.369, 0.0)  # vermilion of Okabe and Ito, over a grey photograph
VOID = 0.5  # grey, as the palette's "no class"


def segmentation_sheet(
    photo: Tensor,  # [H, W, 3]
    labels: Tensor,  # [H, W] int64, -1 = none
    names: Sequence[str],
    *,
    truth: Tensor | None = None,  # [H, W] int64, of any size
    teacher: Tensor | None = None,  # [h, w] int64, of any size
    features: Array | None = None,  # [H, W, 3] uint8
) -> Array:  # [h, w, 3] uint8
    """Draw what there is, in rows of two or three: photograph, truth, teacher, field, errors, and the field's features.

    Errors are vermilion. Their share is counted at the size of the truth, where the truth is known. The features are left
    out where they would not fill a row.
    """
    high = max(1, round(photo.shape[0] * WIDTH / photo.shape[1]))
    small = resize_photo(photo, (high, WIDTH))
    found = {"truth": truth, "teacher": teacher, "field": labels}
    maps = {title: resize_labels(one, (high, WIDTH)) for title, one in found.items() if one is not None}
    panels: dict[str, Tensor | Array] = {"photo": small}
    for title, one in maps.items():
        panels[title] = overlay_labels(small, one, names, legend=False)
    if truth is not None:
        known, wrong = truth >= 0, resize_labels(labels, (truth.shape[0], truth.shape[1])) != truth
        share = float((wrong & known).sum() / known.sum().clamp_min(1))
        off = (maps["field"] != maps["truth"]) & (maps["truth"] >= 0)
        panels[f"field's errors: {100 * share:.1f} %"] = draw_errors(small, off.float(), maps["truth"] < 0)
    if features is not None and len(panels) % 2:
        panels["field's features"] = features
    columns = 3 if len(panels) > 4 else 2
    if len(panels) % columns:
        panels[""] = torch.ones_like(small)
    titles, pictures = list(panels), list(panels.values())
    rows = [
        picture_grid([pictures[i : i + columns]], titles[i : i + columns], width=WIDTH)
        for i in range(0, len(pictures), columns)
    ]
    present = torch.cat([one.unique() for one in maps.values()])
    return np.concatenate([*rows, legend_strip(present, names, rows[0].shape[1])])


def teacher_labels(scene: Scene, view: int, folder: Path, classes: LabelSet) -> Tensor | None:  # [h, w] int64
    """What a teacher's stored map says of a view: each pixel's best class by cosine.

    Args:
        scene: the view's scene; if it is undistorted, so is the map.
        view: index of the view.
        folder: the maps of the original pictures.
        classes: names and embeddings in the teacher's space.

    Returns:
        None if there is no map of this view that can be read, or one with other channels than the classes.
    """
    try:
        features = maps_of_views(scene, [view], FeatureFolder(folder).of(scene, [view]))[0]
    except (OSError, ValueError):
        return None
    if features.shape[-1] != classes.dim:
        return None
    return classify(features.flatten(0, 1), classes.embeddings).labels.view(features.shape[:2])


def draw_errors(photo: Tensor, wrong: Tensor, void: Tensor | None = None) -> Tensor:  # [H, W, 3], [H, W] -> [H, W, 3]
    """The photograph in light grey, errors in vermilion, what is not scored in plain grey."""
    grey = (0.5 + 0.5 * photo.mean(-1, keepdim=True)).expand_as(photo)
    share = 0.85 * wrong.clamp(0, 1)[..., None]
    drawn = (1 - share) * grey + share * torch.tensor(WRONG).to(photo)
    return drawn if void is None else drawn.where(~void[..., None], VOID)
