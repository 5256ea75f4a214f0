"""Convert between cameras of kfgs, one view each, and kornia's `PinholeCamera`, a batch of views."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from kornia.geometry.camera import PinholeCamera

from .._check import check_shapes
from .camera import NEAR, Camera, at_one_origin
from .projection import refuse_distortion


def to_kornia(cameras: Sequence[Camera], *, integer_centers: bool = False) -> PinholeCamera:
    """Stack cameras into one kornia `PinholeCamera` of batch B = len(cameras).

    **Convention**: both libraries map world to camera with x right, y down, z forward, and both project by K (R X + t):
    K decides where pixel centres are. kfgs's K puts the centre of the first pixel at (0.5, 0.5), so `project` gives the
    pixels of `project_points`. Functions of kornia that make their own pixel grid (`create_meshgrid`, `DepthWarper`,
    `remap`) put that centre at (0, 0). For them, `integer_centers=True` subtracts 0.5 from cx and cy.

    Returns:
        `intrinsics` and `extrinsics` [B, 4, 4] in the widest dtype, `height` and `width` [B] int64, counted from the origin
        of the first camera. Names, `near` and that origin are lost. `project` does not test for front and border.

    Raises:
        ValueError: if there is no camera, one has distortion, or they are on several devices.

    Example:
        >>> camera = Camera(torch.eye(4), torch.tensor([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]), 64, 48)
        >>> to_kornia([camera]).project(torch.tensor([[[0.2, 0.1, 2.0]]]))
        tensor([[[42., 29.]]])
    """
    if not len(cameras):
        raise ValueError("cameras: expected at least one Camera, got none; select a view that the scene has")
    cameras = at_one_origin(cameras)
    for camera in cameras:
        refuse_distortion(camera)
    matrices = [matrix for camera in cameras for matrix in (camera.K, camera.viewmat)]
    devices = {str(matrix.device) for matrix in matrices}
    if len(devices) > 1:
        raise ValueError(
            f"cameras: expected matrices on one device, got {', '.join(sorted(devices))}; move them with camera.to(device)"
        )
    dtype = reduce(torch.promote_types, (matrix.dtype for matrix in matrices))
    K = [camera.intrinsics_at_integer_centers if integer_centers else camera.K for camera in cameras]
    extrinsics = torch.stack([camera.viewmat.to(dtype) for camera in cameras])
    intrinsics = torch.eye(4, dtype=dtype, device=extrinsics.device).repeat(len(cameras), 1, 1)
    intrinsics[:, :3, :3] = torch.stack([matrix.to(dtype) for matrix in K])
    sizes = torch.tensor([camera.size for camera in cameras], device=extrinsics.device)
    return PinholeCamera(intrinsics, extrinsics, height=sizes[:, 0], width=sizes[:, 1])


def from_kornia(
    pinhole: PinholeCamera, names: Sequence[str] = (), *, near: float = NEAR, integer_centers: bool = False
) -> list[Camera]:
    """The cameras of a kornia batch, one by one: the inverse of `to_kornia`.

    Args:
        pinhole: B cameras; of `intrinsics` only the upper left 3 x 3 is read, as kornia does.
        names: B names, or none.
        near: of every camera, world units; kornia's cameras have none.
        integer_centers: whether its K puts pixel centres on integers, as kornia's documentation says of its cameras; 0.5 is
            then added to cx and cy. A K from COLMAP has them on halves, inside kornia's cameras too.
    """
    count = pinhole.batch_size
    for name in ("intrinsics", "extrinsics"):
        check_shapes((f"pinhole.{name}", getattr(pinhole, name), (count, 4, 4)))
    if names and len(names) != count:
        raise ValueError(f"names: expected {count} (one per camera), got {len(names)}; give one for each")
    viewmats, Ks = pinhole.extrinsics.clone(), pinhole.camera_matrix.clone()  # kornia's scale_ changes them in place
    if integer_centers:
        Ks[:, :2, 2] += 0.5
    sizes, names = (pinhole.width.tolist(), pinhole.height.tolist()), names or [""] * count
    rows = zip(viewmats, Ks, *sizes, names, strict=True)
    return [Camera(viewmat, K, width, height, name, near=near) for viewmat, K, width, height, name in rows]
