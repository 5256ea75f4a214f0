"""Define classes by examples instead of text: pixels of views, or Gaussians of the field."""

from __future__ import annotations

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
from .._typed import typed
from ..cameras import Camera
from ..cameras.camera import view_named
from ..gaussians import as_rows
from ..labels import LabelSet
from ..labels.run_lengths import decode_rle
from .semantic_field import SemanticField

LONGEST = 4096
"""Pixels on the longer edge of the picture that is drawn of a view: larger ones, which a file may state in a few bytes, are
drawn at this size."""


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


@dataclass(frozen=True, eq=False)
class Picked:
    """Gaussians of the field that belong to a class."""

    indices: Sequence[int] | Tensor
    """Which, or a mask [N]."""

    __repr__ = short_repr


Example = Clicks | Box | Mask | Picked


@typed
def label_set_from_examples(field: SemanticField, examples: Mapping[str, Example | Sequence[Example]]) -> LabelSet:
    """Make classes from examples, for a teacher without text (DINOv2, SAM) or for words that it does not know.

    A class's row is the mean direction of the features of its examples: of the field rendered at the pixels, or of the
    Gaussians. Every example has the same weight, whatever its number of pixels.

    Args:
        field: a finished field.
        examples: one or more examples of each class, by its name.

    Raises:
        ValueError: if there is no class, or one has no example, a view is unknown, a point lies outside its view, or the
            field shows nothing there.
    """
    if not examples:
        raise ValueError("examples: expected at least one class, got none; name one and show it")
    shown = {
        name: {
            f"examples[{name!r}][{i}]": one for i, one in enumerate([given] if isinstance(given, Example) else given)
        }
        for name, given in examples.items()
    }
    for name, given in shown.items():
        if not given:
            raise ValueError(f"examples[{name!r}]: expected at least one example, got none; show one")
        for where, one in given.items():  # all of them before the first view is rendered
            _chosen(field, one, where)
    rows = [
        unit_rows(torch.stack([_feature(field, one, where) for where, one in given.items()]).mean(dim=0))
        for given in shown.values()
    ]
    counts = {name: len(given) for name, given in shown.items()}
    teacher = field.info.get("teacher")
    info: dict[str, Any] = {"examples": counts, **({"teacher": teacher} if teacher else {})}
    return LabelSet(tuple(examples), torch.stack(rows), info=info)


def read_examples(path: str | Path) -> dict[str, list[Example]]:
    """Read examples from JSON: {"chair": [{"view": "a.png", "points": [[x, y], ...]}, {"view": "b.png", "box": [x0, y0, x1, y1]},
    {"gaussians": [3, 14]}], ...}.

    A mask is {"view": "c.png", "segmentation": {"size": [H, W], "counts": ...}} with COCO's run lengths: an entry of Segment
    Anything's list of masks, whose other values are not read, with the view added. {"view": "c.png", "masks": "c.json",
    "index": 3} takes mask 3, counted from 0, of such a list in a file beside this one; the list may also be the `annotations`
    of that file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it has another content.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not all(isinstance(shown, list) for shown in content.values()):
        wrong = [name for name, shown in content.items() if type(shown) is not list] if type(content) is dict else []
        got = f"no list for {wrong[0]!r:.60}" if wrong else type(content).__name__
        raise ValueError(
            f'{path}: expected an object of lists of examples by class name, {{"chair": [...]}}, got {got}; correct it'
        )
    return {
        name: [_read(f"{path}: {name!r}[{i}]", one, as_path(path).parent) for i, one in enumerate(shown)]
        for name, shown in content.items()
    }


def _read(where: str, one: Any, folder: Path) -> Example:
    keys = set(one) if isinstance(one, dict) else set()
    try:
        if keys == {"gaussians"}:
            return Picked(_list_of("gaussians", one["gaussians"], int))
        if "view" in keys and not isinstance(one["view"], str):
            raise ValueError(f"view: expected the name of a view, got {one['view']!r:.40}")
        if keys == {"view", "points"}:
            points = _list_of("points", one["points"], list)
            return Clicks(one["view"], [_list_of("points", point, int | float, 2) for point in points])
        if keys == {"view", "box"}:
            return Box(one["view"], _list_of("box", one["box"], int | float, 4))
        if keys == {"view", "masks", "index"}:
            return Mask(one["view"], _mask_of_file(as_path(folder / one["masks"]), one["index"]))
        if keys >= {"view", "segmentation"}:
            return Mask(one["view"], _decoded(one["segmentation"]))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: expected an example with numbers ({error}); see kfgs text --help") from error
    raise ValueError(
        f"{where}: expected 'view' with 'points', 'box', 'segmentation', or 'masks' and 'index'; or 'gaussians'; got "
        f"{sorted(keys) or type(one).__name__}; correct it"
    )


def _list_of(name: str, values: Any, kind: Any, count: int | None = None) -> list[Any]:
    """A list of JSON as it is, if all of it is of a kind; a bool is no number."""
    good = isinstance(values, list) and all(isinstance(one, kind) and not isinstance(one, bool) for one in values)
    if not good or count not in (None, len(values)):
        what = {int: "whole numbers", list: "[x, y]"}.get(kind, f"{count} numbers")
        raise ValueError(f"{name}: expected a list of {what}, got {values!r:.40}")
    return list(values)


def _mask_of_file(path: Path, index: object) -> Tensor:  # [H, W] bool
    """A mask of Segment Anything's list in a JSON file."""
    content = read_json(path)
    masks = content.get("annotations") if isinstance(content, dict) else content
    count = len(masks) if isinstance(masks, list) else 0
    if (
        not isinstance(masks, list)
        or type(index) is not int
        or not 0 <= index < count
        or not isinstance(masks[index], dict)
    ):
        raise ValueError(
            f"{path}: expected a list of masks, and an index below their number ({count}), got {index!r:.20}"
        )
    return _decoded(masks[index].get("segmentation"))


def _decoded(segmentation: object) -> Tensor:  # [H, W] bool
    if not isinstance(segmentation, dict):
        raise ValueError(
            "segmentation: expected COCO's run lengths {'size': [H, W], 'counts': ...}, got "
            f"{type(segmentation).__name__}; run Segment Anything with output_mode='coco_rle'"
        )
    return decode_rle(segmentation)


def _feature(field: SemanticField, example: Example, name: str) -> Tensor:  # [D] unit
    """The mean direction of the features of one example."""
    camera, chosen = _chosen(field, example, name)
    if camera is None:
        features = field.own_features(chosen)
    else:
        rendering = field.render(camera)
        features = field.decode(rendering.map[chosen.to(rendering.alpha.device) & (rendering.alpha > 0)])
    known = features[row_norms(features) > EPS]
    if len(known) == 0:
        raise ValueError(f"{name}: expected a place where the field shows something, got none; choose another")
    return unit_rows(unit_rows(known).mean(dim=0))


def _chosen(field: SemanticField, example: Any, name: str) -> tuple[Camera | None, Tensor]:
    """The camera of an example and its pixels [H, W] bool; or None and its Gaussians [n]. Nothing is rendered.

    Raises:
        ValueError: if the field has no such view, pixels or Gaussians.
    """
    if isinstance(example, Picked):
        return None, _gaussians(field, example, name)
    camera = view_named(field.cameras, example.view, name)
    drawn = camera.fitted(LONGEST)
    return drawn, _pixels(camera, drawn, example, name)


def _gaussians(field: SemanticField, example: Picked, name: str) -> Tensor:  # [n] int64
    which = as_rows(f"{name}.indices", example.indices, len(field))
    rows = which.nonzero()[:, 0] if which.dtype == torch.bool else which.long()
    if rows.ndim != 1 or len(rows) == 0 or int(rows.min()) < 0 or int(rows.max()) >= len(field):
        raise ValueError(f"{name}: expected indices of the field's {len(field)} Gaussians, got {example.indices!r:.80}")
    return rows


def _pixels(camera: Camera, drawn: Camera, example: Any, name: str) -> Tensor:  # [H, W] bool, of `drawn`
    down, right = drawn.height / camera.height, drawn.width / camera.width  # 1 but for huge views
    mask = torch.zeros(drawn.size, dtype=torch.bool)
    if isinstance(example, Mask):
        check_shapes((f"{name}.mask", example.mask, camera.size))
        rows, columns = example.mask.nonzero(as_tuple=True)
        mask[(rows * down).long(), (columns * right).long()] = True
    elif isinstance(example, Clicks):
        for x, y in example.points:
            if not (0 <= x < camera.width and 0 <= y < camera.height):
                raise ValueError(f"{name}: expected points within {camera.width} x {camera.height}, got ({x:g}, {y:g})")
            mask[int(y * down), int(x * right)] = True
    else:
        x0, y0, x1, y1 = example.corners
        if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
            raise ValueError(
                f"{name}: expected x0 < x1 and y0 < y1 within {camera.width} x {camera.height}, got {tuple(example.corners)}"
            )
        y0, y1, x0, x1 = int(y0 * down), int(y1 * down), int(x0 * right), int(x1 * right)
        mask[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = True
    return mask
