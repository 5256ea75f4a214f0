"""One cloud of 3-D Gaussians with activated values: what every other module passes around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from ._check import check_shapes


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N 3-D Gaussians. All values are **activated**; raw (log, logit) values live only in `fields.GaussianParams`.

    **Convention**: quaternions are (w, x, y, z) and need not be unit (they are normalised where used); scales are
    standard deviations in world units; labels are class indices with -1 = none. A semantic field carries `features`,
    a colour field `sh`.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] > 0
    opacities: Tensor  # [N] in (0, 1)
    features: Tensor | None = None  # [N, D]
    sh: Tensor | None = None  # [N, K, 3], K = (degree + 1)^2
    labels: Tensor | None = None  # [N] int64, -1 = none

    def __post_init__(self) -> None:
        check_shapes(
            ("means", self.means, "N 3"),
            ("quats", self.quats, "N 4"),
            ("scales", self.scales, "N 3"),
            ("opacities", self.opacities, "N"),
            ("features", self.features, "N D"),
            ("sh", self.sh, "N K 3"),
            ("labels", self.labels, "N"),
        )
        if self.sh is not None and self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {self.sh.shape[1]}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        parts = [f"{len(self)} Gaussians"]
        if self.features is not None:
            parts.append(f"{self.features.shape[1]} features")
        if self.sh is not None:
            parts.append(f"SH degree {int(self.sh.shape[1] ** 0.5) - 1}")
        if self.labels is not None:
            parts.append("labelled")
        return f"Gaussians({', '.join(parts)}, {self.means.dtype}, {self.means.device})"

    def _tensors(self) -> dict[str, Tensor]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def replace(self, **changes: Any) -> Gaussians:
        """A copy with some tensors exchanged."""
        return replace(self, **changes)

    def select(self, which: Tensor) -> Gaussians:  # which: [N] bool or [n] int64
        """The Gaussians under a mask or an index, as a new object."""
        if which.dtype == torch.bool and which.shape != self.opacities.shape:
            raise ValueError(f"which: expected a mask [N] with N = {len(self)}, got {tuple(which.shape)}")
        return Gaussians(**{name: value[which] for name, value in self._tensors().items()})

    def to(self, *args: Any, **kwargs: Any) -> Gaussians:
        """Move or convert the floating tensors as `Tensor.to` does; labels keep their integer type."""
        moved = {name: value.to(*args, **kwargs) for name, value in self._tensors().items() if name != "labels"}
        if self.labels is not None:
            moved["labels"] = self.labels.to(moved["means"].device)
        return Gaussians(**moved)

    def detach(self) -> Gaussians:
        """The same values without their autograd history."""
        return Gaussians(**{name: value.detach() for name, value in self._tensors().items()})

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate clouds that carry the same tensors.

        Raises:
            ValueError: if there is nothing to join, or one cloud carries what another lacks.
        """
        if not parts:
            raise ValueError("parts: expected at least one Gaussians, got none")
        names = set(parts[0]._tensors())
        for i, part in enumerate(parts):
            if set(part._tensors()) != names:
                raise ValueError(
                    f"parts[{i}]: expected the tensors {sorted(names)} as in parts[0], got {sorted(part._tensors())}; "
                    "add or drop them with replace()"
                )
        return Gaussians(**{name: torch.cat([part._tensors()[name] for part in parts]) for name in names})
