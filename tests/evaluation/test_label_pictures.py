"""Labels of any folder: ids and colours."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.evaluation.label_pictures import load_label_map, load_labels

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
    ("name", "text"),
    [
        ("colors.json", json.dumps({"wall": RED, "unlabelled": BLACK, "floor": GREEN})),
        (
            "colors.json",
            json.dumps([{"name": n, "color": c} for n, c in (("wall", RED), ("void", BLACK), ("floor", GREEN))]),
        ),
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
        load_labels(tmp_path).maps["a"]
    _save(tmp_path / "a.png", [[RED]])
    with pytest.raises(ValueError, match=tells("a.png", "one channel", "table of colours")):
        load_labels(tmp_path).maps["a"]
    (tmp_path / "classes.json").write_text(json.dumps({"wall": RED}))
    _save(tmp_path / "a.png", [[RED, (254, 1, 0)]])
    with pytest.raises(ValueError, match=tells("a.png", "colour (254, 1, 0)", "resizing or JPEG")):
        load_labels(tmp_path).maps["a"]
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=tells("a.png", "cannot be decoded")):
        load_labels(tmp_path).maps["a"]


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
    ],
)
def test_bad_tables(tmp_path: Path, name: str, text: str, parts: tuple[str, ...]) -> None:
    _save(tmp_path / "a.png", [[0]])
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=tells(name, *parts)):
        load_labels(tmp_path, tmp_path / name)


def test_the_real_room(shared_data: Path) -> None:
    folder = shared_data / "room_0/labels_scored"
    truth = load_labels(folder)
    stem = sorted(truth.maps)[0]
    assert (len(truth.names), truth.names[:3]) == (18, ("wall", "ceiling", "floor"))
    assert torch.equal(truth.maps[stem], load_label_map(folder / f"{stem}.png"))
