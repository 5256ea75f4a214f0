"""Points or ellipsoids in the place of Gaussians, where what draws or reads the scene knows none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from ..gaussians import Gaussians
from .ellipsoids import ellipsoids

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Instead = Literal["points", "ellipsoids"]
MOST = {"points": 400_000, "ellipsoids": 10_000}
"""Of a cloud, which then take 8 and 20 MB of a page."""
FAINT = {"points": 0.1, "ellipsoids": 0.5}
"""Opacity up to which a Gaussian is left out: points and ellipsoids are opaque, and would stand before what can be seen.
An ellipsoid is the surface on which alpha is 1/2, so it vanishes with its Gaussian's opacity at 1/2."""
POINT_SIZE = 4.0  # pixels


@contextmanager
def without_gaussians(plotter: pv.Plotter, instead: Instead, limit: int) -> Iterator[list[int]]:
    """Hide a plotter's clouds of Gaussians behind stand-ins for a while; yields [drawn, left out]."""
    counts, hidden, added = [0, 0], [], []
    try:
        for renderer in plotter.renderers:
            for actor in list(renderer.actors.values()):
                mapper = getattr(actor, "mapper", None)
                if mapper is None or not mapper.IsA("vtkPointGaussianMapper") or not actor.GetVisibility():
                    continue
                cloud = mapper.dataset
                rows = strongest(cloud, limit, FAINT[instead])
                counts[0] += len(rows)
                counts[1] += cloud.n_points - len(rows)
                actor.SetVisibility(False)
                hidden.append(actor)
                if len(rows):
                    stand_in = _as_actor(cloud, rows, instead)
                    renderer.AddActor(stand_in)
                    added.append((renderer, stand_in))
        yield counts
    finally:
        for actor in hidden:
            actor.SetVisibility(True)
        for renderer, stand_in in added:
            renderer.RemoveActor(stand_in)


def strongest(cloud: pv.PolyData, limit: int, faint: float) -> Array:  # [n] int64, ascending
    """The rows of a cloud that are drawn: not faint, and if there are too many, the largest and most opaque.

    The measure is opacity times the product of the two larger scales: what a splat covers of a picture.
    """
    opacity = np.asarray(cloud["opacity"], dtype=np.float64)
    rows = np.flatnonzero(opacity > faint)
    area = np.sort(np.asarray(cloud["scale"], dtype=np.float64), axis=1)[:, 1:].prod(axis=1)
    order = np.argsort(-(opacity * area)[rows], kind="stable")[:limit]
    return np.sort(rows[order])


def _as_actor(cloud: pv.PolyData, rows: Array, instead: Instead) -> Any:
    import pyvista as pv

    rgb = np.asarray(cloud["rgb"])[rows]
    if instead == "points":
        mesh = pv.PolyData(np.asarray(cloud.points)[rows])
        mesh["rgb"] = rgb
    else:
        mesh = half_surfaces(cloud, rows)
        mesh["rgb"] = rgb[np.asarray(mesh["index"])]
    mapper = pv.DataSetMapper(mesh)
    mapper.set_scalars(mesh["rgb"], "rgb", rgb=True)
    mapper.Update()
    actor = pv.Actor(mapper=mapper)
    if instead == "points":
        actor.prop.style, actor.prop.point_size, actor.prop.lighting = "points", POINT_SIZE, False
    else:
        actor.prop.ambient, actor.prop.diffuse, actor.prop.interpolation = 0.45, 0.6, "Phong"
    return actor


def half_surfaces(cloud: pv.PolyData, rows: Array) -> pv.PolyData:
    """Ellipsoids where alpha = opacity exp(-r^2 / 2) is 1/2: r = sqrt(2 ln(2 opacity)) standard deviations."""
    opacity = np.asarray(cloud["opacity"], dtype=np.float64)[rows]
    half = np.sqrt(2 * np.log(2 * opacity))[:, None] * np.asarray(cloud["scale"], dtype=np.float64)[rows]
    return ellipsoids(
        Gaussians(
            means=torch.from_numpy(np.array(cloud.points)[rows]),
            quats=torch.from_numpy(np.array(cloud["quat"])[rows]),
            scales=torch.from_numpy(half),
            opacities=torch.from_numpy(opacity),
        ),
        1.0,
    )
