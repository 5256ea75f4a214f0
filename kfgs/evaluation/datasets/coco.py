"""COCO's JSON: polygons or run lengths of objects, as annotation programs export them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..._files import as_path, file_stem, read_json, write_json
from ..._typed import typed
from ...fields.examples import Mask
from ...labels.polygons import MOST, decode_rle, encode_rle, fill_region, say_range, union
from ...scenes.files import MAX_SIDE
from ..class_lists import VOID_NAMES, name_key
from ..truth import LabelTruth, MaskAndBoxes, MaskTruth
from .files import ReadWhenAsked

WRITER = "label maps by kfgs"  # in the files that kfgs writes


@dataclass(frozen=True)
class _Picture:
    size: tuple[int, int]  # (height, width)
    objects: list[tuple[int, dict[str, Any]]]  # (place in the file, annotation)


def load_coco_masks(path: str | Path) -> MaskTruth:
    """Read a COCO JSON as masks of texts: the categories that each picture has, several objects as one mask with a box each.

    Polygons are filled by the centres of pixels (`fill_region`); run lengths may be a list or COCO's compressed text. Categories
    in `VOID_NAMES` are no texts.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged; the message names the annotation.
    """
    path = as_path(path)
    names, pictures = _read(path)
    void = [category for category in names if _is_void(names[category])]
    shown = {s: p for s, p in pictures.items() if any(one.get("category_id") not in void for _, one in p.objects)}
    return MaskTruth(ReadWhenAsked({stem: partial(_masks, path, names, p) for stem, p in shown.items()}))


def load_coco_examples(path: str | Path) -> dict[str, list[Mask]]:
    """Read a COCO JSON as examples of classes (`fields.label_set_from_examples`): one mask per category and picture.

    Pictures must be views of the field, in their size. Categories in `VOID_NAMES` are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, or has no objects.
    """
    examples: dict[str, list[Mask]] = {}
    for stem, masks in load_coco_masks(path).frames.items():
        for name, found in masks.items():
            examples.setdefault(name, []).append(Mask(stem, found.mask))
    if not examples:
        raise ValueError(f"{path}: expected objects as examples, got none; annotate some")
    return examples


def load_coco_labels(path: str | Path) -> LabelTruth:
    """Read a COCO JSON as labels: one class per pixel, -1 where no object is; a later object covers an earlier one.

    Classes are the categories of the file, in its order, without those in `VOID_NAMES`: their objects are void.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged; the message names the annotation.
    """
    path = as_path(path)
    names, pictures = _read(path)
    asked = [category for category in names if not _is_void(names[category])]
    index = {category: asked.index(category) if category in asked else -1 for category in names}
    readers = {stem: partial(_labels, path, index, p) for stem, p in pictures.items()}
    return LabelTruth(tuple(names[category] for category in asked), ReadWhenAsked(readers))


@typed
def save_coco(
    path: str | Path,
    labels: Mapping[str, Tensor],  # each [H, W] int64, -1 = none
    names: Sequence[str],
) -> None:
    """Write label maps as a COCO JSON: one annotation for each class of each picture, with run lengths, area and box.

    Two chairs in a picture are one annotation. Category ids are the labels plus 1, because 0 means background in many
    programs. `load_coco_labels` reads the same labels again.

    Args:
        path: the file.
        labels: the label map of each picture, by the name of its file.
        names: the name of each class.

    Raises:
        ValueError: if a label has no name.
    """
    annotations: list[dict[str, Any]] = []
    for number, (file, found) in enumerate(labels.items(), start=1):
        for label in found.unique().tolist():
            if label >= len(names):
                raise ValueError(f"labels: expected classes below {len(names)} (the names), got {label} in {file}")
            if label < 0:
                continue
            mask = found == label
            rows, columns = mask.any(dim=1).nonzero()[:, 0].tolist(), mask.any(dim=0).nonzero()[:, 0].tolist()
            box = [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]  # x, y, width, height
            one = {"id": len(annotations) + 1, "image_id": number, "category_id": label + 1, "iscrowd": 0}
            annotations.append(one | {"segmentation": encode_rle(mask), "area": int(mask.sum()), "bbox": box})
    images = [
        {"id": number, "file_name": file, "height": found.shape[0], "width": found.shape[1]}
        for number, (file, found) in enumerate(labels.items(), start=1)
    ]
    categories = [{"id": label + 1, "name": name} for label, name in enumerate(names)]
    info = {"description": WRITER}
    write_json(path, {"info": info, "images": images, "annotations": annotations, "categories": categories})


def _read(path: Path) -> tuple[dict[int, str], dict[str, _Picture]]:
    """The categories by id, and the pictures by stem."""
    top = read_json(path)
    try:
        names = {int(entry["id"]): str(entry["name"]) for entry in top["categories"]}
        images = {int(entry["id"]): entry for entry in top["images"]}
        stems = {number: file_stem(str(entry["file_name"])) for number, entry in images.items()}
        pictures = {n: _Picture((int(e["height"]), int(e["width"])), []) for n, e in images.items()}
        for place, annotation in enumerate(top["annotations"]):
            pictures[int(annotation["image_id"])].objects.append((place, annotation))
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{path}: expected COCO's 'categories', 'images' and 'annotations', each annotation with the id of an image; got "
            f"something else ({type(error).__name__}: {error}); export it again"
        ) from error
    if len(set(stems.values())) != len(stems) or len(set(names.values())) != len(names) or not names or not pictures:
        raise ValueError(f"{path}: expected some images and categories, each name once; export it again")
    for number, picture in pictures.items():
        if min(picture.size) < 1 or max(picture.size) > MAX_SIDE or picture.size[0] * picture.size[1] > MOST:
            raise ValueError(f"{path}: expected a size of image {stems[number]!r}, got {picture.size}; export it again")
    return names, {stems[number]: picture for number, picture in pictures.items()}


def _masks(path: Path, names: dict[int, str], picture: _Picture) -> dict[str, MaskAndBoxes]:
    found: dict[int, list[tuple[Tensor, Tensor]]] = {}
    for place, annotation in picture.objects:
        category, mask = _object(path, place, annotation, names, picture.size)
        if _is_void(names[category]):
            continue
        found.setdefault(category, []).append((mask, _box(path, place, annotation)))
    return {
        names[category]: MaskAndBoxes(union([mask for mask, _ in parts]), torch.stack([box for _, box in parts]))
        for category, parts in found.items()
    }


def _is_void(name: str) -> bool:
    return name_key(name) in VOID_NAMES


def _labels(path: Path, index: dict[int, int], picture: _Picture) -> Tensor:  # [H, W] int64
    labels = torch.full(picture.size, -1, dtype=torch.int64)
    for place, annotation in picture.objects:
        category, mask = _object(path, place, annotation, index, picture.size)
        labels[mask] = index[category]
    return labels


def _object(
    path: Path, place: int, annotation: dict[str, Any], known: Any, size: tuple[int, int]
) -> tuple[int, Tensor]:  # category, [H, W] bool
    where = f"{path}, annotation {annotation.get('id', place)}"
    category: Any = annotation.get("category_id")
    segmentation: Any = annotation.get("segmentation")
    if not isinstance(category, int) or category not in known:
        raise ValueError(f"{where}: expected a category of the file ({len(known)} ids), got {category!r:.40}")
    try:
        if isinstance(segmentation, dict):
            mask = decode_rle(segmentation)
            if tuple(mask.shape) != size:
                raise ValueError(f"size: expected {size} as its image, got {tuple(mask.shape)}")
            return int(category), mask
        if not isinstance(segmentation, list) or not segmentation:
            raise ValueError(f"segmentation: expected polygons or run lengths, got {segmentation!r:.60}")
        outlines = [_corners(polygon) for polygon in segmentation]
        mask = union([fill_region(outline, size) for outline in outlines])
        if not mask.any():
            _check_inside([corner for outline in outlines for corner in outline], size)
        return int(category), mask
    except ValueError as error:
        raise ValueError(f"{where}: {error}; export the annotations again") from error


def _check_inside(corners: list[list[float]], size: tuple[int, int]) -> None:
    """Of an object without a pixel: it may be so thin that it holds no pixel's centre, but it must be in the picture."""
    height, width = size
    if not any(0 <= x <= width and 0 <= y <= height for x, y in corners):
        raise ValueError(
            f"segmentation: expected polygons in the image of {width}x{height}, got {say_range(corners)}, all outside it"
        )


def _corners(polygon: Any) -> list[list[float]]:
    numbers = polygon if isinstance(polygon, list) else []
    plain = all(type(n) in (int, float) and math.isfinite(n) for n in numbers)
    if len(numbers) < 6 or len(numbers) % 2 or not plain:
        raise ValueError(f"segmentation: expected polygons [x1, y1, x2, y2, x3, y3, ...], got {polygon!r:.60}")
    return [[numbers[i], numbers[i + 1]] for i in range(0, len(numbers), 2)]


def _box(path: Path, place: int, annotation: dict[str, Any]) -> Tensor:  # [4] x1, y1, x2, y2
    box = annotation.get("bbox")
    if not isinstance(box, list) or len(box) != 4 or not all(type(n) in (int, float) and math.isfinite(n) for n in box):
        where = f"{path}, annotation {annotation.get('id', place)}"
        raise ValueError(
            f"{where}: expected a bbox [x, y, width, height], got {box!r:.60}; export the annotations again"
        )
    x, y, width, height = box
    return torch.tensor([x, y, x + width, y + height], dtype=torch.float32)
