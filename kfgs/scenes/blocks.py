"""Cut a large scene into blocks: boxes that fill space, each with the views that see it and all that lies between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .._check import check_whole
from .._files import atomic_folder
from ..cameras.paths import robust_bounds
from .colmap_model import ColmapModel
from .files import MAX_NUMBER, SceneError

Array = NDArray[np.float64]
Box = list[list[float]]  # low and high corner, world units
MARGIN = 0.05  # of the reach's size, added on each side: Gaussians are larger than their centres
SHARE = 0.01  # an image belongs to a block if at least this share of the points that it sees lie in the core


@dataclass(frozen=True)
class Block:
    """A box of space, and what a field of it needs.

    The cores of all blocks fill space without overlap. Whatever can stand between a camera and the core lies in the box around
    both, `reach`. So Gaussians of the reach and the block's views say about the core what the whole scene would say.
    """

    name: str
    core: Box  # up to `MAX_NUMBER` at the border of the scene; low <= x < high lies inside
    reach: Box  # the box around the core's points and the cameras that see them, with a margin
    views: list[str]  # names of the images that see the core

    def holds(self, means: NDArray[Any]) -> NDArray[np.bool_]:  # [N, 3] -> [N]
        """Which points lie in the core."""
        low, high = np.array(self.core)
        return np.asarray(((means >= low) & (means < high)).all(1))

    def needs(self, means: NDArray[Any], radii: NDArray[Any]) -> NDArray[np.bool_]:  # [N, 3], [N] -> [N]
        """Which balls lie in the core or touch the reach."""
        low, high = np.array(self.reach)
        near = ((means + radii[:, None] >= low) & (means - radii[:, None] <= high)).all(1)
        return np.asarray(near | self.holds(means))


def partition(model: ColmapModel, count: int) -> list[Block]:
    """Cut a scene into blocks with about equally many points, at medians along the longest side of each part.

    The tracks of the model say which image sees which point.
    """
    check_whole("count", count, 1)
    ids, images = model.point_ids, [image for image in model.images.values() if image.pose is not None]
    seen = [np.searchsorted(ids, image.observed[np.isin(image.observed, ids)]) for image in images]
    if not any(len(rows) for rows in seen):
        raise SceneError("model: expected images that say which points they see, got none; make it with `kfgs sfm`")
    inside = robust_bounds(torch.from_numpy(model.points)).inside.numpy()
    if inside.sum() < count:
        raise SceneError(f"count: expected at most a block per point ({len(model.points)}), got {count}; ask for fewer")
    centers = np.array([-image.pose[:3, :3].T @ image.pose[:3, 3] for image in images if image.pose is not None])
    blocks = []
    for number, core in enumerate(_cut(model.points[inside], np.array([[-MAX_NUMBER] * 3, [MAX_NUMBER] * 3]), count)):
        name, low, high = f"block{number:0{max(2, len(str(count - 1)))}d}", *core
        own = ((model.points >= low) & (model.points < high)).all(1)
        shares = np.array([own[rows].mean() if len(rows) else 0.0 for rows in seen])
        chosen = np.flatnonzero((shares >= SHARE) & (shares > 0))
        if len(chosen) == 0:
            raise SceneError(f"{name}: expected images that see this part of the scene, got none; ask for fewer blocks")
        near = np.concatenate([model.points[own & inside], centers[chosen]])
        pad = MARGIN * np.ptp(near, axis=0)
        reach = [(near.min(0) - pad).tolist(), (near.max(0) + pad).tolist()]
        blocks.append(Block(name, core.tolist(), reach, [images[i].name for i in chosen]))
    return blocks


def write_part(folder: Path, model: ColmapModel, names: Sequence[str]) -> None:
    """Write a COLMAP model with some of the images of another, and the points that at least two of them see; no 2-D points."""
    images = {key: image for key, image in model.images.items() if image.name in set(names)}
    seen, counts = np.unique(np.concatenate([np.unique(i.observed) for i in images.values()]), return_counts=True)
    kept = np.isin(model.point_ids, seen[counts > 1])
    cameras, views = {i.camera_id: model.cameras[i.camera_id] for i in images.values()}, list[str]()
    for key, image in images.items():
        assert image.pose is not None  # of an image that sees a block
        x, y, z, w = Rotation.from_matrix(image.pose[:3, :3]).as_quat().tolist()
        numbers = " ".join(map(repr, (w, x, y, z, *image.pose[:3, 3].tolist())))
        views.append(f"{key} {numbers} {image.camera_id} {image.name}\n\n")
    lenses = [f"{k} {c.model} {c.width} {c.height} {' '.join(map(repr, c.params))}\n" for k, c in cameras.items()]
    with atomic_folder(folder) as place:
        (place / "images.txt").write_text("".join(views), encoding="utf-8")
        (place / "cameras.txt").write_text("".join(lenses))
        rows = np.column_stack([model.point_ids[kept], model.points[kept], model.colors[kept]])
        np.savetxt(place / "points3D.txt", rows, "%d %.17g %.17g %.17g %d %d %d 0")


def _cut(points: Array, box: Array, count: int) -> list[Array]:  # [P, 3], [2, 3] -> count x [2, 3]
    """Boxes that fill a box and hold about equally many points."""
    if count == 1:
        return [box]
    first, axis = count // 2, int(np.argmax(np.ptp(points, axis=0)))
    order = np.sort(points[:, axis])
    at = min(len(points) - 1, max(1, round(len(points) * first / count)))
    lower, upper = box.copy(), box.copy()
    lower[1, axis] = upper[0, axis] = (order[at - 1] + order[at]) / 2
    below = points[:, axis] < lower[1, axis]
    if not 0 < below.sum() < len(points):
        raise SceneError(f"count: expected points at different places, too many are at one; ask for fewer than {count}")
    return [*_cut(points[below], lower, first), *_cut(points[~below], upper, count - first)]
