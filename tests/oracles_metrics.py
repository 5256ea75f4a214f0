"""Segmentation scores from their definitions."""

from __future__ import annotations

import math

import numpy as np


def segmentation_scores(pred: np.ndarray, target: np.ndarray, classes: int, ignored: set[int]):
    """IoU per class, their mean, and accuracy, by sets of pixels; pred -1 is never right."""
    pixels = [(int(p), int(t)) for p, t in zip(pred.ravel(), target.ravel(), strict=True) if int(t) not in ignored]
    iou = []
    for c in range(classes):
        said = {i for i, (p, _) in enumerate(pixels) if p == c}
        true = {i for i, (_, t) in enumerate(pixels) if t == c}
        iou.append(len(said & true) / len(said | true) if said | true else math.nan)
    occurring = [x for x in iou if not math.isnan(x)]
    accuracy = sum(p == t for p, t in pixels) / len(pixels)
    return iou, sum(occurring) / len(occurring), accuracy
