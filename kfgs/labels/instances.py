"""Things of one class told apart ("the five chairs"), by what views show and by distance.

Distance alone does not tell: two chairs that touch are one part, and a distance that parts them breaks a third. In most
pictures they are apart. So the pixels of a view are cut into pieces: connected pixels of one class without a jump in depth.
Gaussians belong to one thing if they are more often in one piece than in two. PairGS (arXiv 2607.01140) compares pairs of
Gaussians in this way, with the masks of a network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.cluster.hierarchy import cophenet, linkage
from scipy.spatial.distance import pdist, squareform
from skimage.measure import label as connected_pixels

from .._arrays import Array
from ..cameras import Camera, as_cameras
from ..gaussians import Gaussians
from ..splat.rasterize import rasterize
from ..splat.views import sum_pixels
from .components import SPECK, cells, largest_first, part_distance, spacing
from .transfer import INSTANCE, as_cloud, positions

SIDE, VIEWS = 200, 30  # pixels of a view's longer side, and how many views are compared
JUMP, PIECE = 0.1, 8  # two surfaces differ by more than 10 % in depth; a piece has at least 8 pixels
CELLS = 250  # Gaussians of a class are compared in at most so many cells
SMALL = 0.25  # a part below this share of the largest belongs to what it touches, as a leg to its table


def number_instances(gaussians: Any, cameras: Sequence[Camera]) -> Gaussians:
    """Number the things of each class, the largest 1, in the column `extra["instance"]`; 0 is none.

    `connected_parts` counts by this column; edits and PLY files keep it. 50,000 Gaussians take about 3 seconds.

    Args:
        gaussians: a field, or labelled Gaussians.
        cameras: undistorted views, such as those that the field was trained on; at most 30 of them are compared. A ValueError
            if there is none.
    """
    cloud = as_cloud(gaussians, labelled=True)
    cameras = as_cameras(cameras, "connected_parts goes by distance alone")
    assert cloud.labels is not None
    labels, means = cloud.labels.cpu().numpy(), positions("gaussians.means", cloud.means)
    cell, grids, whole = np.zeros(len(labels), np.int64), {}, spacing(means)
    for label in np.unique(labels[labels >= 0]).tolist():
        own = labels == label
        size = part_distance(means[own], whole)
        while len((grid := cells(means[own], size))[1]) > CELLS:
            size *= 1.25
        cell[own], centres = grid
        grids[label] = own, centres / size, np.zeros((2, len(centres), len(centres)))
    for camera in (camera.fitted(SIDE) for camera in cameras[:: -(-len(cameras) // VIEWS)] if grids):
        kind, piece = _pieces(cloud, camera)
        names, first, piece = np.unique(piece, return_index=True, return_inverse=True)
        signal = torch.eye(len(names)).to(cloud.means)[torch.from_numpy(piece).reshape(camera.size)][..., names > 0]
        index, shares, _ = (part.cpu().numpy() for part in sum_pixels(cloud, camera, signal))
        for label, (_, _, table) in grids.items():
            own, its = labels[index] == label, kind.ravel()[first[names > 0]] == label
            shown = np.zeros((table.shape[1], its.sum()))
            np.add.at(shown, cell[index[own]], shares[own][:, its])
            shown /= np.maximum(shown.sum(1), 1)[:, None]  # a view counts once, or less if it shows less than a pixel
            table += shown @ shown.T, np.outer(shown.sum(1), shown.sum(1))
    numbers = np.zeros(len(labels), np.float32)  # as `class_id` in files: some importers skip no other columns
    for own, centres, (together, seen) in grids.values():
        part = largest_first(_join(together, seen, centres, np.bincount(cell[own]))[cell[own]])
        large = np.bincount(part) >= SPECK * (part == 0).sum()
        numbers[own] = np.where(large[part], part + 1, 0)
    return cloud.replace(extra={**cloud.extra, INSTANCE: numbers})


def _pieces(cloud: Gaussians, camera: Camera) -> tuple[Array, Array]:  # [H, W], [H, W]
    """The class of each pixel, and its piece: connected pixels of one class without a jump in depth; 0 = none, too small."""
    assert cloud.labels is not None
    present, place = cloud.labels.unique(return_inverse=True)
    shown = rasterize(cloud.replace(features=torch.eye(len(present)).to(cloud.means)[place]), camera)
    kind = present[shown.map.argmax(-1)].masked_fill(shown.alpha < 0.5, -1).cpu().numpy()
    steps = np.log(shown.depth.clamp(min=1e-9).cpu().numpy())
    down, right = (np.abs(np.diff(steps, axis=axis)) > JUMP for axis in (0, 1))
    kind[:-1][down] = kind[:, :-1][right] = -1
    piece = connected_pixels(kind, background=-1, connectivity=1)
    return kind, np.where(np.bincount(piece.ravel())[piece] < PIECE, 0, piece)


def _join(together: Array, seen: Array, centres: Array, count: Array) -> Array:  # [S, S] x 2, [S, 3], [S] -> [S]
    """Join the two parts with the largest share of views together, down to one half; then small ones to what they touch."""
    number, near = np.arange(len(count)), np.ones((len(count),) * 2)
    if len(count) > 1:  # 1: connected by gaps of one cell; 0: by none below two
        near = np.clip(2 - squareform(cophenet(linkage(centres, "single"))), 0, 1)
    own = np.clip(seen.diagonal(), 1e-9, 1)
    once = np.outer(own, own)  # that two are near counts as one more view; of those that
    together = together + (near - 1e-6 * squareform(pdist(centres))) * once  # no view shows, the nearest are joined
    seen, touch, count = seen + once, near == 1, count.astype(float)
    while True:
        rate = together / seen
        rate[:, count == 0] = rate[count == 0] = -1  # what was joined to another
        np.fill_diagonal(rate, -1)
        i, j = np.unravel_index(rate.argmax(), rate.shape)
        if rate[i, j] < 0.5:
            rate[~touch] = -1
            small = (count > 0) & (count < SMALL * count.max()) & (rate.max(1) >= 0)
            if not small.any():
                return number
            j = np.where(small, count, np.inf).argmin()
            i = rate[j].argmax()
        number[number == j] = i
        count[i], count[j] = count[i] + count[j], 0
        for table in (together, seen, touch):
            table[i] += table[j]
            table[:, i] = table[i]
