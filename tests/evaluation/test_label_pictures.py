"""Labels of any folder: ids and colours."""

import json
from pathlib import Path

import numpy as np
import pytest
from messages import refused
from PIL import Image

from kfgs.evaluation.label_pictures import load_labels

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
