"""Similarity alignment of two point sets (Umeyama 1991), in numpy float64."""

import numpy as np


def align_similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3], translation [3] that bring source [N, 3] onto target [N, 3] in the least-squares sense."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    U, S, Vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = U @ sign @ Vt
    scale = float(np.trace(np.diag(S) @ sign) / (a**2).sum(1).mean())
    return scale, rotation, target_mean - scale * rotation @ source_mean
