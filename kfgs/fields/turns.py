"""The 24 ways to name the axes of one ellipsoid: the one whose rotation is nearest to none needs the fewest bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]


_GROUP = Rotation.create_group("O")  # of a cube
_QUATS = np.roll(_GROUP.as_quat(), 1, axis=1)  # [24, 4] wxyz
_AXES = np.abs(_GROUP.as_matrix()).argmax(axis=1)  # [24, 3]: the old axis that becomes axis 0, 1 and 2


def nearest_turn(quats: Array, scales: Array) -> tuple[Array, Array]:  # [N, 4] of length 1, [N, 3]
    """The same ellipsoids with the rotation that is nearest to the identity: w > 0.85, and x, y and z within 0.39.

    R diag(s)^2 R^T does not change if R becomes R C and s is permuted likewise, for any of the 24 rotations C of a cube.
    """
    w, x, y, z = quats.T
    best = np.abs(quats @ (_QUATS * [1, -1, -1, -1]).T).argmax(1)  # the w of q C
    cw, cx, cy, cz = _QUATS[best].T
    turned = np.stack([
        w * cw - x * cx - y * cy - z * cz,
        w * cx + x * cw + y * cz - z * cy,
        w * cy - x * cz + y * cw + z * cx,
        w * cz + x * cy - y * cx + z * cw,
    ], axis=1)  # fmt: skip
    turned *= np.where(turned[:, :1] < 0, -1, 1)
    return turned, np.take_along_axis(scales, _AXES[best], axis=1)
