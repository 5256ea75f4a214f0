"""Draw points or ellipsoids instead of Gaussians, for viewers and files that have no Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from ..gaussians import Gaussians

if TYPE_CHECKING:
    import pyvista as pv

Array = np.ndarray[Any, Any]
Instead = Literal["points", "ellipsoids"]
FACES = ((5_000, 2), (20_000, 1))  # up to 5,000 ellipsoids have 320 faces each, up to 20,000 have 80; more have 20
MOST = 100_000  # 2 million faces: 1.2 s a frame in software
MOST_EXPORTED = {"points": 400_000, "ellipsoids": 10_000}
"""The most Gaussians of a cloud in a page: 8 and 20 MB."""
FAINT = {"points": 0.1, "ellipsoids": 0.5}
"""Gaussians up to this opacity are left out, because points and ellipsoids are opaque and would hide what is behind. An
ellipsoid is the surface where alpha is 1/2; it has size zero if the Gaussian's opacity is 1/2."""
POINT_SIZE = 4.0  # pixels


def ellipsoids(gaussians: Gaussians, deviations: float) -> pv.PolyData:
    """A mesh of N ellipsoids; its point array `index` names the Gaussian of each vertex.

    Args:
        gaussians: N Gaussians.
        deviations: half axes, in standard deviations.

    Raises:
        ValueError: if there are more than 100,000.
    """
    count = len(gaussians)
    if count > MOST:
        raise ValueError(
            f"gaussians: expected at most {MOST:,} to draw as ellipsoids, got {count:,}; select fewer, or draw points"
        )
    import pyvista as pv

    ball = pv.Icosphere(nsub=next((times for most, times in FACES if count <= most), 0))
    corners, faces = np.array(ball.points, dtype=np.float32), np.array(ball.regular_faces)
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    with torch.no_grad():
        turn = quaternion_to_rotation_matrix(gaussians.quats.double()).cpu().numpy().astype(np.float32)  # [N, 3, 3]
    scales = gaussians.scales.detach().cpu().numpy().astype(np.float32)
    means = gaussians.means.detach().cpu().numpy().astype(np.float32)
    half = deviations * scales[:, None, :]
    points = np.einsum("nij,nvj->nvi", turn, corners * half) + means[:, None]
    normals = np.einsum("nij,nvj->nvi", turn, corners / np.maximum(half, 1e-12 * half.max()))  # the gradient's
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    shift = len(corners) * np.arange(count)[:, None, None]
    mesh = pv.PolyData.from_regular_faces(points.reshape(-1, 3), (faces + shift).reshape(-1, 3))
    mesh["index"] = np.repeat(np.arange(count), len(corners))
    mesh.point_data.active_normals = normals.reshape(-1, 3)
    return mesh


@contextmanager
def without_gaussians(plotter: pv.Plotter, instead: Instead, limit: int) -> Iterator[list[int]]:
    """Replace a plotter's Gaussians by points or ellipsoids inside a `with` block; yields the counts [drawn, left out]."""
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
                    substitute = _as_actor(cloud, rows, instead)
                    renderer.AddActor(substitute)
                    added.append((renderer, substitute))
        yield counts
    finally:
        for actor in hidden:
            actor.SetVisibility(True)
        for renderer, substitute in added:
            renderer.RemoveActor(substitute)


def strongest(cloud: pv.PolyData, limit: int, faint: float) -> Array:  # [n] int64, ascending
    """The rows of a cloud to draw: those that are not faint, and at most `limit` of them.

    The largest values of opacity times the product of the two larger scales win: this is what a splat covers of a picture.
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
