"""For each colour Gaussian, the semantic Gaussian that gives it a label: computed once, valid for every lambda."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..gaussians import Gaussians
from ..labels.nearest import Sources, explained_distance, neighbours_together, positions

Array = np.ndarray[Any, Any]
SPAN = 30.0  # the lambda slider reaches from a 30th of the suggestion to 30 times it


class Carried:
    """The nearest labelled semantic Gaussian of each colour Gaussian, at any distance.

    The same as `transfer_labels(..., method="nearest")`, for all lambdas at once; `within` applies one. Ties go to the
    lowest index.

    Args:
        semantic: with labels; Gaussians with label -1 are not used.
        color: N Gaussians that take the labels.
    """

    def __init__(self, semantic: Gaussians, color: Gaussians) -> None:
        assert semantic.labels is not None
        labels = semantic.labels.detach().cpu().numpy()
        points, targets = positions("meaning.gaussians.means", semantic.means), positions("color.means", color.means)
        kept = np.flatnonzero(labels >= 0)
        self.source = np.full(len(targets), -1, dtype=np.int64)
        """[N] index of the semantic Gaussian; -1 where none is labelled."""
        self.far = np.full(len(targets), np.inf)
        """[N] its distance in world units."""
        self.suggested, self.how = 1.0, "no labelled source"
        if kept.size == 0:
            return
        sources = Sources(points[kept], labels[kept])
        self.suggested, self.how = explained_distance(sources.tree, targets)
        order = neighbours_together(targets)
        near = sources.near(targets[order], 1, np.inf)
        self.source[order] = kept[sources.first][near.source[:, 0]]
        self.far[order] = near.distance[:, 0]

    def within(self, distance: float) -> Array:  # [N] bool
        """Which colour Gaussians have a labelled source strictly closer than lambda."""
        return np.less(self.far, distance)
