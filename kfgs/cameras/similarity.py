"""Similarities of space, x' = s R x + t: move, turn and scale a scene, or convert it to another frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from kornia.geometry.liegroup import Se3
from torch import Tensor

from .._check import ORIGIN, as_tensor, check_range, check_shapes
from .._origin import FAR_UNITS, Origin
from .camera import Camera, as_matrix, exact_rotation

LAST_ROW_TOLERANCE = 1e-5  # a float32 matrix inverse leaves 1e-7 there


@dataclass(frozen=True, eq=False)
class Similarity:
    """x' = scale * R x + t: a rotation, one factor for all axes, and a shift.

    **Convention**: points are columns; rotation and translation are copied to float64 on the CPU. The rotation is the exact
    rotation nearest to the given matrix; a matrix that is not nearly a rotation is refused.
    """

    scale: float  # > 0
    rotation: Tensor  # [3, 3] float64
    translation: Tensor  # [3] float64, units of the destination

    def __post_init__(self) -> None:
        check_range("scale", self.scale, 0, closed=(False, False))
        rotation, shift = as_tensor("rotation", as_matrix(self.rotation)), as_tensor("translation", self.translation)
        check_shapes(("rotation", rotation, "3 3"), ("translation", shift, "3"))
        if not torch.isfinite(shift).all():
            raise ValueError(f"translation: expected finite numbers, got {shift.tolist()}; check the fit")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", exact_rotation("rotation", rotation))
        object.__setattr__(self, "translation", shift.detach().double().cpu().clone())

    def __repr__(self) -> str:
        degrees = math.degrees(math.acos(max(-1.0, min(1.0, (float(self.rotation.trace()) - 1) / 2))))
        x, y, z = self.translation.tolist()
        return f"Similarity(scale {self.scale:.6g}, rotation by {degrees:.4g} degrees, translation ({x:.4g}, {y:.4g}, {z:.4g}))"

    @staticmethod
    def identity() -> Similarity:
        """The similarity that moves nothing."""
        return Similarity(1.0, torch.eye(3).double(), torch.zeros(3).double())

    @staticmethod
    def from_matrix(matrix: Tensor) -> Similarity:  # [4, 4]
        """Read scale, rotation and translation from [[s R, t], [0, 1]]; a ValueError if it shears, mirrors or is projective."""
        matrix = as_tensor("matrix", as_matrix(matrix)).detach().double().cpu()
        check_shapes(("matrix", matrix, "4 4"))
        if not (matrix[3] - matrix.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().max() <= LAST_ROW_TOLERANCE:  # NaN fails
            raise ValueError(f"matrix: expected the last row 0 0 0 1, got {matrix[3].tolist()}; pass points as columns")
        determinant = float(torch.linalg.det(matrix[:3, :3]))
        if not determinant > 0:
            got = f"determinant {determinant:g}; a mirrored or flat frame cannot be reached by a similarity"
            raise ValueError(f"matrix: expected a rotation times a positive scale, got {got}")
        scale = determinant ** (1 / 3)
        return Similarity(scale, exact_rotation("matrix", matrix[:3, :3] / scale), matrix[:3, 3])

    def matrix(self) -> Tensor:  # [4, 4] float64
        """[[s R, t], [0, 1]]."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    @property
    def pose(self) -> Se3:
        """The motion as kornia's `Se3`, of scale 1 (ValueError); `Similarity.from_matrix` takes one, too."""
        if not math.isclose(self.scale, 1, rel_tol=1e-6):
            raise ValueError(f"scale: expected 1, as every Se3 has, got {self.scale:g}; move the points by .apply()")
        return Se3.from_matrix(self.matrix())

    def apply(self, points: Tensor) -> Tensor:  # [N, 3] -> [N, 3]
        """Move points; computed in float64, returned in their dtype and on their device."""
        check_shapes(("points", points := as_tensor("points", points), "N 3"))
        R, t = self.rotation.to(points.device), self.translation.to(points.device)
        return (self.scale * (points.double() @ R.T) + t).to(points.dtype)

    def inverse(self) -> Similarity:
        """The inverse: x = R^T (x' - t) / s."""
        return Similarity(1 / self.scale, self.rotation.T, -(self.rotation.T @ self.translation) / self.scale)

    def between_worlds(self, src: Origin, dst: Origin) -> Similarity:
        """The same motion for world coordinates, if this one takes points counted from `src` to points counted from `dst`."""
        source, target = (torch.tensor(origin, dtype=torch.float64) for origin in (src, dst))
        return replace(self, translation=self.translation + target - self.scale * (self.rotation @ source))

    def apply_to_camera(self, camera: Camera) -> Camera:
        """The camera that takes the same picture of the moved scene.

        Its viewmat stays a rigid motion, [R_c R^T, s t_c - R_c R^T t], so depths and `near` become `scale` times as large; K,
        the size and the lens stay. The camera's `origin` moves with it.
        """
        local, origin = self.between_origins(camera.origin)
        moved = camera.viewmat.detach().double().cpu() @ local.inverse().matrix()
        moved[:3] *= self.scale
        return replace(camera, viewmat=moved.to(camera.viewmat), near=self.scale * camera.near, origin=origin)

    def between_origins(self, origin: Origin) -> tuple[Similarity, Origin]:
        """The same motion for points counted from an origin, if this one is for the world; and the origin of the moved points."""
        x, y, z = (self.scale * (self.rotation @ torch.tensor(origin, dtype=torch.float64)) + self.translation).tolist()
        if origin == ORIGIN and max(abs(x), abs(y), abs(z)) <= FAR_UNITS:
            return self, ORIGIN
        return replace(self, translation=torch.zeros(3)), (x, y, z)
