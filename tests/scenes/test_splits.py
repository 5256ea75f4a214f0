import json
from pathlib import Path

import pytest
from messages import refused

from kfgs.scenes import SceneError
from kfgs.scenes.files import natural_key
from kfgs.scenes.scene import make_split, read_split


def test_the_papers_split_takes_every_10th_from_the_1st_and_6th() -> None:
    split = make_split(900, "df3dgs")
    assert split["test"][:3] == [0, 10, 20]
    assert split["train"][:3] == [5, 15, 25]
    assert (len(split["train"]), len(split["test"])) == (90, 90)


def test_holdout8_and_all() -> None:
    split = make_split(17, "holdout8")
    assert split == {"train": [1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15], "test": [0, 8, 16]}
    assert make_split(3, "all") == {"train": [0, 1, 2], "test": []}


def test_numbers_sort_as_numbers() -> None:
    names = ["rgb_10", "rgb_5", "rgb_100", "a", "rgb_05b", "10", "9"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "rgb_05b", "rgb_5", "rgb_10", "rgb_100"]
    assert sorted(["²", "1", "x1y2", "x1y10"], key=natural_key) == ["1", "x1y2", "x1y10", "²"]  # ² is no digit to int()


def _write(path: Path, value: object) -> Path:
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_a_split_file_lists_stems(tmp_path: Path) -> None:
    _write(tmp_path / "split.json", {"train": ["c", "a.png"], "test": ["b", "cc"], "hard": ["a"]})
    splits, notes = read_split(tmp_path, ["a.png", "b.png", "c.png"])
    assert splits == {"train": [0, 2], "test": [1], "hard": [0]}
    assert [note.partition(" in ")[0] for note in notes] == ["1 names"]
    assert notes[0].endswith("not in the scene: cc (did you mean 'c.png'?)")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("{", ("JSON", "repair")),
        ("[" * 100_000, ("JSON", "nest too deep", "repair")),
        ([], ('{"train": [names], "test": [names]}', "got []")),
        ({"test": ["a"]}, ("'train'", "got {'test': ['a']}")),
        ({"train": [1]}, ("stems", "got {'train': [1]}")),
        ({"train": ["x"], "test": ["a"]}, ("none", "(x)", "names")),
        ({"train": ["a", "b"], "test": ["b"]}, ("train and test", "b and 0 more")),
    ],
)
def test_wrong_split_files_are_refused(tmp_path: Path, value: object, message: str) -> None:
    refused(lambda: read_split(_write(tmp_path / "split.json", value).parent, ["a", "b"]), *message, error=SceneError)


@pytest.mark.parametrize(
    ("files", "train", "test"),
    [
        ({"test.txt": "images/b.png\r\n"}, [0, 2, 3], [1]),
        ({"test.txt": "\ufeffb\n"}, [0, 2, 3], [1]),
        ({"train_list.txt": "a.JPG\nc.JPG\n", "test_list.txt": "d.JPG"}, [0, 2], [3]),
        ({"train.txt": "a\nb\n", "val.txt": "c"}, [0, 1], [2]),  # d is in no list
        ({"train_test_lists.json": '{"train": ["a.png"], "test": ["B.PNG"], "has_masks": true}'}, [0], [1]),
        ({"split.json": '{"train": ["a"], "val": ["d"]}'}, [0], [3]),
    ],
)
def test_lists_of_views_are_obeyed(tmp_path: Path, files: dict[str, str], train: list[int], test: list[int]) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    names = ["a.png", "b.png", "c.png", "d.png"]
    read = read_split(tmp_path, names)
    assert read is not None
    assert (read[0]["train"], read[0]["test"], read[1]) == (train, test, [])


def test_unknown_names_of_a_list_are_told_and_lists_without_a_view_refused(tmp_path: Path) -> None:
    names = ["a.png", "b.png"]
    assert read_split(tmp_path, names) is None
    (tmp_path / "test.txt").write_text("b.png\nframe_b.png\n")
    (tmp_path / "val.txt").write_text("frame_b.png\n")  # named once
    splits, notes = read_split(tmp_path, names) or ({}, [])
    (tmp_path / "val.txt").unlink()
    assert splits == {"train": [0], "val": [], "test": [1]}
    assert "1 names" in notes[0]
    assert notes[0].endswith("test.txt are not in the scene: frame_b.png (did you mean 'b.png'?)")
    for text in ("frame_1.png", "a.png\nb.png"):
        (tmp_path / "test.txt").write_text(text)
        refused(lambda: read_split(tmp_path, names), "test.txt", text[:5], "correct the names", error=SceneError)
    (tmp_path / "test.txt").write_bytes(b"K\xfcche.png")
    refused(lambda: read_split(tmp_path, names), "save it as UTF-8", error=SceneError)
