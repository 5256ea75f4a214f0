"""The best classes of each pixel from what each Gaussian says about them.

Blending is linear. So where a pixel's class follows from blended features, K numbers per Gaussian are blended in place of the
features, and the largest is kept while they are: nothing of [H, W, D] or [H, W, K] is in memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._rows import row_norms
from ..cameras import Camera
from ..gaussians import Gaussians
from ..labels.scores import LOGIT_SCALE
from ..splat import Ranked, rasterize_labels

LEAST_SHARE = 1e-30
"""A smaller share of a vote counts as none: blended, it would be a denormal number, with which a CPU takes ten times as long."""


class Votes(NamedTuple):
    """What the Gaussians say about some classes."""

    classes: Tensor  # [W] int64, which
    shares: Tensor  # [N, W], positive; 0 of a Gaussian about which nothing is known


def divide_votes(cosines: Tensor, known: Tensor) -> Votes:  # [N, C], [N] bool
    """Each Gaussian divides one vote among the classes: the softmax of 100 times the cosines, CLIP's scale.

    A class that no Gaussian prefers gets no vote: it would win pixels where it is second everywhere.
    """
    classes = cosines.argmax(dim=1)[known].unique()
    shares = torch.softmax(LOGIT_SCALE * cosines[:, classes], dim=1) * known[:, None]
    return Votes(classes, torch.nn.functional.threshold(shares, LEAST_SHARE, 0))


def similarity_votes(features: Tensor, rows: Tensor) -> Votes:  # [N, d], [C, d]
    """Dot products with the classes: the largest of the blended ones is that of the blended feature.

    The same number is added for all classes, twice the feature's length: it changes no order, and makes all positive.
    """
    shares = features @ rows.T + 2 * row_norms(features)[:, None]
    return Votes(torch.arange(len(rows), device=shares.device), shares)


def rank_votes(gaussians: Gaussians, camera: Camera, votes: Votes, top: int = 1, *, early: bool = False) -> Ranked:
    """The classes with most votes at each pixel; votes are blended like colours. Beyond the classes voted for: -1, 0.

    `early` is that of `rasterize_labels`.
    """
    if not len(votes.classes):  # nothing is known about any Gaussian: no votes for one class, and the opacity
        votes = Votes(votes.classes.new_zeros(1), votes.shares.new_zeros(len(votes.shares), 1))
    count = min(top, len(votes.classes))
    with torch.no_grad():
        shown = gaussians.replace(features=votes.shares, sh=None)
        labels, scores, alphas = rasterize_labels(shown, camera, top=count, early=early)
        if len(votes.classes) <= int(votes.classes[-1]):  # else they are all classes, in order
            labels = votes.classes[labels]
        labels.masked_fill_(scores <= 0, -1)
    if count < top:
        labels = torch.nn.functional.pad(labels, (0, top - count), value=-1)
        scores = torch.nn.functional.pad(scores, (0, top - count))
    return Ranked(labels, scores, alphas)
