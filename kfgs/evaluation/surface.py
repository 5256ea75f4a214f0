"""How well the labels of Gaussians reach the surfaces of a scene: points of them with known classes."""

from __future__ import annotations

from torch import Tensor

from .._check import check_shapes
from ..labels import nearest_labels
from .report import Report

NAME, ABOUT = (
    "kfgs-surface/1",
    "share of the ground-truth surface points, each seen by some training view, that receive their true class from the "
    "nearest labelled Gaussian within lambda; points out of reach count as wrong",
)


def score_surface(
    means: Tensor,  # [N, 3]
    labels: Tensor,  # [N] int64, -1 = none
    points: Tensor,  # [P, 3]
    truth: Tensor,  # [P] int64, -1 = not scored
) -> Report:
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
    agreement = float((moved.labels.to(truth.device) == truth)[scored].float().mean())
    row = {"lambda": moved.distance, "labelled": moved.labelled, "points": int(scored.sum())}
    return Report(NAME, {"agreement": agreement}, (row,), about=ABOUT)
