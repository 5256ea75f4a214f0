"""Masks of texts in a COCO JSON."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from kfgs._files import as_path
from kfgs.evaluation.coco import CocoPicture, masks_of, read_coco
from kfgs.evaluation.truth import ReadWhenAsked, is_void

from ..mask_truth import MaskAndBoxes, MaskTruth


def load_coco_masks(path: str | Path) -> MaskTruth:
    """Read a COCO JSON as masks of texts: the categories that each picture has, several objects as one mask with a box each.

    Categories that mean "no class" are not texts.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged; the message names the annotation.
    """
    path = as_path(path)
    names, pictures = read_coco(path)
    void = [category for category in names if is_void(names[category])]

    def read(picture: CocoPicture) -> dict[str, MaskAndBoxes]:
        parts: dict[int, list[MaskAndBoxes]] = {}
        for category, mask, annotation in masks_of(path, names, picture):
            if category not in void:
                given = annotation.get("bbox")
                if not isinstance(given, list) or [type(one) in (int, float) for one in given] != [True] * 4:
                    raise ValueError(f"{path}: expected a bbox [x, y, width, height] of each annotation, got {given!r}")
                x, y, width, height = given
                box = torch.tensor([[x, y, x + width, y + height]], dtype=torch.float32)
                parts.setdefault(category, []).append(MaskAndBoxes(mask, box))
        return {names[category]: _union(each) for category, each in parts.items()}

    shown = {s: p for s, p in pictures.items() if any(one.get("category_id") not in void for one in p.annotations)}
    return MaskTruth(ReadWhenAsked({stem: partial(read, picture) for stem, picture in shown.items()}))


def _union(parts: list[MaskAndBoxes]) -> MaskAndBoxes:
    boxes = torch.cat([part.boxes for part in parts if part.boxes is not None])
    return MaskAndBoxes(torch.stack([part.mask for part in parts]).any(dim=0), boxes)
