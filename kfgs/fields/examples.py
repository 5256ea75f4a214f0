"""Define classes by examples instead of text: pixels of views, or Gaussians of the field."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .._card import short_repr
from .._check import check_shapes
from .._files import as_path, read_json
from .._rows import EPS, row_norms, unit_rows
from ..cameras import Camera
from ..cameras.camera import view_named
from ..gaussians import as_rows
from ..labels import LabelSet, Selection
from ..labels.classify import decode_rle
from .semantic_field import SemanticField


@dataclass(frozen=True, eq=False)
class Clicks:
    """Pixels of a view that show a class."""

    view: str | Camera
    """A training view of the field by its name, with or without ending, or any camera."""
    points: Sequence[Sequence[float]]
    """(x, y) in pixels of that view; the first pixel's centre is (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class Box:
    """A rectangle of a view that a class fills."""

    view: str | Camera
    corners: Sequence[float]
    """(x0, y0, x1, y1) in pixels, x0 < x1 and y0 < y1."""


@dataclass(frozen=True, eq=False)
class Mask:
    """The pixels of a view that are true in a mask."""

    view: str | Camera
    mask: Tensor  # [H, W] bool, of the view's size

    __repr__ = short_repr


Example = Clicks | Box | Mask | Selection | Tensor
"""Pixels of a view; or Gaussians of the field: a selection, a mask [N] or indices."""


def label_set_from_examples(field: SemanticField, examples: Mapping[str, Example | Sequence[Example]]) -> LabelSet:
    """Make classes from examples, for a teacher without text (DINOv2, SAM) or for words that it does not know.

    A class's row is the mean direction of the features of its examples: of the field rendered at the pixels, or of the
    Gaussians. Every example has the same weight, whatever its number of pixels.

    Args:
        field: that knows the views.
        examples: by class name, one or several: `Clicks`, `Box` or `Mask`, or some Gaussians of the field (a `Selection`, a
            mask [N] or a tensor of indices).

    Raises:
        ValueError: if there is no class, or one has no example, a view is unknown, a point lies outside its view, or the
            field shows nothing there.
    """
    shown = {name: [given] if isinstance(given, Example) else list(given) for name, given in examples.items()}
    if not shown or not all(shown.values()):
        raise ValueError(f"examples: expected at least one for each class, got {examples!r:.80}; show one")
    rows = []
    for name, given in shown.items():
        directions = [_direction(field, example, f"examples[{name!r}][{i}]") for i, example in enumerate(given)]
        rows.append(unit_rows(torch.stack(directions).mean(dim=0)))
    info: dict[str, Any] = {"examples": {name: len(given) for name, given in shown.items()}}
    if teacher := field.info.get("teacher"):
        info["teacher"] = teacher
    return LabelSet(tuple(shown), torch.stack(rows), info=info)


def _direction(field: SemanticField, example: Example, name: str) -> Tensor:  # [D] of length 1
    """The mean direction of the features of one example."""
    if isinstance(example, Selection | Tensor):
        features = field.features_of(as_rows(name, example, field))
    else:
        camera = view_named(field.cameras, example.view, name)
        pixels, rendering = _pixels(camera, example, name), field.render(camera)
        features = field.decode(rendering.map[pixels.to(rendering.alpha.device) & (rendering.alpha > 0)])
    known = features[row_norms(features) > EPS]
    if len(known) == 0:
        raise ValueError(f"{name}: expected a place where the field shows something, got none; choose another")
    return unit_rows(unit_rows(known).mean(dim=0))


def _pixels(camera: Camera, example: Clicks | Box | Mask, name: str) -> Tensor:  # [H, W] bool
    if isinstance(example, Mask):
        check_shapes((f"{name}.mask", example.mask, camera.size))
        return example.mask
    chosen, size = torch.zeros(camera.size, dtype=torch.bool), f"{camera.width} x {camera.height}"
    if isinstance(example, Box):
        x0, y0, x1, y1 = example.corners
        if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
            raise ValueError(f"{name}: expected x0 < x1 and y0 < y1 within {size}, got {tuple(example.corners)}")
        chosen[int(y0) : max(int(y1), int(y0) + 1), int(x0) : max(int(x1), int(x0) + 1)] = True
        return chosen
    for x, y in example.points:
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            raise ValueError(f"{name}: expected points within {size}, got ({x:g}, {y:g})")
        chosen[int(y), int(x)] = True
    return chosen


def read_examples(path: str | Path) -> dict[str, list[Example]]:
    """Read examples from JSON: {"chair": [{"view": "a.png", "points": [[x, y], ...]}, {"view": "b.png", "box": [x0, y0, x1, y1]},
    {"gaussians": [3, 14]}], ...}.

    A mask is {"view": "c.png", "segmentation": {"size": [H, W], "counts": ...}} with COCO's run lengths: an entry of Segment
    Anything's list of masks with the view added. {"view": "c.png", "masks": "c.json", "index": 3} takes mask 3, counted from
    0, of such a list (or of the `annotations`) in a file in the same folder.
    """
    content, folder = read_json(path), as_path(path).parent
    masks_of = functools.cache(lambda name: read_json(folder / name))  # one file may have the masks of many examples

    def read(entry: dict[str, Any]) -> Example:
        if "gaussians" in entry:
            return torch.tensor([int(index) for index in entry["gaussians"]])
        view = str(entry["view"])
        if "points" in entry:
            return Clicks(view, [(float(x), float(y)) for x, y in entry["points"]])
        if "box" in entry:
            x0, y0, x1, y1 = map(float, entry["box"])
            return Box(view, (x0, y0, x1, y1))
        if "masks" in entry:
            masks = masks_of(entry["masks"])
            entry = (masks["annotations"] if isinstance(masks, dict) else masks)[entry["index"]]
        return Mask(view, decode_rle(entry["segmentation"]))

    examples: dict[str, list[Example]] = {}
    where = ""
    try:
        for name, shown in content.items():
            examples[name] = []
            for i, entry in enumerate(shown):
                where = f"{name!r}[{i}]: "
                examples[name].append(read(entry))
    except (AttributeError, TypeError, LookupError, ValueError, OverflowError, RuntimeError) as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else str(error)
        expected = 'an example, in an object of lists by class name, {"chair": [...]}'
        raise ValueError(f"{path}: {where}expected {expected}, got others ({why}); see kfgs features --help") from error
    return examples
