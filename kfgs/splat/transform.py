"""Move, turn and resize a cloud of Gaussians as a whole: positions, rotations, scales and view-dependent colour."""

from __future__ import annotations

import torch
from kornia.geometry.liegroup import Se3
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..cameras.similarity import Similarity
from ..gaussians import Gaussians, check_gaussians
from .sh import rotate_sh


def transform_gaussians(gaussians: Gaussians, similarity: Similarity | Se3 | Tensor) -> Gaussians:
    """Move, turn and resize a cloud: x' = s R x + t. Cameras that move along see the same picture.

    Means move, quaternions are turned (q' = q_R q, keeping their length), scales grow by s, spherical harmonics turn with
    R (`rotate_sh`). Opacities, features and labels stay as they are. dtype and device are kept; differentiable in the Gaussians,
    not in the motion. A rigid motion may also be kornia's `Se3`, or a matrix [4, 4].

    Raises:
        TypeError: if an argument is something else.

    Example:
        >>> from kfgs.cameras import Similarity
        >>> one = Gaussians(torch.ones(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1))
        >>> moved = transform_gaussians(one, Similarity(3.0, torch.eye(3), torch.tensor([0.0, 0.0, 1.0])))
        >>> moved.means, moved.scales
        (tensor([[3., 3., 4.]]), tensor([[3., 3., 3.]]))
    """
    check_gaussians(gaussians)
    similarity = similarity if isinstance(similarity, Similarity) else Similarity.from_matrix(similarity)
    local, origin = similarity.between_origins(gaussians.origin)
    return gaussians.replace(
        means=local.apply(gaussians.means),
        origin=origin,
        quats=_turn(gaussians.quats, similarity.rotation),
        scales=gaussians.scales * similarity.scale,
        sh=None if gaussians.sh is None else rotate_sh(gaussians.sh, similarity.rotation),
    )


def _turn(quats: Tensor, rotation: Tensor) -> Tensor:  # [N, 4], [3, 3] -> [N, 4]
    """Hamilton's product q_R q as a matrix product; scipy's quaternion, for kornia's is rounded by its 1e-8 guards."""
    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat().tolist()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return quats @ left.T.to(quats)
