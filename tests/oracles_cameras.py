"""Cameras from COLMAP's library, projection in loops, and the alignment of point sets. None of it calls the code under test."""

from __future__ import annotations

import numpy as np
import pycolmap

# name -> (COLMAP parameters, kfgs distortion model, kfgs coefficients); 96x64, off-centre principal point.
# FULL_OPENCV is a pincushion (undistorting looks beyond the picture), the others are barrels.
LENSES = {
    "SIMPLE_RADIAL": ([70.0, 50.0, 30.5, -0.12], "brown_conrady", (-0.12, 0.0, 0.0, 0.0)),
    "RADIAL": ([70.0, 50.0, 30.5, -0.2, 0.05], "brown_conrady", (-0.2, 0.05, 0.0, 0.0)),
    "OPENCV": ([70.0, 66.0, 50.0, 30.5, -0.1, 0.03, 0.004, -0.006], "brown_conrady", (-0.1, 0.03, 0.004, -0.006)),
    "FULL_OPENCV": (
        [70.0, 66.0, 50.0, 30.5, 0.35, -0.03, 0.004, -0.006, 0.02, 0.1, 0.05, -0.01],
        "brown_conrady",
        (0.35, -0.03, 0.004, -0.006, 0.02, 0.1, 0.05, -0.01),
    ),
    "OPENCV_FISHEYE": (
        [70.0, 66.0, 50.0, 30.5, -0.04, 0.01, -0.003, 0.0004],
        "kannala_brandt",
        (-0.04, 0.01, -0.003, 0.0004),
    ),
}
WIDTH, HEIGHT = 96, 64


def colmap_camera(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=LENSES[model][0])


def colmap_pixels(model: str, points_cam: np.ndarray) -> np.ndarray:  # [N, 3] -> [N, 2]
    return colmap_camera(model).img_from_cam(points_cam.astype(np.float64))


def pixel_rays(K: np.ndarray, width: int, height: int) -> np.ndarray:  # [H, W, 3], z = 1
    """The ray of every pixel centre (j + 0.5, i + 0.5) of a pinhole camera."""
    rays = np.zeros((height, width, 3))
    for i in range(height):
        for j in range(width):
            rays[i, j] = ((j + 0.5 - K[0, 2]) / K[0, 0], (i + 0.5 - K[1, 2]) / K[1, 1], 1.0)
    return rays


def project_pinhole(K: np.ndarray, viewmat: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and depths, one point at a time: x = K (R X + t)."""
    pixels, depths = [], []
    for point in points:
        x, y, z = viewmat[:3, :3] @ point + viewmat[:3, 3]
        pixels.append((K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]))
        depths.append(z)
    return np.array(pixels), np.array(depths)


def align_similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3], translation [3] from source [N, 3] to target [N, 3], by least squares (Umeyama 1991)."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    U, S, Vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = U @ sign @ Vt
    scale = float(np.trace(np.diag(S) @ sign) / (a**2).sum(1).mean())
    return scale, rotation, target_mean - scale * rotation @ source_mean
