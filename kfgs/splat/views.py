"""Carry values from views to Gaussians: the mean of numbers, or a vote of classes, over the pixels that show a Gaussian.

A Gaussian's latent is trained only in blends with its neighbours, so it may decode to something that no view shows. Its
rendering weights w = T alpha measure how much each pixel shows it. Summing over pixels with these weights is the transpose
of Eq. 3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_range
from ..cameras import Camera
from ..gaussians import Gaussians, check_gaussians
from .engines import accumulate_pixels
from .project import project
from .tiles import bin_tiles

MIN_SHARE = 0.7
"""A class needs 70 % of the votes. Gaussians with less lie across a border: in the toy room about 65 % of those with a
share below 0.8 had the right class, and about 95 % of the others."""


class ViewAverage(NamedTuple):
    """For each Gaussian, the mean of what the pixels that show it hold."""

    values: Tensor  # [N, C] mean over the pixels, weighted by how much each shows the Gaussian; 0 if none does
    weights: Tensor  # [N] the number of pixels, in all views, that the Gaussian fills

    def __repr__(self) -> str:
        return short_repr(self)


class ViewVotes(NamedTuple):
    """The outcome of a vote."""

    labels: Tensor  # [N] int64, -1 = no view shows this Gaussian, or the views do not agree on it
    shares: Tensor  # [N] the winner's share of the votes, 0 if there were none
    weights: Tensor  # [N] votes cast: the number of pixels with a label, in all views, that the Gaussian fills

    def __repr__(self) -> str:
        return short_repr(self)


def sum_pixels(
    gaussians: Gaussians,
    camera: Camera,
    signal: Tensor,  # [H, W, C] of the camera's size
    *,
    engine: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # [M] int64, [M, C], [M]
    """The Gaussians that a view shows, and for each the weighted sum of the signal and the sum of the weights."""
    projected = project(gaussians, camera, engine=engine)
    tiles = bin_tiles(projected, camera.width, camera.height, engine=engine)
    footprints = projected.means2d, projected.conics, projected.opacities
    return projected.index, *accumulate_pixels(*footprints, signal, tiles, engine=engine)


def average_views(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, Tensor]],  # maps [H, W, C] of the cameras' sizes
    *,
    engine: str = "auto",
) -> ViewAverage:
    """Average a per-pixel signal over the pixels that show each Gaussian, with its rendering weights w = T alpha.

    Args:
        gaussians: a cloud; only its geometry and opacity are used.
        views: cameras with a map each, all of one number of channels; read one at a time.
        engine: compositing engine.

    Raises:
        ValueError: if there is no view, or a map has another size than its camera or other channels than the first.
    """
    check_gaussians(gaussians)
    sums, weights = None, torch.zeros(len(gaussians)).to(gaussians.means)
    with torch.no_grad():
        for camera, signal in views:
            channels = signal.shape[-1] if sums is None else sums.shape[1]
            if tuple(signal.shape) != (*camera.size, channels):
                raise ValueError(
                    f"views: expected a map {(*camera.size, channels)} for camera {camera.name!r}, got "
                    f"{tuple(signal.shape)}; resize it with resize_map"
                )
            index, total, weight = sum_pixels(gaussians, camera, signal.to(gaussians.means), engine=engine)
            sums = torch.zeros(len(gaussians), channels).to(gaussians.means) if sums is None else sums
            sums.index_add_(0, index, total)
            weights.index_add_(0, index, weight)
    if sums is None:
        raise ValueError("views: expected at least one camera, got none; pass those that the field was trained on")
    return ViewAverage(divide_sums(sums, weights[:, None]), weights)


def vote_labels(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, Tensor]],  # label maps [H, W] int64 of the cameras' sizes, -1 = none
    classes: int,
    *,
    min_share: float = MIN_SHARE,
    engine: str = "auto",
) -> ViewVotes:
    """Label each Gaussian with the class that most of its rendering weight falls on. Ties go to the lowest class.

    Args:
        gaussians: a cloud; only its geometry and opacity are used.
        views: cameras with a label map each; read one at a time.
        classes: number of classes C; labels are below it.
        min_share: a winner with a smaller share of the votes gives no label; 0 labels every Gaussian that is shown.
        engine: compositing engine.

    Raises:
        ValueError: if a label map has another size than its camera, or a label is not below `classes`.
    """
    check_gaussians(gaussians)
    check_range("classes", classes, 1)
    check_range("min_share", min_share, 0, 1)
    votes = torch.zeros(len(gaussians), classes).to(gaussians.means)
    with torch.no_grad():
        for camera, labels in views:
            if tuple(labels.shape) != camera.size or int(labels.max()) >= classes:
                raise ValueError(
                    f"views: expected labels below {classes} (classes) of the camera's size {camera.size} "
                    f"({camera.name!r}), got {tuple(labels.shape)} up to {int(labels.max())}; resize_labels resizes them"
                )
            ballots = torch.nn.functional.one_hot(labels + 1, classes + 1)[..., 1:].to(votes)
            index, total, _ = sum_pixels(gaussians, camera, ballots, engine=engine)
            votes.index_add_(0, index, total)
    weights = votes.sum(1)
    best, labels = votes.max(1)
    shares = divide_sums(best, weights)
    return ViewVotes(torch.where((weights > 0) & (shares >= min_share), labels, -1), shares, weights)


def divide_sums(sums: Tensor, weights: Tensor) -> Tensor:
    """Means of sums; 0 without weight."""
    return sums / weights.clamp_min(torch.finfo(weights.dtype).tiny)
