"""Label pictures, and COCO's JSON: what other programs export, and what kfgs writes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from PIL import Image

from kfgs.evaluation.coco import load_coco_examples, load_coco_labels, save_coco
from kfgs.evaluation.label_pictures import load_labels
from kfgs.labels.classify import decode_rle


def _coco(path: Path, **changes: object) -> Path:
    annotations = [
        {"id": 1, "image_id": 3, "category_id": 18, "bbox": [1, 0, 2, 2], "segmentation": [[1, 0, 3, 0, 3, 2, 1, 2]]},
        {"image_id": 3, "category_id": 1, "bbox": [0, 0, 2, 1], "segmentation": {"counts": [0, 1, 2, 1, 8], "size": [3, 4]}},
        {"id": 3, "image_id": 3, "category_id": 18, "bbox": [3, 2, 1, 1], "segmentation": {"size": [3, 4], "counts": ";1"}},
    ]  # fmt: skip
    top = {
        "images": [
            {"id": 3, "file_name": "left/a.jpg", "width": 4, "height": 3},
            {"id": 5, "file_name": "b.jpg", "width": 2, "height": 1},
        ],
        "categories": [{"id": 18, "name": "dog"}, {"id": 1, "name": "person"}],
        "annotations": annotations,
    }
    path.write_text(json.dumps(top | changes))
    return path


def test_coco(tmp_path: Path) -> None:
    path = _coco(tmp_path / "annotations.json")
    truth = load_labels(path)
    assert truth.names == ("dog", "person")
    # polygon: columns 1-2 of rows 0-1; then runs down the columns: (0, 0) and (0, 1) are the person's; last pixel the dog's
    assert {stem: labels.tolist() for stem, labels in truth.maps.items()} == {
        "left/a": [[1, 1, 0, -1], [-1, 0, 0, -1], [-1, -1, -1, 0]],
        "b": [[-1, -1]],
    }


def test_run_lengths_of_coco() -> None:
    assert decode_rle({"size": [3, 4], "counts": "32103"}).int().tolist() == [[0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    # 100 = 3 * 32 + 4: "T" (32 + 4 + 48), then "3"; -1 (difference) is 31 with its sign bit: "O"
    assert int(decode_rle({"size": [20, 10], "counts": "T3T3"}).sum()) == 100
    assert decode_rle({"size": [1, 9], "counts": "231O0"}).int().tolist() == [[0, 0, 1, 1, 1, 0, 1, 1, 0]]
    for counts, message in (([13, -1], "counts: expected"), ("T", "Invalid RLE"), ("3 1", "Invalid RLE")):
        with pytest.raises(ValueError, match=message):
            decode_rle({"size": [3, 4], "counts": counts})
    for size in ([10**9, 10**9], [2**15, 2**15], [-4, -4]):  # a few bytes that would fill the memory
        refused(lambda size=size: decode_rle({"size": size, "counts": [size[0] * size[1]]}), "another size")


def test_a_picture_of_coco_has_no_more_pixels_than_a_picture(tmp_path: Path) -> None:
    path = _coco(tmp_path / "coco.json", images=[{"id": 3, "file_name": "a.png", "height": 2**15, "width": 2**15}])
    refused(lambda: load_coco_labels(path), "coco.json", "expected a size of image 'a'", "(32768, 32768)")


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"category_id": 7}, ("annotation 9", "category", "7")),
        ({"category_id": [7]}, ("annotation 9", "category", "[7]")),
        ({"segmentation": [[1, 2, 3, 4]]}, ("annotation 9", "polygons")),
        ({"segmentation": []}, ("annotation 9", "polygons")),
        ({"segmentation": {"size": [4, 3], "counts": [12]}}, ("annotation 9", "size [4, 3]", "[3, 4]")),
        ({"segmentation": {"size": [3, 4], "counts": [2]}}, ("annotation 9", "fill [3, 4] pixels")),
        ({"segmentation": {"size": [3, 4], "counts": "zz"}}, ("annotation 9", "polygons")),
        ({"segmentation": [[0, 0, 1, 0, 1, 1e30]]}, ("annotation 9", "100000 pixels")),
        ({"segmentation": [[5, 0, 7, 0, 7, 2]]}, ("annotation 9", "outside the image of 4x3")),
        ({"image_id": 77}, ("'categories', 'images' and 'annotations'",)),
    ],
)
def test_coco_annotations_that_are_damaged(tmp_path: Path, changes: dict, parts: tuple[str, ...]) -> None:
    good = {"id": 9, "image_id": 3, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [[0, 0, 1, 0, 1, 1]]}
    path = _coco(tmp_path / "coco.json", annotations=[good | changes])
    refused(lambda: load_coco_labels(path).maps["left/a"], "coco.json", *parts)


@pytest.mark.parametrize(
    ("outline", "labels"),
    [
        ([2, 1, 9, 1, 9, 9, 2, 9], [[-1, -1, -1, -1], [-1, -1, 1, 1], [-1, -1, 1, 1]]),  # the rest of it is outside
        ([1, 1, 1.2, 1, 1.2, 1.2], [[-1] * 4] * 3),  # inside, but between the centres of pixels
    ],
)
def test_coco_objects_that_leave_their_picture_or_are_thin(tmp_path: Path, outline: list, labels: list) -> None:
    one = {"id": 9, "image_id": 3, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [outline]}
    assert load_coco_labels(_coco(tmp_path / "coco.json", annotations=[one])).maps["left/a"].tolist() == labels


def test_a_category_of_coco_that_means_no_class_is_not_scored(tmp_path: Path) -> None:
    named = [{"id": 18, "name": "Un-labelled"}, {"id": 1, "name": "person"}, {"id": 7, "name": "cat"}]
    here = {"image_id": 3, "bbox": [0, 0, 2, 1]}
    both = [
        here | {"category_id": 1, "segmentation": [[0, 0, 4, 0, 4, 3, 0, 3]]},
        here | {"category_id": 18, "segmentation": [[1, 0, 3, 0, 3, 2, 1, 2]]},  # over the person
    ]
    truth = load_coco_labels(_coco(tmp_path / "coco.json", categories=named, annotations=both))
    assert truth.names == ("person", "cat")
    assert truth.maps["left/a"].tolist() == [[0, -1, -1, 0], [0, -1, -1, 0], [0, 0, 0, 0]]
    assert truth.maps["b"].tolist() == [[-1, -1]]
    examples = load_coco_examples(tmp_path / "coco.json")
    assert {name: [mask.view for mask in masks] for name, masks in examples.items()} == {"person": ["left/a"]}
    with pytest.raises(ValueError, match=tells("coco.json", "expected objects as examples")):
        load_coco_examples(_coco(tmp_path / "coco.json", categories=named, annotations=both[1:]))


def test_label_maps_come_back_from_coco(tmp_path: Path) -> None:
    maps = {
        "left/a.png": torch.tensor([[-1, 2, 2], [0, 2, -1], [0, 0, -1], [2, -1, -1]]),
        "b.png": torch.tensor([[1, 1]]),
        "c.png": torch.full((2, 2), -1),
    }
    names = ("wall", "dog", "cat")
    save_coco(tmp_path / "coco.json", maps, names)
    truth = load_coco_labels(tmp_path / "coco.json")
    assert truth.names == names
    assert {f"{stem}.png": labels.tolist() for stem, labels in truth.maps.items()} == {
        name: labels.tolist() for name, labels in maps.items()
    }
    written = json.loads((tmp_path / "coco.json").read_text())
    cat = next(one for one in written["annotations"] if one["category_id"] == 3)
    assert (cat["area"], cat["bbox"], cat["iscrowd"], cat["image_id"]) == (4, [0, 0, 3, 4], 0, 1)
    assert [one["id"] for one in written["annotations"]] == [1, 2, 3]
    assert written["images"][1] == {"id": 2, "file_name": "b.png", "height": 1, "width": 2}
    refused(lambda: save_coco(tmp_path / "coco.json", maps, names[:2]), "labels:", "below 2", "got 2 in left/a.png")


RED, GREEN, BLACK = (255, 0, 0), (0, 255, 0), (0, 0, 0)


def _save(path: Path, values: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.array(values, np.uint8)).save(path)


def test_ids_with_a_list_of_names(tmp_path: Path) -> None:
    _save(tmp_path / "labels/a.png", [[0, 1], [255, 1]])
    _save(tmp_path / "labels/sub/b.png", [[1, 1]])
    (tmp_path / "classes.json").write_text(json.dumps(["wall", "floor"]))
    truth = load_labels(tmp_path / "labels")
    assert truth.names == ("wall", "floor")
    assert {stem: labels.tolist() for stem, labels in truth.maps.items()} == {"a": [[0, 1], [-1, 1]], "sub/b": [[1, 1]]}


def test_ids_of_sixteen_bits_with_gaps(tmp_path: Path) -> None:
    Image.fromarray(np.array([[1000, 3]], np.uint16)).save(tmp_path / "a.png")
    (tmp_path / "classes.json").write_text(json.dumps({"wall": 1000, "void": 3}))
    truth = load_labels(tmp_path)
    assert (truth.names, truth.maps["a"].tolist()) == (("wall",), [[0, -1]])


@pytest.mark.parametrize(
    "table",
    [
        {"wall": RED, "unlabelled": BLACK, "floor": GREEN},
        [{"name": name, "color": color} for name, color in (("wall", RED), ("void", BLACK), ("floor", GREEN))],
    ],
)
def test_coloured_pictures(tmp_path: Path, table: dict | list) -> None:
    _save(tmp_path / "a.png", [[RED, GREEN], [BLACK, RED]])
    _save(tmp_path / "b.png", [[(*RED, 255), (*GREEN, 0)]])  # with alpha
    indexed = Image.new("P", (2, 1))
    indexed.putpalette([*GREEN, *RED])
    indexed.putdata([0, 1])
    indexed.save(tmp_path / "c.png")
    (tmp_path / "colors.json").write_text(json.dumps(table), encoding="utf-8")
    truth = load_labels(tmp_path)
    assert truth.names == ("wall", "floor")
    found = {stem: labels.tolist() for stem, labels in truth.maps.items()}
    assert found == {"a": [[0, 1], [-1, 0]], "b": [[0, 1]], "c": [[1, 0]]}


def test_labels_that_are_not_whole(tmp_path: Path) -> None:
    refused(lambda: load_labels(tmp_path / "nothing"), "nothing", "no such folder", error=FileNotFoundError)
    refused(lambda: load_labels(tmp_path), tmp_path, ".png", "JPEGs", error=FileNotFoundError)
    _save(tmp_path / "a.png", [[0, 7]])
    refused(lambda: load_labels(tmp_path), "classes.json", "table=PATH", error=FileNotFoundError)
    (tmp_path / "classes.json").write_text(json.dumps(["wall", "floor"]))
    refused(lambda: load_labels(tmp_path).maps["a"], "a.png", "classes.json", "id 7", "void")
    _save(tmp_path / "a.png", [[RED]])
    refused(lambda: load_labels(tmp_path).maps["a"], "a.png", "one channel", "table of colours")
    (tmp_path / "classes.json").write_text(json.dumps({"wall": RED}))
    _save(tmp_path / "a.png", [[RED, (254, 1, 0)]])
    refused(lambda: load_labels(tmp_path).maps["a"], "a.png", "colour (254, 1, 0)", "resizing or JPEG")
    (tmp_path / "a.png").write_bytes(b"no picture")
    refused(lambda: load_labels(tmp_path).maps["a"], "a.png", "cannot be decoded")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('{"a": 1, "b": 1}', ("id or a colour", "'b'")),
        ('{"a": [1, 2, 300]}', ("'a'", "300")),
        ('{"a": 1, "b": [1, 2, 3]}', ("both",)),
        ('["a", "a"]', ("'a'",)),
        ("7", ("list of names",)),
        ("[]", ("none",)),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, parts: tuple[str, ...]) -> None:
    _save(tmp_path / "a.png", [[0]])
    (tmp_path / "t.json").write_text(text)
    refused(lambda: load_labels(tmp_path, tmp_path / "t.json"), "t.json", *parts)
