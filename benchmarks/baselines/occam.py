"""Occam's LGS: each view gives a Gaussian one feature, that of the pixel of its centre, weighted by what it shows there.

The weight is T alpha at the pixel whose centre c satisfies 0 <= m - c < 1 for the projected mean m, so at floor(m - 0.5); the
feature is that at floor(m), so the two may be a pixel apart. Gaussians that never show at their own centre are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from kfgs._rows import unit_rows
from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import bin_tiles, project
from kfgs.splat.engines.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from .common import FLOAT, Clock, Fitted, KeptMaps, Task, within
from .methods import LinearDecoder, RenderedMethod

WEIGHT_EPS = 1e-15


@dataclass(frozen=True)
class OccamConfig:
    """One pass over the views; there is no schedule to shorten."""

    pixels: int | None = None
    """Most pixels of a view; None takes the camera's size."""

    @staticmethod
    def published() -> OccamConfig:
        """Views at the pictures' size."""
        return OccamConfig()

    @staticmethod
    def short() -> OccamConfig:
        """The same."""
        return OccamConfig()


def centre_weights(
    geometry: Gaussians, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:  # [M] int64, [M], [M, 2] int64
    """T alpha of each visible Gaussian at the pixel of its centre, and the pixel (row, column) of its feature.

    Left out are Gaussians whose centre pixel lies outside the picture, that are fainter than 1/255 there, or behind a pixel
    that is already opaque.
    """
    projected = project(geometry, camera)
    tiles = bin_tiles(projected, camera.width, camera.height)
    place = projected.means2d.double()
    pixel, source = (place - 0.5).floor().long(), place.floor().long()
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixel >= 0) & (pixel < size)).all(dim=1)
    weights = _walk(
        projected.means2d.numpy(), projected.conics.numpy(), projected.opacities.numpy(), pixel.numpy(),
        inside.numpy(), tiles.rows.numpy(), tiles.offsets.numpy(), -(-camera.width // tiles.tile_size), tiles.tile_size,
    )  # fmt: skip
    found = torch.from_numpy(weights)
    kept = found > 0
    source = torch.minimum(source.clamp_min(0), size - 1)
    return projected.index[kept], found[kept], source[kept].flip(1)


@numba.njit(cache=True, parallel=True)
def _walk(means, conics, opacities, pixels, inside, rows, offsets, columns, side):  # type: ignore[no-untyped-def]
    """For each Gaussian, composite its centre pixel front to back until it is reached; in single precision, as engines do."""
    weights = np.zeros(len(means), np.float32)
    for i in numba.prange(len(means)):
        if not inside[i]:
            continue
        tile = (pixels[i, 1] // side) * columns + pixels[i, 0] // side
        left = np.float32(1)
        for k in range(offsets[tile], offsets[tile + 1]):
            j = rows[k]
            dx, dy = pixels[i, 0] + 0.5 - means[j, 0], pixels[i, 1] + 0.5 - means[j, 1]
            power = conics[j, 0] * dx * dx + 2 * conics[j, 1] * dx * dy + conics[j, 2] * dy * dy
            alpha = np.float32(min(ALPHA_MAX, opacities[j] * np.exp(-0.5 * power)))
            if alpha < ALPHA_MIN:
                continue
            after = np.float32(left * (np.float32(1) - alpha))
            if after < np.float32(TRANSMITTANCE_MIN):
                break
            if j == i:
                weights[i] = left * alpha
                break
            left = after
    return weights


def centre_average(geometry: Gaussians, cameras: list[Camera], maps: KeptMaps) -> tuple[Tensor, Tensor]:  # [N, D], [N]
    """The weighted mean of the unit features at the centres, and the sum of the weights."""
    sums, weights = torch.zeros(len(geometry), int(maps[0].shape[2])), torch.zeros(len(geometry))
    for i, camera in enumerate(cameras):
        index, weight, pixel = centre_weights(geometry, camera)
        features = unit_rows(sample_map(maps[i], pixel, camera.size))
        weight = weight * features.any(dim=1)
        weights.index_add_(0, index, weight)
        sums.index_add_(0, index, weight[:, None] * features)
    return sums.div_(weights[:, None] + WEIGHT_EPS), weights


def sample_map(map: Tensor, pixel: Tensor, size: tuple[int, int]) -> Tensor:  # [h, w, D], [M, 2], (H, W) -> [M, D]
    """A map at the size of the picture, bilinearly, at some of its pixels (row, column): no large map is made."""
    h, w, D = map.shape
    flat, found = map.reshape(h * w, D), 0
    rows, columns = ((pixel[:, axis] + 0.5) * (map.shape[axis] / size[axis]) - 0.5 for axis in (0, 1))
    rows, columns = rows.clamp(0, h - 1), columns.clamp(0, w - 1)
    top, left = rows.floor().long(), columns.floor().long()
    for down in (0, 1):
        for right in (0, 1):
            r, c = (top + down).clamp_max(h - 1), (left + right).clamp_max(w - 1)
            share = (1 - (rows - top - down).abs()) * (1 - (columns - left - right).abs())
            found = found + share.clamp_min(0).to(map)[:, None] * flat[r * w + c]
    return found


def storage_bytes(gaussians: int, channels: int) -> int:
    """The features of the Gaussians that are kept."""
    return FLOAT * gaussians * channels


def fit(task: Task, config: OccamConfig) -> Fitted:
    """Average features onto a frozen cloud, and drop what was never seen at its centre."""
    clock, frozen, maps = Clock(), task.frozen, KeptMaps(task.maps)
    cameras = [within(camera, config.pixels) for camera in task.cameras]
    with clock.stage("uplift"):
        features, weights = centre_average(frozen, cameras, maps)
    kept = weights > 0
    cloud = frozen.select(kept).replace(features=features[kept])
    channels = int(features.shape[1])
    tensors = {"features": features[kept], "kept": kept}
    method = RenderedMethod("Occam's LGS", cloud, LinearDecoder())
    return Fitted(method, str(channels), storage_bytes(len(cloud), channels), tensors, clock.seconds)
