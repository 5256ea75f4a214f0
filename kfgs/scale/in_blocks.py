"""A field that stays in its blocks: only those that a question needs are in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._arrays import reading
from .._check import as_array
from .._files import as_path, read_json
from ..cameras import Camera
from ..fields import SemanticField, join_fields, select_gaussians
from ..gaussians import Gaussians
from ..labels import LabelSet, Selection, transfer_labels
from ..scenes.blocks import Array, Block

BLOCKS, CORE, FORMAT = "blocks.json", "core", "kfgs.blocks"
GRID = 9  # points along each side of a box that are tried for being in view


@dataclass(frozen=True)
class FieldInBlocks:
    """The fitted blocks of a scene. `blocks[i]` has the Gaussians of its core, whose box is `boxes[i]`.

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
            ValueError: if a file is damaged.
        """
        folder = as_path(folder)
        blocks = read_blocks(folder)
        counts, boxes = [], []
        for block in blocks:
            file = folder / block.name / "core.json"
            if not file.is_file():
                raise FileNotFoundError(f"{file}: no such file; fit the block first, with fit_blocks or `kfgs blocks`")
            facts = read_json(file)
            with reading(file, "the facts of a block", "fit the block again"):
                low, high = (list(map(float, corner)) for corner in facts["box"])
                counts.append(int(facts["gaussians"]))
                boxes.append((low, high))
        return FieldInBlocks(folder, tuple(blocks), tuple(counts), tuple(boxes))

    def __len__(self) -> int:
        return sum(self.counts)

    def field(self, name: str) -> SemanticField:
        """The core of one block, read now."""
        return SemanticField.load(self.folder / name / CORE)

    def query(self, target: str | Tensor, *args: Any, **options: Any) -> Iterator[tuple[str, Selection]]:
        """Ask each block in turn, as `SemanticField.query`; yields its name and the selection of its Gaussians."""
        for block in self.blocks:
            yield block.name, self.field(block.name).query(target, *args, **options)

    def joined(self) -> SemanticField:
        """All blocks as one field, in memory."""
        return join_fields([self.field(block.name) for block in self.blocks])

    def within(self, low: Sequence[float], high: Sequence[float]) -> SemanticField:
        """The Gaussians whose centres lie in a box, as one field; only blocks that touch the box are read.

        Args:
            low: [3] corner, world units.
            high: [3] corner.

        Raises:
            ValueError: if there is no Gaussian.
        """
        parts = self._touching(np.asarray(low, np.float64), np.asarray(high, np.float64))
        if not parts:
            raise ValueError(f"low, high: expected a box with Gaussians, got none from {list(low)} to {list(high)}")
        return join_fields(parts)

    def _touching(self, low: Array, high: Array) -> list[SemanticField]:
        """The Gaussians of each block whose centres lie in a box."""
        parts = []
        for block, box in zip(self.blocks, self.boxes, strict=True):
            if (low <= box[1]).all() and (high >= box[0]).all():
                field = self.field(block.name)
                means = as_array(field.gaussians.means)
                inside = ((means >= low) & (means <= high)).all(1)
                if inside.any():
                    parts.append(select_gaussians(field, torch.from_numpy(inside)))
        return parts

    def seen_from(self, camera: Camera) -> SemanticField:
        """The blocks that a camera may see, as one field: those whose box is in its picture."""
        names = [block.name for block, box in zip(self.blocks, self.boxes, strict=True) if _in_view(camera, *box)]
        if not names:
            raise ValueError(f"camera: expected one that sees a block, got {camera.name!r}, which sees none")
        return join_fields([self.field(name) for name in names])

    def segment(self, camera: Camera, *args: Any, **options: Any) -> Tensor:  # [H, W] int64
        """As `SemanticField.segment`; only the blocks that the camera may see are read."""
        return self.seen_from(camera).segment(camera, *args, **options)

    def transfer(
        self, dst: Gaussians, distance: float, classes: LabelSet | None = None, **options: Any
    ) -> Tensor:  # [N] int64
        """Labels for a cloud, as `transfer_labels` gives them from the joined field, one block's surroundings at a time.

        Args:
            dst: N Gaussians in the field's frame.
            distance: lambda, world units.
            classes: to label with; None: those that the field remembers.
            options: of `transfer_labels`.
        """
        means = as_array(dst.means)
        labels = torch.full((len(means),), -1, dtype=torch.int64)
        for block in self.blocks:
            rows = np.flatnonzero(block.holds(means))
            near = self._touching(means[rows].min(0) - distance, means[rows].max(0) + distance) if len(rows) else []
            if near:
                field = join_fields(near)
                known = field.classify(classes).labels
                own = torch.from_numpy(rows)
                labels[own] = transfer_labels(field.gaussians, known, dst.select(own), distance, **options).labels
        return labels


def read_blocks(folder: Path) -> list[Block]:
    """The blocks that `split_scene` wrote to a folder; a ValueError or FileNotFoundError if there are none."""
    file = folder / BLOCKS
    found = read_json(file)
    with reading(file, "the blocks of a scene", "cut the scene again with split_scene"):
        if (found["format"], found["version"]) != (FORMAT, 1):
            raise ValueError(f"format {found['format']!r}, version {found['version']!r}")
        return [Block.from_json(block) for block in found["blocks"]]


def _in_view(camera: Camera, low: list[float], high: list[float]) -> bool:
    """Whether a point of a grid through the box is in the picture, or the camera in the box."""
    center = as_array(camera.center).astype(np.float64)
    if ((center >= low) & (center <= high)).all():
        return True
    axes = [np.linspace(a, b, GRID) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    viewmat, K = as_array(camera.viewmat).astype(np.float64), as_array(camera.K).astype(np.float64)
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    front = seen[seen[:, 2] > camera.near]
    xy = (front @ K.T)[:, :2] / front[:, 2:]
    # a cell of the grid may reach into the picture though its corners do not
    margin = 0.5 * max(camera.width, camera.height)
    return bool(((xy > -margin) & (xy < np.array([camera.width, camera.height]) + margin)).all(1).any())
