"""Poses as programs write them: rounded, with a scale, or with NaN where a picture could not be placed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._notes import Repair
from .files import MAX_NUMBER, some

TOLERANCE = 1e-3  # of R R^T: what `Camera` accepts
SKEW = 0.02  # largest difference of a rotation's singular values, relative: rotations that are rounded to two digits

Matrix = NDArray[np.float64]


def is_rotation(R: Matrix) -> bool:  # [3, 3]
    """Whether `Camera` accepts a matrix, but for its handedness."""
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= TOLERANCE)


def mend_pose(pose: Matrix) -> tuple[Matrix | None, float | None]:  # [4, 4]
    """A pose whose rotation has a scale or is rounded, with the nearest rotation (by SVD). The translation stays.

    Returns:
        The pose, or None if it has numbers that are not finite or plausible, or no rotation at all; and the scale that was
        removed, or None if it is unchanged. A matrix that is far from a rotation stays as it is, and `Camera` refuses it.

    Example:
        >>> pose, scale = mend_pose(np.diag([2.0, 2.0, 2.0, 1.0]))
        >>> pose.diagonal().tolist(), scale
        ([1.0, 1.0, 1.0, 1.0], 2.0)
    """
    if not np.isfinite(pose).all() or np.abs(pose).max() > MAX_NUMBER:
        return None, None
    R = pose[:3, :3]
    if is_rotation(R):
        return pose, None
    U, sizes, Vt = np.linalg.svd(R)
    if sizes[2] <= 1e-9 * sizes[0] or sizes[0] == 0:
        return None, None
    if sizes[0] - sizes[2] > SKEW * sizes[1] or np.linalg.det(R) < 0:
        return pose, None
    mended = pose.copy()
    mended[:3, :3] = U @ Vt
    return mended, float(sizes.mean())


def mending_notes(lost: list[str], scaled: dict[str, float]) -> list[str]:
    """Notes about views that were left out, and about those whose pose was mended, with the scale of each."""
    notes = []
    if lost:
        notes.append(f"{len(lost)} views have no pose or lens of finite numbers and were left out: {some(lost)}")
    if scaled:
        low, high = min(scaled.values()), max(scaled.values())
        sizes = f"{low:.6g}" if f"{low:.6g}" == f"{high:.6g}" else f"{low:.6g} to {high:.6g}"
        notes.append(
            f"{len(scaled)} poses have a scale ({sizes}) or a rounded rotation, which was removed: {some(list(scaled))}"
        )
    return [Repair(note) for note in notes]
