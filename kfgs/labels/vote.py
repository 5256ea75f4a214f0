"""The class of each Gaussian by a vote of views: what the pixels that show it say, weighted by how much they show it.

A Gaussian's own latent is trained only through blends with its neighbours, so it may decode to something that none of
the views shows. Its rendering weights w = T * alpha say which pixels it answers for (the transpose of Eq. 3); adding
up w per class over some views, and taking the largest, uses them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from .._check import check_range
from ..cameras import Camera
from ..gaussians import Gaussians
from .average import sum_pixels

MIN_SHARE = 0.7
"""A class needs seven votes in ten. Gaussians with less lie across a border: in the toy room about 65 % of those with a
share below 0.8 had the right class, and about 95 % of the others."""


class Votes(NamedTuple):
    """The outcome of a vote."""

    labels: Tensor  # [N] int64, -1 = no view shows this Gaussian, or the views do not agree on it
    shares: Tensor  # [N] of the winner in the votes cast, 0 where none were
    weights: Tensor  # [N] votes cast: the number of pixels, in all views, that the Gaussian fills


def vote_labels(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, Tensor]],  # label maps [H, W] int64 of the cameras' sizes, -1 = none
    classes: int,
    *,
    min_share: float = MIN_SHARE,
    engine: str = "auto",
) -> Votes:
    """Label each Gaussian with the class that most of its rendering weight falls on.

    Args:
        gaussians: a cloud; only its geometry and opacity are used.
        views: cameras with a label map each; read one at a time.
        classes: number of classes C; labels are below it.
        min_share: a winner with a smaller share of the votes gives no label; 0 labels every Gaussian that is shown.
        engine: compositing engine.

    Returns:
        Labels, the winner's share, and the weight. Ties go to the lowest class.

    Raises:
        ValueError: if a label map has another size than its camera, or a label is not below `classes`.
    """
    check_range("classes", classes, 1)
    check_range("min_share", min_share, 0, 1)
    votes = torch.zeros(len(gaussians), classes).to(gaussians.means)
    with torch.no_grad():
        for camera, labels in views:
            if tuple(labels.shape) != camera.size:
                raise ValueError(
                    f"views: expected a label map of the camera's size {camera.size} ({camera.name!r}), got "
                    f"{tuple(labels.shape)}; resize it with resize_labels"
                )
            if int(labels.max()) >= classes:
                raise ValueError(f"views: expected labels below {classes} (classes), got {int(labels.max())}")
            ballots = torch.nn.functional.one_hot(labels + 1, classes + 1)[..., 1:].to(votes)
            index, total, _ = sum_pixels(gaussians, camera, ballots, engine=engine)
            votes.index_add_(0, index, total)
    weights = votes.sum(1)
    best, labels = votes.max(1)
    shares = best / weights.clamp_min(torch.finfo(weights.dtype).tiny)
    return Votes(torch.where((weights > 0) & (shares >= min_share), labels, -1), shares, weights)
