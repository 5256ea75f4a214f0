"""Colours of both sides that do not depend on the question: harmonics and latents, computed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from .._check import as_array
from ..gaussians import Gaussians
from ..splat import sh0_to_rgb
from ..viz.cloud_colors import cloud_colors
from ..viz.field_colors import FeatureColors
from ..viz.palette import UNLABELLED
from ..viz.pictures import as_bytes
from .carried import Array, Carried
from .picked import Side

GREY = np.array(UNLABELLED, dtype=np.uint8)


class SideColors:
    """Colours that are computed once, when first needed.

    Args:
        clouds: the Gaussians of each side.
        carried: the source of each colour Gaussian's label.
        projection: returns the scene's projection of latents to colours.
    """

    def __init__(
        self, clouds: Mapping[Side, Gaussians], carried: Carried | None, projection: Callable[[], FeatureColors]
    ) -> None:
        self._clouds, self._carried, self._projection = clouds, carried, projection
        self._rgb: dict[Side, Array] = {}
        self._latents: Array | None = None
        shows: list[Literal["rgb", "latents"]] = []
        if any(cloud.sh is not None for cloud in clouds.values()):
            shows.append("rgb")
        if clouds["semantic"].features is not None:
            shows.append("latents")
        self.show_choices = tuple(shows)

    def rgb(self, side: Side) -> Array:  # [N, 3] uint8
        """The colours of a side; if it has none, those of the nearest Gaussians of the other side."""
        if side not in self._rgb:
            own = self._clouds[side]
            if own.sh is not None:
                self._rgb[side] = as_bytes(sh0_to_rgb(own.sh[:, 0].detach()))
            else:
                other: Side = "color" if side == "semantic" else "semantic"
                tree = cKDTree(as_array(self._clouds[other].means), balanced_tree=False, compact_nodes=False)
                self._rgb[side] = self.rgb(other)[tree.query(as_array(own.means), workers=-1)[1]]
        return self._rgb[side]

    def latents(self, side: Side, distance: float) -> Array:  # [N, 3] uint8
        """The latents as colours; grey if a latent was never learnt, or none is within lambda."""
        features = self._clouds["semantic"].features
        assert features is not None
        if self._latents is None:
            learnt = features.any(dim=1)
            self._latents = np.broadcast_to(GREY, (len(features), 3)).copy()
            if bool(learnt.any()):
                self._latents[learnt.cpu().numpy()] = self._projection()(features[learnt])
        if side == "semantic" or self._carried is None:
            return self._latents
        return np.where(self._carried.within(distance)[:, None], self._latents[self._carried.source], GREY)

    def of_scores(self, side: Side, scores: Array, clim: tuple[float, float]) -> Array:  # [N] -> [N, 3] uint8
        """Scores through the colour map; NaN is grey."""
        return cloud_colors(self._clouds[side], scores, clim=clim).rgb
