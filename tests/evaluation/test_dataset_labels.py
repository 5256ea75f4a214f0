"""Labels of any folder: ids, colours, COCO."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.evaluation import load_label_map
from kfgs.evaluation.datasets import load_coco_labels, load_coco_masks, load_labels, save_coco

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
    (tmp_path / "classes.csv").write_text("name,id\nwall,1000\nvoid,3\n")
    truth = load_labels(tmp_path)
    assert (truth.names, truth.maps["a"].tolist()) == (("wall",), [[0, -1]])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("colors.json", json.dumps({"wall": RED, "unlabelled": BLACK, "floor": GREEN})),
        (
            "colors.json",
            json.dumps([{"name": n, "color": c} for n, c in (("wall", RED), ("void", BLACK), ("floor", GREEN))]),
        ),
        ("colors.csv", "wall,255,0,0\nVoid,0,0,0\n\nfloor,0,255,0\n"),
        ("colors.csv", "\ufeffname,r,g,b\nwall, 255, 0, 0\nignore,0,0,0\nfloor,0,255,0\n"),
    ],
)
def test_coloured_pictures(tmp_path: Path, name: str, text: str) -> None:
    _save(tmp_path / "a.png", [[RED, GREEN], [BLACK, RED]])
    _save(tmp_path / "b.png", [[(*RED, 255), (*GREEN, 0)]])  # with alpha
    (tmp_path / name).write_text(text, encoding="utf-8")
    truth = load_labels(tmp_path)
    assert truth.names == ("wall", "floor")
    assert {stem: labels.tolist() for stem, labels in truth.maps.items()} == {"a": [[0, 1], [-1, 0]], "b": [[0, 1]]}


def test_a_palette_with_a_table_of_colours(tmp_path: Path) -> None:
    picture = Image.new("P", (2, 1))
    picture.putpalette([*GREEN, *RED])
    picture.putdata([0, 1])
    picture.save(tmp_path / "a.png")
    (tmp_path / "colors.json").write_text(json.dumps({"wall": RED, "floor": GREEN}))
    assert load_labels(tmp_path).maps["a"].tolist() == [[1, 0]]


def test_labels_that_are_not_whole(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells("nothing", "no such folder")):
        load_labels(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match=tells(tmp_path, ".png", "JPEGs")):
        load_labels(tmp_path)
    _save(tmp_path / "a.png", [[0, 7]])
    with pytest.raises(FileNotFoundError, match=tells("classes.json", "table=PATH")):
        load_labels(tmp_path)
    (tmp_path / "classes.json").write_text(json.dumps(["wall", "floor"]))
    with pytest.raises(ValueError, match=tells("a.png", "classes.json", "id 7", "void")):
        load_labels(tmp_path)
    _save(tmp_path / "a.png", [[RED]])
    with pytest.raises(ValueError, match=tells("a.png", "one channel", "table of colours")):
        load_labels(tmp_path)
    (tmp_path / "classes.json").write_text(json.dumps({"wall": RED}))
    _save(tmp_path / "a.png", [[RED, (254, 1, 0)]])
    with pytest.raises(ValueError, match=tells("a.png", "colour (254, 1, 0)", "resizing or JPEG")):
        load_labels(tmp_path)
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=tells("a.png", "cannot be decoded")):
        load_labels(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("t.json", '{"a": 1, "b": 1}', ("id or a colour", "'b'")),
        ("t.json", '{"a": [1, 2]}', ("'a'", "[1, 2]")),
        ("t.json", '{"a": [1, 2, 300]}', ("'a'", "300")),
        ("t.json", '{"a": 1, "b": [1, 2, 3]}', ("both",)),
        ("t.json", '["a", "a"]', ("'a'",)),
        ("t.json", "7", ("list of names",)),
        ("t.json", "[]", ("none",)),
        ("t.csv", "a,1\nb,1,2\n", ("name,r,g,b", "b,1,2")),
        ("t.csv", "a,1\nb,x\n", ("b,x",)),
    ],
)
def test_bad_tables(tmp_path: Path, name: str, text: str, parts: tuple[str, ...]) -> None:
    _save(tmp_path / "a.png", [[0]])
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=tells(name, *parts)):
        load_labels(tmp_path, tmp_path / name)


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
    masks = load_coco_masks(path)
    assert list(masks.frames) == ["left/a"]
    dog = masks.frames["left/a"]["dog"]
    assert dog.mask.int().tolist() == [[0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]]
    assert dog.boxes is not None
    assert dog.boxes.tolist() == [[1, 0, 3, 2], [3, 2, 4, 3]]


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"category_id": 7}, ("annotation 9", "category", "7")),
        ({"category_id": [7]}, ("annotation 9", "category", "[7]")),
        ({"segmentation": [[1, 2, 3, 4]]}, ("annotation 9", "polygons")),
        ({"segmentation": []}, ("annotation 9", "polygons or run lengths")),
        ({"segmentation": {"size": [4, 3], "counts": [12]}}, ("annotation 9", "(3, 4)", "(4, 3)")),
        ({"segmentation": {"size": [3, 4], "counts": [2]}}, ("annotation 9", "add up to 3 x 4")),
        ({"bbox": [1, 2]}, ("annotation 9", "bbox")),
        ({"segmentation": [[5, 0, 7, 0, 7, 2]]}, ("annotation 9", "4x3", "x 5 to 7, y 0 to 2", "outside")),
    ],
)
def test_coco_annotations_that_are_damaged(tmp_path: Path, changes: dict, parts: tuple[str, ...]) -> None:
    good = {"id": 9, "image_id": 3, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [[0, 0, 1, 0, 1, 1]]}
    path = _coco(tmp_path / "coco.json", annotations=[good | changes])
    with pytest.raises(ValueError, match=tells("coco.json", *parts)):
        load_coco_masks(path)


def test_coco_objects_that_leave_their_picture_or_are_thin(tmp_path: Path) -> None:
    good = {"id": 9, "image_id": 3, "category_id": 1, "bbox": [0, 0, 1, 1]}
    for outline, mask in (
        ([2, 1, 9, 1, 9, 9, 2, 9], [[0, 0, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]),  # the rest of it is outside
        ([1, 1, 1.2, 1, 1.2, 1.2], [[0] * 4] * 3),  # inside, but between the centres of pixels
    ):
        path = _coco(tmp_path / "coco.json", annotations=[good | {"segmentation": [outline]}])
        assert load_coco_masks(path).frames["left/a"]["person"].mask.int().tolist() == mask


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
    assert list(load_coco_masks(tmp_path / "coco.json").frames["left/a"]) == ["person"]
    alone = _coco(tmp_path / "coco.json", categories=named, annotations=both[1:])
    assert list(load_coco_masks(alone).frames) == []


def test_coco_files_that_are_damaged(tmp_path: Path) -> None:
    path = tmp_path / "coco.json"
    for changes in ({"images": None}, {"annotations": [{"image_id": 77}]}, {"categories": [{"id": 1}]}):
        with pytest.raises(ValueError, match=tells("coco.json", "'categories', 'images' and 'annotations'")):
            load_coco_labels(_coco(path, **changes))
    with pytest.raises(ValueError, match=tells("coco.json", "size of image 'x'")):
        load_coco_labels(_coco(path, images=[{"id": 3, "file_name": "x.png", "width": 0, "height": 3}], annotations=[]))


def test_the_real_room(shared_data: Path) -> None:
    folder = shared_data / "room_0/labels_scored"
    truth = load_labels(folder)
    stem = sorted(truth.maps)[0]
    assert (len(truth.names), truth.names[:3]) == (18, ("wall", "ceiling", "floor"))
    assert torch.equal(truth.maps[stem], load_label_map(folder / f"{stem}.png"))


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
    boxes = load_coco_masks(tmp_path / "coco.json").frames["left/a"]["wall"].boxes
    assert boxes is not None
    assert boxes.tolist() == [[0, 1, 2, 3]]
    with pytest.raises(ValueError, match=tells("labels:", "below 2", "got 2 in left/a.png")):
        save_coco(tmp_path / "coco.json", maps, names[:2])
