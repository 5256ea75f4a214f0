"""The colours of both sides that no question changes: their own, each other's, and those of latents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from ...gaussians import Gaussians
from ...splat import sh0_to_rgb
from ..cloud_colors import cloud_colors
from ..field_colors import FeatureColors
from ..palette import UNLABELLED
from ..pictures import as_bytes
from .carried import Array, Carried
from .picked import Side

GREY = np.array(UNLABELLED, dtype=np.uint8)


class SideColors:
    """Colours that are computed once, when first asked for.

    Args:
        clouds: of each side.
        carried: who gives each colour Gaussian its label.
        projection: gives the scene's projection of latents to colours.
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
        self.shows = tuple(shows)

    def rgb(self, side: Side) -> Array:  # [N, 3] uint8
        """A side's own colour, else that of the nearest Gaussian of the other."""
        if side not in self._rgb:
            own = self._clouds[side]
            if own.sh is not None:
                self._rgb[side] = as_bytes(sh0_to_rgb(own.sh[:, 0].detach()))
            else:
                other: Side = "color" if side == "semantic" else "semantic"
                tree = cKDTree(_points(self._clouds[other]), balanced_tree=False, compact_nodes=False)
                self._rgb[side] = self.rgb(other)[tree.query(_points(own), workers=-1)[1]]
        return self._rgb[side]

    def latents(self, side: Side, distance: float) -> Array:  # [N, 3] uint8
        """The scene's projection of the latents; grey where one was never learnt, or none is in reach of lambda."""
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
        """The colour map of scores; NaN is grey."""
        return cloud_colors(self._clouds[side], scores, clim=clim).rgb


def _points(cloud: Gaussians) -> Array:  # [N, 3] float64
    points: Array = cloud.means.detach().cpu().double().numpy()
    return points
