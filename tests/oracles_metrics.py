"""Segmentation scores and SSIM from their definitions, in loops."""

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


def mean_ssim(a: np.ndarray, b: np.ndarray, peak: float) -> float:
    """Wang et al. 2004: Gaussian window 11x11, sigma 1.5, over windows inside the picture; [H, W, C] float64."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    values = []
    height, width, channels = a.shape
    for c in range(channels):
        for i in range(5, height - 5):
            for j in range(5, width - 5):
                x, y = (m[i - 5 : i + 6, j - 5 : j + 6, c] for m in (a, b))
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                values.append((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    return float(np.mean(values))
