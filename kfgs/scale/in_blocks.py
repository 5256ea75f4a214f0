"""A field that stays in its blocks: only those that a question needs are in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import reading
from .._card import say_coordinate
from .._check import as_array, check_range
from .._files import as_path, read_json, real_path
from .._origin import to_world
from ..cameras import Camera
from ..fields import SemanticField, join_fields, scene_classes
from ..gaussians import Gaussians
from ..labels import LabelSet, Selection, transfer_labels
from ..scenes.blocks import Array, Block

BLOCKS, CORE, FACTS, FORMAT = "blocks.json", "core", "core.json", "kfgs.blocks"


@dataclass(frozen=True)
class FieldInBlocks:
    """The fitted blocks of a scene that hold Gaussians. `blocks[i]` has those of its core, whose box is `boxes[i]`.

    Example:
        for name, found in city.query("chair"):  # one block in memory at a time
            print(name, found.count)
    """

    folder: Path
    blocks: tuple[Block, ...]
    counts: tuple[int, ...]
    """Gaussians of each block."""
    boxes: tuple[tuple[list[float], list[float]], ...]
    """Low and high corner of each block's Gaussians, spread included, world units."""

    @staticmethod
    def open(folder: str | Path) -> FieldInBlocks:
        """Open what `fit_blocks` made; no Gaussian is read.

        Raises:
            FileNotFoundError: if there are no blocks, or one was not fitted.
            ValueError: if a file is damaged, no block has a Gaussian, or the blocks were fitted with different options.
        """
        folder = as_path(folder)
        blocks, counts, boxes = [], [], []
        options = dict[Any, str]()
        for block in read_blocks(folder):
            file = folder / block.name / CORE / FACTS
            if not file.is_file():
                raise FileNotFoundError(f"{file}: no such file; fit the block first, with fit_blocks or `kfgs blocks`")
            facts = read_json(file)
            with reading(file, "the facts of a block", "fit the block again"):
                options.setdefault(facts.get("options"), block.name)
                if facts["gaussians"]:  # else nothing lies in this part of space
                    low, high = np.array(facts["box"], np.float64).reshape(2, 3).tolist()
                    blocks.append(block)
                    counts.append(int(facts["gaussians"]))
                    boxes.append((low, high))
        if len(options) > 1:
            one, other, *_ = options.values()
            raise ValueError(
                f"{folder}: expected blocks that were fitted with the same options, got {one} and {other} with different "
                "ones; run the last `kfgs blocks` again, which fits the rest"
            )
        if not blocks:
            raise ValueError(f"{folder}: expected blocks with Gaussians, got none; was the splat one of another scene?")
        return FieldInBlocks(folder, tuple(blocks), tuple(counts), tuple(boxes))

    def __len__(self) -> int:
        return sum(self.counts)

    @property
    def extent(self) -> tuple[list[float], list[float]]:
        """Low and high corner of the box around all Gaussians, world units."""
        low, high = (np.array(corners) for corners in zip(*self.boxes, strict=True))
        return low.min(0).tolist(), high.max(0).tolist()

    def field(self, name: str) -> SemanticField:
        """The core of one block, read now."""
        return SemanticField.load(self.folder / name / CORE)

    def query(self, target: str | Tensor, *args: Any, **options: Any) -> Iterator[tuple[str, Selection]]:
        """Ask each block in turn, as `SemanticField.query`; yields its name and the selection of its Gaussians.

        Where gamma follows from the scores (questions without negatives), each block has its own: give `threshold` then.
        """
        for block in self.blocks:
            yield block.name, self.field(block.name).query(target, *args, **options)

    def joined(self) -> SemanticField:
        """All blocks as one field, in memory."""
        return self._join([self.field(block.name) for block in self.blocks])

    def _join(self, parts: list[SemanticField]) -> SemanticField:
        """Parts as one field, which remembers the scene of all blocks."""
        field = join_fields(parts)
        scene = real_path(self.folder / _described(self.folder)[0])
        info = {name: value for name, value in field.info.items() if name not in ("geometry", "seconds")}
        return replace(field, info=info | {"scene": str(scene)}, classes=scene_classes(scene, field.dim))

    def within(self, low: Sequence[float], high: Sequence[float]) -> SemanticField:
        """The Gaussians whose centres lie in a box, as one field; only blocks that touch the box are read.

        Args:
            low: [3] corner, world units; -inf: no limit on this side.
            high: [3] corner; inf: no limit.

        Raises:
            ValueError: if low is above high, or there is no Gaussian; a box that no block touches is refused before a field is
                read.
        """
        corners = np.array([low, high], np.float64)
        if corners.shape != (2, 3) or np.isnan(corners).any():
            raise ValueError(f"low, high: expected three numbers each, got {list(low)} and {list(high)}")
        for axis, first, last in zip("xyz", *corners.tolist(), strict=True):
            if first > last:
                raise ValueError(
                    f"low, high: expected a low corner and then a high one, got {axis} from {first:g} down to {last:g}; "
                    "exchange the two numbers"
                )
        parts = self._touching(*corners)
        if not parts:
            raise ValueError(
                "low, high: expected a box with Gaussians, got one with none; all Gaussians lie in "
                f"{in_numbers(self.extent)}; choose a part of that box"
            )
        return self._join(parts)

    def _touching(self, low: Array, high: Array) -> list[SemanticField]:
        """The Gaussians of each block whose centres lie in a box."""
        parts = []
        for block, box in zip(self.blocks, self.boxes, strict=True):
            if (low <= box[1]).all() and (high >= box[0]).all():
                field = self.field(block.name)
                means = as_array(to_world(field.gaussians.means, field.gaussians.origin))
                inside = ((means >= low) & (means <= high)).all(1)
                if inside.any():
                    parts.append(field.select(torch.from_numpy(inside)))
        return parts

    def seen_from(self, camera: Camera) -> SemanticField:
        """The blocks that a camera may see, as one field: those whose box is in its picture."""
        names = [block.name for block, box in zip(self.blocks, self.boxes, strict=True) if _in_view(camera, *box)]
        if not names:
            raise ValueError(f"camera: expected one that sees a block, got {camera.name!r}, which sees none")
        return self._join([self.field(name) for name in names])

    def segment(self, camera: Camera, *args: Any, **options: Any) -> Tensor:  # [H, W] int64
        """As `SemanticField.segment`; only the blocks that the camera may see are read."""
        return self.seen_from(camera).segment(camera, *args, **options)

    def transfer(self, dst: Gaussians, distance: float, classes: LabelSet | None = None) -> Tensor:  # [N] int64
        """Labels for a cloud, as `transfer_labels` gives them from the joined field, one block's surroundings at a time.

        Args:
            dst: N Gaussians in the field's frame.
            distance: lambda, world units.
            classes: to label with; None: those that the field remembers.
        """
        check_range("distance", distance, 0, closed=(False, False))
        means = as_array(to_world(dst.means, dst.origin))
        labels = torch.full((len(means),), -1, dtype=torch.int64)
        for block in self.blocks:
            rows = np.flatnonzero(block.holds(means))
            near = self._touching(means[rows].min(0) - distance, means[rows].max(0) + distance) if len(rows) else []
            if near:
                field = join_fields(near)
                own = torch.from_numpy(rows)
                carried = transfer_labels(field.label(classes), dst.select(own), distance)
                assert carried.labels is not None
                labels[own] = carried.labels
        return labels


def in_numbers(box: tuple[list[float], list[float]]) -> str:
    """A box as `kfgs join --box` takes it."""
    return ",".join(say_coordinate(x, 4) for corner in box for x in corner)


def read_blocks(folder: Path) -> list[Block]:
    """The blocks that `split_scene` wrote to a folder; a ValueError or FileNotFoundError if there are none."""
    file = folder / BLOCKS
    if not file.is_file():
        raise FileNotFoundError(
            f"{file}: no such file; expected the folder of a scene in blocks, which `kfgs blocks` made"
        )
    return _described(folder)[1]


def _described(folder: Path) -> tuple[str, list[Block]]:
    """The scene that `blocks.json` names, relative to its folder, and the blocks."""
    file = folder / BLOCKS
    found = read_json(file)
    with reading(file, "the blocks of a scene", "cut the scene again with split_scene"):
        if (found["format"], found["version"]) != (FORMAT, 1):
            raise ValueError(f"format {found['format']!r}, version {found['version']!r}")
        if not isinstance(found["scene"], str):
            raise ValueError(f"scene {found['scene']!r:.40} is no path")
        return found["scene"], [Block.from_json(block) for block in found["blocks"]]


def _in_view(camera: Camera, low: list[float], high: list[float]) -> bool:
    """Whether a box may be in the picture: False only if all its corners are beyond one side of what the camera sees."""
    corners = np.array(list(product(*zip(low, high, strict=True)))) - camera.origin
    viewmat, K = as_array(camera.viewmat).astype(np.float64), as_array(camera.K).astype(np.float64)
    x, y, z = K @ (viewmat[:3, :3] @ corners.T + viewmat[:3, 3:])
    beyond = (z < camera.near, x < 0, x > camera.width * z, y < 0, y > camera.height * z)
    return not any(side.all() for side in beyond)
