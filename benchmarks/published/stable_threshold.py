"""Occam's LGS's choice of a threshold: where the mask of a text hardly changes with it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from torch import Tensor

THRESHOLDS = np.arange(1, 100) / 100
FALLBACK = 0.5  # where no threshold is stable
MEDIAN = 5  # thresholds of the median filter

Array = np.ndarray[Any, Any]


class Stable(NamedTuple):
    """The mask of a text."""

    mask: Tensor  # [H, W] bool
    level: int
    threshold: float


class _Run(NamedTuple):
    slope: float
    threshold: float


def stable_mask(
    relevancy: Tensor,  # [levels, H, W]
    *,
    steepest: float = 0.4,
    fractions: tuple[float, float] = (0.005, 0.9),
    run: int = 5,
) -> Stable:
    """The mask at a threshold around which it is stable.

    Each level is brought to [0, 1] by its minimum and maximum. For the thresholds 0.01 to 0.99 the mean score inside the
    mask and the mask's share of the picture are computed. A threshold is stable if both change by less than `steepest` per
    unit of threshold (central differences, then a median of 5) and the share lies between `fractions`. The last run of at
    least `run` stable thresholds counts, its middle is the threshold. The level whose mean score changes least over its run
    is taken. Without any run it is the level with the largest relevancy, at 0.5.

    Note:
        Our reading of the official script in four points: the differences lose their sign before the median, not after it;
        the ends of the median filter mirror; an empty mask has mean score 0; the slope of a run is the mean of its
        differences.
    """
    low, high = relevancy.amin((-2, -1), keepdim=True), relevancy.amax((-2, -1), keepdim=True)
    scores = (relevancy - low) / (high - low).clamp_min(1e-9)
    runs = [_last_run(level.flatten().double().cpu().numpy(), steepest, fractions, run) for level in scores]
    slopes = [np.inf if found is None else found.slope for found in runs]
    level = int(np.argmin(slopes))
    chosen = runs[level]
    if chosen is None:
        level, threshold = int(high.flatten().argmax()), FALLBACK
    else:
        threshold = chosen.threshold
    return Stable(scores[level] > threshold, level, threshold)


def _last_run(scores: Array, steepest: float, fractions: tuple[float, float], run: int) -> _Run | None:
    """The last run of stable thresholds of one level's scores, or None."""
    ordered = np.sort(scores)
    below = np.searchsorted(ordered, THRESHOLDS, side="right")  # scores at or below each threshold
    count = len(ordered) - below
    sums = np.r_[np.cumsum(ordered[::-1])[::-1], 0.0][below]
    means = np.where(count > 0, sums / np.maximum(count, 1), 0.0)
    share = count / len(ordered)
    steps = [median_filter(np.abs(np.gradient(values, THRESHOLDS)), size=MEDIAN) for values in (means, share)]
    stable = (steps[0] < steepest) & (steps[1] < steepest) & (share > fractions[0]) & (share < fractions[1])
    edges = np.flatnonzero(np.diff(np.r_[False, stable, False]))
    long = [(start, stop) for start, stop in edges.reshape(-1, 2) if stop - start >= run]
    if not long:
        return None
    start, stop = long[-1]
    return _Run(float(steps[0][start:stop].mean()), float(THRESHOLDS[(start + stop - 1) // 2]))
