"""The 3-D covariance of a Gaussian from its rotation and its scales."""

from __future__ import annotations

from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from .._check import check_shapes


def covariance_3d(
    quats: Tensor,  # [N, 4] wxyz
    scales: Tensor,  # [N, 3]
) -> Tensor:  # [N, 3, 3]
    """Sigma = R S S^T R^T (Eq. 6 of 3DGS), with R from the quaternion and S = diag(scales).

    **Convention**: quaternions are (w, x, y, z) and are normalised here; q and -q give the same covariance. Scales are
    standard deviations in world units, along the axes that R turns.

    Raises:
        ValueError: if shapes disagree.

    Note:
        A zero quaternion counts as no rotation (kornia's choice).

    Example:
        >>> import torch
        >>> half = 2**-0.5  # a quarter turn around z takes the long x axis to y
        >>> covariance_3d(torch.tensor([[half, 0.0, 0.0, half]]), torch.tensor([[3.0, 1.0, 1.0]]))[0].diagonal()
        tensor([1.0000, 9.0000, 1.0000])
    """
    check_shapes(("quats", quats, "N 4"), ("scales", scales, "N 3"))
    axes = quaternion_to_rotation_matrix(quats) * scales[:, None, :]  # R S, [N, 3, 3]
    return axes @ axes.mT
