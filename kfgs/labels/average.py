"""What the views say about each Gaussian, as a number: the mean of a per-pixel signal over the pixels it fills."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from ..cameras import Camera
from ..gaussians import Gaussians
from ..splat import accumulate_pixels, bin_tiles, project


class ViewAverage(NamedTuple):
    """A signal carried from pixels to Gaussians."""

    values: Tensor  # [N, C] mean over the pixels, weighted by how much each shows the Gaussian; 0 where none does
    weights: Tensor  # [N] the number of pixels, in all views, that the Gaussian fills


def sum_pixels(
    gaussians: Gaussians,
    camera: Camera,
    signal: Tensor,  # [H, W, C] of the camera's size
    *,
    engine: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # [M] int64, [M, C], [M]
    """The Gaussians that one view shows, and for each the signal's sum over its pixels and the sum of its weights."""
    projected = project(gaussians, camera, engine=engine)
    tiles = bin_tiles(projected, camera.width, camera.height, engine=engine)
    shape = projected.means2d, projected.conics, projected.opacities
    return projected.index, *accumulate_pixels(*shape, signal, tiles, engine=engine)


def average_views(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, Tensor]],  # maps [H, W, C] of the cameras' sizes
    *,
    engine: str = "auto",
) -> ViewAverage:
    """Average a per-pixel signal over the pixels that show each Gaussian, with its rendering weights w = T alpha.

    The transpose of Eq. 3, as in `vote_labels`, for numbers instead of classes (training-free uplifting).

    Args:
        gaussians: a cloud; only its geometry and opacity are used.
        views: cameras with a map each, of one number of channels; read one at a time.
        engine: compositing engine.

    Raises:
        ValueError: if there is no view, or a map has another size than its camera or other channels than the first.
    """
    sums, weights = None, torch.zeros(len(gaussians)).to(gaussians.means)
    with torch.no_grad():
        for camera, signal in views:
            channels = signal.shape[-1] if sums is None and signal.ndim else 0 if sums is None else sums.shape[1]
            if tuple(signal.shape) != (*camera.size, channels):
                raise ValueError(
                    f"views: expected a map {(*camera.size, channels)} for camera {camera.name!r}, got "
                    f"{tuple(signal.shape)}; resize it with resize_map"
                )
            if sums is None:
                sums = torch.zeros(len(gaussians), channels).to(gaussians.means)
            index, total, weight = sum_pixels(gaussians, camera, signal.to(sums), engine=engine)
            sums.index_add_(0, index, total)
            weights.index_add_(0, index, weight)
    if sums is None:
        raise ValueError("views: expected at least one camera, got none; pass those that the field was trained on")
    return ViewAverage(sums / weights.clamp_min(torch.finfo(weights.dtype).tiny)[:, None], weights)
