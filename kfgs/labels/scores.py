"""Gamma, the threshold that the score of a selected Gaussian exceeds (Sec. 3.4), found in the scores; and LERF's constants."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from .._arrays import Array

TEMPERATURE = 10.0  # factor of the cosines in LERF (Kerr 2023)
CANONICAL = ("object", "things", "stuff", "texture")  # LERF's negatives for a scene without known classes
EVEN = 0.5  # relevancy of a feature that is equally similar to the query and to its nearest negative
LOGIT_SCALE = 100.0  # of a vote's softmax: CLIP's at the end of its training (LSeg trains with 14.3)
Score = Literal["cosine", "relevancy"]

BINS = 128
SMOOTHING = 2.0  # standard deviation, in bins
PER = 30_000  # counts are scaled to this many features, so that two copies of a cloud have the threshold of one
CLEAR = 0.3  # a gap is clear if its floor is at least 2 x (10^0.3) sparser than the mode on either side
SHARE = 0.75  # a gap with more of the scene above it separates two parts of the background
TOP, WAY = 0.999, 0.7  # if no gap is clear: 70 % of the way from the median to the 99.9 % quantile


def similarity_threshold(scores: Tensor) -> tuple[float, str]:  # scores: [N]
    """Choose gamma, a threshold between the highest mode of the scores and the rest, and say how it was found.

    A target is often a hundredth of the scene, and the rest has several modes, which Otsu's threshold would cut in two (IoU
    0.02 on mixtures with 1 % targets). So the smoothed histogram is read in log counts. A gap counts if it is at least half
    as deep as the deepest one and at most three quarters of the scores lie above it. The cut is at the floor of the
    highest of these gaps. If no gap is clear (one mode, or modes that overlap), the cut is 70 % of the way from the median
    to the 99.9 % quantile.

    Mean IoU over classes on room_0: 0.88, and 0.90 with the best threshold in hindsight. On the toy room: 0.98. No scores
    give 1.0, all-equal scores their value. Selection is strict, so nothing is selected then.
    """
    values = scores.detach().double().cpu().numpy()
    if values.size == 0:
        return 1.0, "no scores: nothing to select"
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-6:  # float32 cosines differ by this much through rounding alone
        return high, f"all {values.size} scores are equal ({high:.3f}): nothing stands out"
    counts, edges = np.histogram(values, bins=BINS, range=(low, high))
    centres = (edges[1:] + edges[:-1]) / 2
    density = np.log10(1 + gaussian_filter1d(counts * (PER / values.size), SMOOTHING, mode="constant"))
    highest_below = np.maximum.accumulate(density)
    highest_above = np.maximum.accumulate(density[::-1])[::-1]
    above = 1 - np.cumsum(counts) / values.size
    depth = (np.minimum(highest_below, highest_above) - density) * (np.arange(BINS) >= _past_flank(density, above))
    if depth.max() < CLEAR:
        median, top = np.quantile(values, (0.5, TOP))
        how = f"no clear gap between modes: {WAY:.0%} of the way from the median {median:.3f} to the top {top:.3f}"
        return float(median + WAY * (top - median)), how
    deep = np.flatnonzero(depth >= depth.max() / 2)
    gap = np.split(deep, np.flatnonzero(np.diff(deep) > 1) + 1)[-1]  # the last run of neighbouring bins
    floor = gap[density[gap] <= density[gap].min() + 1e-9]
    threshold, sparser = float(centres[floor].mean()), 10 ** depth[gap].max()
    return threshold, f"gap at {threshold:.3f}: {sparser:.0f} x sparser than the modes beside it ({values.size} scores)"


def _past_flank(density: Array, above: Array) -> int:
    """The first bin with at most three quarters of the scores above it; if a mode rises there, the bin after its flank."""
    start = int(np.argmax(above <= SHARE))
    while 0 < start < BINS and density[start] > density[start - 1]:
        start += 1
    return start
