"""Cut a large scene into blocks: boxes that fill space, each with the views that see it and all that lies between."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._check import check_range, check_whole
from .._files import as_path, atomic_folder
from ..cameras.bounds import robust_bounds
from .colmap_model import ColmapModel, read_model
from .files import SceneError
from .pycolmap_import import quiet_pycolmap, scene_errors

Array = NDArray[np.float64]
MARGIN = 0.05  # of the reach's size, added on each side: Gaussians are larger than their centres


@dataclass(frozen=True)
class Block:
    """A box of space, and what a field of it needs.

    The cores of all blocks fill space without overlap: a point lies in exactly one. Whatever can stand between a camera and the
    core lies in the box around both, `reach`. So Gaussians of the reach and the block's views say about the core's
    Gaussians what the whole scene would say.
    """

    name: str
    core: tuple[tuple[float, ...], tuple[float, ...]]
    """Low and high corner, world units; infinite at the border of the scene. low <= x < high lies inside."""
    reach: tuple[tuple[float, ...], tuple[float, ...]]
    """The box around the core's points and the cameras that see them, with a margin."""
    views: tuple[str, ...]
    """Names of the images that see the core."""

    def holds(
        self,
        means: NDArray[Any],  # [N, 3]
    ) -> NDArray[np.bool_]:  # [N]
        """Which points lie in the core."""
        low, high = np.array(self.core)
        return np.asarray(((means >= low) & (means < high)).all(1))

    def needs(
        self,
        means: NDArray[Any],  # [N, 3]
        radii: NDArray[Any],  # [N]
    ) -> NDArray[np.bool_]:  # [N]
        """Which balls lie in the core or touch the reach."""
        low, high = np.array(self.reach)
        near = ((means + radii[:, None] >= low) & (means - radii[:, None] <= high)).all(1)
        return np.asarray(near | self.holds(means))

    def to_json(self) -> dict[str, Any]:
        """As JSON; an infinite coordinate is null."""
        core = [[value if math.isfinite(value) else None for value in corner] for corner in self.core]
        return {
            "name": self.name,
            "core": core,
            "reach": [list(corner) for corner in self.reach],
            "views": list(self.views),
        }

    @staticmethod
    def from_json(value: dict[str, Any]) -> Block:
        """The inverse of `to_json`."""
        low, high = value["core"]
        core = (
            tuple(-math.inf if x is None else float(x) for x in low),
            tuple(math.inf if x is None else float(x) for x in high),
        )
        reach = tuple(map(float, value["reach"][0])), tuple(map(float, value["reach"][1]))
        return Block(str(value["name"]), core, reach, tuple(map(str, value["views"])))


def partition(
    model: ColmapModel | str | Path,
    count: int,
    *,
    share: float = 0.01,
) -> list[Block]:
    """Cut a scene into blocks with about equally many points, at medians along the longest side of each part.

    The tracks of the model say which image sees which point.

    Args:
        model: a COLMAP model, or its folder.
        count: of blocks.
        share: an image belongs to a block if at least this share of the points that it sees lie in the core.

    Returns:
        The blocks, named block00, block01, ...

    Raises:
        SceneError: if the model has no tracks, or fewer points than blocks, or a block is seen by no image.
    """
    found = model if isinstance(model, ColmapModel) else read_model(model)
    check_whole("count", count, 1)
    check_range("share", share, 0, 1, closed=(True, False))
    images = [image for image in found.images.values() if image.pose is not None]
    ids = found.point_ids.astype(np.int64)
    seen = [np.searchsorted(ids, image.observed[np.isin(image.observed, ids)]) for image in images]
    if not any(len(rows) for rows in seen):
        raise SceneError(
            "model: expected images that say which points they see, got none; make it with COLMAP (`kfgs sfm`)"
        )
    inside = _robust(found.points)
    if inside.sum() < count:
        raise SceneError(
            f"count: expected at most as many blocks as points ({len(found.points)}), got {count}; ask for fewer"
        )
    centers = np.array([-image.pose[:3, :3].T @ image.pose[:3, 3] for image in images if image.pose is not None])
    blocks = []
    for number, core in enumerate(_cut(found.points[inside], count)):
        name = f"block{number:0{max(2, len(str(count - 1)))}d}"
        own = _within(found.points, core)
        shares = np.array([own[rows].mean() if len(rows) else 0.0 for rows in seen])
        chosen = np.flatnonzero((shares >= share) & (shares > 0))
        if len(chosen) == 0:
            raise SceneError(
                f"{name}: expected images that see this part of the scene, got none; ask for fewer blocks than {count}"
            )
        near = np.concatenate([found.points[own & inside], centers[chosen]])
        low, high = near.min(0), near.max(0)
        pad = MARGIN * (high - low)
        reach = tuple((low - pad).tolist()), tuple((high + pad).tolist())
        names = tuple(images[i].name for i in chosen)
        blocks.append(Block(name, (tuple(core[0].tolist()), tuple(core[1].tolist())), reach, names))
    return blocks


def write_parts(model: str | Path, parts: Mapping[Path, Iterable[str]]) -> None:
    """Write COLMAP models with some of the images of another, and the points that at least two of them see.

    The model is read once, as that of a city has gigabytes; then memory holds it, and a copy from which one part is made.
    Images of one rig that were taken together stay together.

    Args:
        model: the folder of the model.
        parts: the folder of each new model, with the names of its images.

    Raises:
        SceneError: if the model is damaged, or has no image of a name.
    """
    model = as_path(model)
    with (
        quiet_pycolmap() as pycolmap,
        scene_errors(f"{model}: expected a model that pycolmap can read", "write it again with COLMAP"),
    ):
        whole = pycolmap.Reconstruction(str(model))
        frames = {image.name: image.frame_id for image in whole.images.values()}
        posed = {image.frame_id for image in whole.images.values() if image.has_pose}
        for names in parts.values():
            missing = set(names) - frames.keys()
            if missing:
                raise SceneError(f"parts: expected images of {model}, got {min(missing)!r}; correct the name")
        for folder, names in parts.items():
            part = copy.deepcopy(whole)
            for frame in posed - {frames[name] for name in names}:
                part.deregister_frame(frame)
            with atomic_folder(folder) as place:
                part.write(str(place))


def _robust(points: Array) -> NDArray[np.bool_]:
    """Which points are no far outliers."""
    import torch

    return robust_bounds(torch.from_numpy(points)).inside.numpy()


def _within(points: Array, core: Array) -> NDArray[np.bool_]:
    return np.asarray(((points >= core[0]) & (points < core[1])).all(1))


def _cut(points: Array, count: int) -> list[Array]:  # [P, 3] -> count x [2, 3]
    """Boxes that fill space and hold about equally many points."""

    def halve(rows: Array, box: Array, count: int) -> list[Array]:
        if count == 1:
            return [box]
        first = count // 2
        axis = int(np.argmax(np.ptp(rows, axis=0)))
        order = np.sort(rows[:, axis])
        at = min(len(rows) - 1, max(1, round(len(rows) * first / count)))
        middle = (order[at - 1] + order[at]) / 2
        lower, upper = box.copy(), box.copy()
        lower[1, axis] = upper[0, axis] = middle
        below = rows[:, axis] < middle
        if not 0 < below.sum() < len(rows):
            raise SceneError(
                f"count: expected points at different places, got too many at one for {count} blocks; ask for fewer blocks"
            )
        return [*halve(rows[below], lower, first), *halve(rows[~below], upper, count - first)]

    return halve(points, np.array([[-np.inf] * 3, [np.inf] * 3]), count)
