"""COCO's JSON of objects (polygons or run lengths), as annotation programs export it; `pycocotools` fills the masks.

Readers raise a FileNotFoundError without the file, and a ValueError that names the annotation if it is damaged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._arrays import reading
from .._files import as_path, file_stem, read_json, write_json
from ..fields.examples import Mask
from ..labels.classify import decode_rle
from ..scenes.files import PIXELS
from .truth import LabelTruth, ReadWhenAsked, is_void

FARTHEST = 100_000  # pixels: a corner that lies farther away is damage


class CocoPicture(NamedTuple):
    """A picture of the file, and its objects in the order of the file."""

    size: tuple[int, int]  # (height, width)
    annotations: list[dict[str, Any]]


def load_coco_labels(path: str | Path) -> LabelTruth:
    """Read a COCO JSON as labels: one class per pixel, -1 where no object is; a later object covers an earlier one.

    Classes are the categories of the file, in its order, without those in `VOID_NAMES`: their objects are void.
    """
    path = as_path(path)
    names, pictures = read_coco(path)
    asked = [category for category in names if not is_void(names[category])]

    def read(picture: CocoPicture) -> Tensor:  # [H, W] int64
        labels = torch.full(picture.size, -1, dtype=torch.int64)
        for category, mask, _ in masks_of(path, names, picture):
            labels[mask] = asked.index(category) if category in asked else -1
        return labels

    maps = ReadWhenAsked({stem: partial(read, picture) for stem, picture in pictures.items()})
    return LabelTruth(tuple(names[category] for category in asked), maps)


def load_coco_examples(path: str | Path) -> dict[str, list[Mask]]:
    """Read a COCO JSON as examples of classes (`fields.label_set_from_examples`): one mask per category and picture.

    Pictures must be views of the field, in their size. Categories in `VOID_NAMES` are left out.
    """
    path = as_path(path)
    names, pictures = read_coco(path)
    examples: dict[str, list[Mask]] = {}
    for stem, picture in pictures.items():
        masks: dict[str, Tensor] = {}
        for category, mask, _ in masks_of(path, names, picture):
            if not is_void(names[category]):
                masks[names[category]] = masks.get(names[category], torch.zeros_like(mask)) | mask
        for name, mask in masks.items():
            examples.setdefault(name, []).append(Mask(stem, mask))
    if not examples:
        raise ValueError(f"{path}: expected objects as examples, got none; annotate some")
    return examples


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
    """
    from pycocotools import mask as coco

    annotations: list[dict[str, Any]] = []
    images = []
    for number, (file, label_map) in enumerate(labels.items(), start=1):
        images.append({"id": number, "file_name": file, "height": label_map.shape[0], "width": label_map.shape[1]})
        for label in label_map.unique().tolist():
            if label >= len(names):
                raise ValueError(f"labels: expected classes below {len(names)} (the names), got {label} in {file}")
            if label < 0:
                continue
            runs = coco.encode(np.asfortranarray((label_map == label).cpu().numpy().astype(np.uint8)))
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": number,
                    "category_id": label + 1,
                    "iscrowd": 0,
                    "segmentation": {"size": list(runs["size"]), "counts": runs["counts"].decode("ascii")},
                    "area": int(coco.area(runs)),
                    "bbox": [int(side) for side in coco.toBbox(runs)],
                }
            )
    categories = [{"id": label + 1, "name": name} for label, name in enumerate(names)]
    info = {"description": "label maps by kfgs"}
    write_json(path, {"info": info, "images": images, "annotations": annotations, "categories": categories})


def read_coco(path: Path) -> tuple[dict[int, str], dict[str, CocoPicture]]:
    """The categories by id, and the pictures by stem; a ValueError if it is not COCO's JSON, or repeats a name."""
    top = read_json(path)
    expected = "COCO's 'categories', 'images' and 'annotations', each annotation with the id of an image"
    with reading(path, expected, "export it again"):
        names = {int(entry["id"]): str(entry["name"]) for entry in top["categories"]}
        pictures = {
            int(entry["id"]): CocoPicture((int(entry["height"]), int(entry["width"])), []) for entry in top["images"]
        }
        stems = {int(entry["id"]): file_stem(str(entry["file_name"])) for entry in top["images"]}
        for annotation in top["annotations"]:
            pictures[int(annotation["image_id"])].annotations.append(annotation)
    if len(set(stems.values())) != len(stems) or len(set(names.values())) != len(names) or not names or not pictures:
        raise ValueError(f"{path}: expected some images and categories, each name once; export it again")
    for number, picture in pictures.items():
        if min(picture.size) <= 0 or picture.size[0] * picture.size[1] > PIXELS:
            raise ValueError(f"{path}: expected a size of image {stems[number]!r}, got {picture.size}; export it again")
    return names, {stems[number]: picture for number, picture in pictures.items()}


def masks_of(
    path: Path, names: Mapping[int, str], picture: CocoPicture
) -> Iterator[tuple[int, Tensor, dict[str, Any]]]:
    """The category and the mask [H, W] bool of each object of a picture, and its annotation.

    Raises:
        ValueError: if an object has an unknown category, no pixel of the picture, or a damaged outline.
    """
    from pycocotools import mask as coco

    height, width = picture.size
    for annotation in picture.annotations:
        category: Any = annotation.get("category_id")
        outline: Any = annotation.get("segmentation")
        where = f"{path}, annotation {annotation.get('id')}"
        if not isinstance(category, int) or category not in names:
            raise ValueError(f"{where}: expected a category of the file ({len(names)} ids), got {category!r:.40}")
        try:
            if isinstance(outline, list):
                polygons = [_corners(polygon, picture.size) for polygon in outline]
                runs = coco.merge(coco.frPyObjects(polygons, height, width))
                mask = torch.from_numpy(coco.decode(runs)).bool()
            else:
                mask = decode_rle(outline)
            if tuple(mask.shape) != picture.size:
                raise ValueError(f"size {list(mask.shape)}, but the image has {list(picture.size)}")
        except Exception as error:  # pycocotools raises bare exceptions
            raise ValueError(
                f"{where}: expected polygons [x1, y1, x2, y2, x3, y3, ...] or run lengths, got {outline!r:.60} ({error}); "
                "export the annotations again"
            ) from error
        yield int(category), mask, annotation


def _corners(polygon: Any, size: tuple[int, int]) -> list[float]:
    """Numbers that pycocotools can draw: it takes all memory for a polygon that is not finite, or far outside."""
    corners = np.asarray(polygon, dtype=np.float64)
    if corners.ndim != 1 or len(corners) < 6 or len(corners) % 2 or not (np.abs(corners) <= FARTHEST).all():
        raise ValueError(f"expected at least three corners within {FARTHEST} pixels")
    x, y = corners[0::2], corners[1::2]
    if x.max() < 0 or y.max() < 0 or x.min() > size[1] or y.min() > size[0]:
        raise ValueError(f"it lies outside the image of {size[1]}x{size[0]}")
    return [float(value) for value in corners]
