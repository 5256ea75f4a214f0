"""Fit the codebook of a scene: K features that stand for all others (Sec. 3.3.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from .._check import check_shapes
from .._progress import Progress, as_progress
from .._rows import ENCODE, EPS, check_directions, row_norms
from .codebook import Codebook
from .grow import POOL, GrownCodebook
from .paper import PaperCodebook
from .sampling import FeatureMaps, read_grid


def fit_codebook(
    maps: FeatureMaps,  # each [h, w, D]
    options: GrownCodebook | PaperCodebook | None = None,
    *,
    generator: torch.Generator | None = None,
    progress: Progress = False,
) -> Codebook:
    """Fit a codebook to the feature maps of a scene.

    Args:
        maps: one map per image, read one at a time. Sizes may differ, D may not. All-zero features are left out; half
            precision is computed in float32.
        options: `GrownCodebook` (also if None), kfgs's own, reads each map once; `PaperCodebook` (Eq. 5-9) once per epoch.
        generator: draws the first directions of splits, or the order of the images; None: seed 0. On a CPU the same state
            gives the same bits.
        progress: True shows a bar; a function is called with each record as it is written to the history.

    Returns:
        The codebook; its `report` has the history, and how well it represents the sampled features.

    Raises:
        ValueError: if there is no map, a map has another shape or is not finite, or every feature is zero.
    """
    options, count = options or GrownCodebook(), len(maps)
    if count == 0:
        raise ValueError("maps: expected at least one feature map, got none; encode the training images first")
    samples = options.samples if isinstance(options, PaperCodebook) else min(options.samples, -(-POOL // count))
    channels: list[int] = []

    def read(i: int) -> Tensor:  # [n, D] nonzero, in at least single precision
        features = read_grid(maps, i, samples)
        channels.append(features.shape[-1])
        check_shapes((f"maps[{i}]", features, ("n", channels[0])))
        # row by row, whatever memory they come in: sums over another layout differ in their last bits
        features = features.to(torch.promote_types(features.dtype, torch.float32)).contiguous()
        norms = row_norms(features)
        check_directions(f"maps[{i}]", features, norms, ENCODE)
        return features if bool((norms > EPS).all()) else features[norms > EPS]

    generator = generator or torch.Generator().manual_seed(0)
    return options.fit(read, count, generator, as_progress(progress))
