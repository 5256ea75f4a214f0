"""A mesh of ellipsoids, one for each Gaussian."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from ..gaussians import Gaussians

if TYPE_CHECKING:
    import pyvista as pv

FACES = ((5_000, 2), (20_000, 1))  # up to 5,000 ellipsoids have 320 faces each, up to 20,000 have 80; more have 20
MOST = 100_000  # 2 million faces: 1.2 s a frame in software


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
