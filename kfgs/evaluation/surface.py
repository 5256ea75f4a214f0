"""How well the labels of Gaussians reach the surfaces of a scene: points of them with known classes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .._check import check_shapes
from ..labels import Transfer, nearest_labels

SURFACE_PROTOCOL = (
    "kfgs-surface/1: share of the ground-truth surface points, each seen by some training view, that receive their true "
    "class from the nearest labelled Gaussian within lambda; points out of reach count as wrong"
)


@dataclass(frozen=True, eq=False)
class SurfaceReport:
    """What the points received."""

    agreement: float
    """Share of the points with a true class that received it."""
    transfer: Transfer
    """The label of each point, and lambda."""
    points: int
    """How many points have a true class."""

    def __str__(self) -> str:
        return f"agreement {self.agreement:.3f} ({SURFACE_PROTOCOL.split(':')[0]}, {self.points:,} points)"

    def to_json(self) -> dict[str, object]:
        """The report as plain values."""
        return {
            "protocol": SURFACE_PROTOCOL,
            "agreement": self.agreement,
            "distance": self.transfer.distance,
            "distance from": self.transfer.how,
            "labelled": self.transfer.labelled,
            "points": self.points,
        }


def score_surface(
    means: Tensor,  # [N, 3]
    labels: Tensor,  # [N] int64, -1 = none
    points: Tensor,  # [P, 3]
    truth: Tensor,  # [P] int64, -1 = not scored
) -> SurfaceReport:
    """Carry the labels of Gaussians to surface points, and compare (protocol `kfgs-surface/1`).

    If no Gaussian has a label, no point receives one, and the agreement is 0.

    Raises:
        ValueError: if shapes disagree, or no point has a true class.
    """
    check_shapes(("points", points, "P 3"), ("truth", truth, "P"))
    scored = truth >= 0
    if not bool(scored.any()):
        raise ValueError(f"truth: expected some point with a class, got none among {len(truth)}; are these its labels?")
    moved = nearest_labels(means, labels, points)
    right = moved.labels.to(truth.device) == truth
    return SurfaceReport(float(right[scored].to(torch.float32).mean()), moved, int(scored.sum()))
