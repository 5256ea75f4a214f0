"""Occam's LGS: each view gives a Gaussian one feature, that of the pixel of its centre, weighted by what it shows there.

The weight is T alpha at the pixel whose centre c satisfies 0 <= m - c < 1 for the projected mean m, so at floor(m - 0.5); the
feature is that at floor(m), so the two may be a pixel apart. Gaussians that never show at their own centre are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

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

    medium = short


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


def centre_average(
    geometry: Gaussians, cameras: Sequence[Camera], maps: KeptMaps
) -> tuple[Tensor, Tensor]:  # [N, D], [N]
    """The weighted mean of the unit features at the centres, and the sum of the weights."""
    sums, weights = torch.zeros(len(geometry), int(maps[0].shape[2])), torch.zeros(len(geometry))
    for i, camera in enumerate(cameras):
        index, weight, pixel = centre_weights(geometry, camera)
        places = map_places(pixel, camera.size, (maps[i].shape[0], maps[i].shape[1]))
        _add(maps[i].contiguous().numpy(), places.numpy(), index.numpy(), weight.numpy(), sums.numpy(), weights.numpy())
    return sums.div_(weights[:, None] + WEIGHT_EPS), weights


def map_places(pixel: Tensor, size: tuple[int, int], cells: tuple[int, int]) -> Tensor:  # [M, 2] int64 -> [M, 2]
    """Where the centres of pixels (row, column) of a picture lie among the cells of a map, as `resize_map` has it."""
    scale = torch.tensor(cells) / torch.tensor(size)
    return torch.minimum(((pixel + 0.5) * scale - 0.5).clamp_min(0), torch.tensor(cells) - 1.0)


@numba.njit(cache=True, parallel=True)
def _add(map, places, index, weight, sums, weights):  # type: ignore[no-untyped-def]
    """Add a map's unit features at some places, bilinearly, to the sums of some Gaussians; no index comes twice."""
    h, w, D = map.shape
    for m in numba.prange(len(index)):
        top, left = int(places[m, 0]), int(places[m, 1])
        below, right = min(top + 1, h - 1), min(left + 1, w - 1)
        down, across = places[m, 0] - top, places[m, 1] - left
        feature = np.empty(D, np.float32)
        squares = 0.0
        for c in range(D):
            upper = (1 - across) * map[top, left, c] + across * map[top, right, c]
            lower = (1 - across) * map[below, left, c] + across * map[below, right, c]
            feature[c] = (1 - down) * upper + down * lower
            squares += feature[c] * feature[c]
        if squares > 0:
            weights[index[m]] += weight[m]
            share = weight[m] / np.sqrt(squares)
            for c in range(D):
                sums[index[m], c] += share * feature[c]


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
