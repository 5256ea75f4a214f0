"""The command search."""

import csv
import json
import shutil

import pytest
import torch
from cases_search import COUNT, DIM, NAMES, save_scenes, scene, table

from kfgs._files import locked
from kfgs.cli import main
from kfgs.scale.search_file import NAME
from kfgs.scale.search_update import LOCK


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = save_scenes(
        tmp_path_factory.mktemp("runs"),
        a=scene([("wall", 0.0), ("chair", 0.0), ("chair", 3.0)], 1),
        b=scene([("wall", 0.0), ("lamp", 0.0)], 2),
        other=scene([("wall", 0.0), ("table", 0.0)], 3, teacher="another"),
    )
    assert main(["search", "chair", str(folder)]) == 0
    return folder


class Words:
    """A teacher whose text encoder knows the words of the cases."""

    name = "toy"

    def encode_image(self, image):
        raise NotImplementedError

    def encode_text(self, texts):
        known = table()
        negative = [*known.negative_names, "stuff", "texture"]
        rows = {**dict(zip(known.names, known.embeddings, strict=True)), **dict.fromkeys(negative, known.negatives[0])}
        return torch.stack([rows.get(text, torch.ones(DIM)) for text in texts])


def test_the_first_search_makes_the_index_and_says_so(tmp_path, capsys):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    assert main(["search", "chair", str(tmp_path)]) == 0
    first = capsys.readouterr().out
    assert f"index: 1 field added; 1 in {tmp_path / NAME}" in first
    assert main(["search", "chair", str(tmp_path)]) == 0
    second = capsys.readouterr().out
    assert "index:" not in second
    assert second in first
    shutil.rmtree(tmp_path / "a")
    assert main(["search", "chair", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "1 removed" in said.out
    assert "expected fields below" in said.err


def test_an_empty_folder_gets_no_index(tmp_path, capsys):
    assert main(["search", "chair", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith(f"error: FOLDER: expected fields below {tmp_path}")
    assert list(tmp_path.iterdir()) == []


def test_the_table_names_scene_place_size_and_view(runs, capsys):
    assert main(["search", "chair", str(runs)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"chair: in 1 of 3 scenes, {2 * COUNT - 3} Gaussians in 2 parts")
    assert lines[1].split() == ["scene", "parts", "score", "Gaussians", "center", "size", "best", "view"]
    assert lines[2].split()[:2] == ["a/field", "2"]
    assert lines[2].split()[3] == str(COUNT)
    assert "at the" in lines[2]
    assert lines[3].split()[1] == str(COUNT - 3)


def test_json_holds_every_part(runs, tmp_path, capsys):
    out = tmp_path / "found.json"
    assert main(["search", "chair", str(runs), "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert (found["query"], found["searched"], found["unasked"]) == ("chair", 3, {})
    (one,) = found["scenes"]
    assert (one["path"], one["count"], one["exact"], len(one["parts"])) == ("a/field", 2 * COUNT - 3, True, 2)
    assert set(one["parts"][0]) == {"count", "score", "center", "low", "high", "view", "share"}
    assert str(out) in capsys.readouterr().out


def test_csv_has_a_row_for_each_part(runs, tmp_path, capsys):
    out, whole = tmp_path / "found.csv", tmp_path / "found.json"
    for _ in range(2):  # its own file is replaced
        assert main(["search", "chair", str(runs), "--csv", str(out), "--json", str(whole)]) == 0
    assert str(out) in capsys.readouterr().out
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    parts = json.loads(whole.read_text())["scenes"][0]["parts"]
    assert [row["number"] for row in rows] == ["1", "2"]
    for row, part in zip(rows, parts, strict=True):
        assert (row["scene"], row["class"], row["photo"]) == ("a/field", "chair", part["view"] or "")
        assert [float(row[axis]) for axis in "xyz"] == part["center"]
        size = [high - low for low, high in zip(part["low"], part["high"], strict=True)]
        assert [float(row[f"size_{axis}"]) for axis in "xyz"] == size
        assert (float(row["score"]), int(row["Gaussians"])) == (part["score"], part["count"])
    assert main(["search", "chair", str(runs), "--csv", str(out), "--json", str(out)]) == 1
    assert "--csv: expected another file" in capsys.readouterr().err
    out.write_text("my,own\n1,2\n")
    assert main(["search", "chair", str(runs), "--csv", str(out)]) == 1
    assert "found.csv" in capsys.readouterr().err
    assert out.read_text() == "my,own\n1,2\n"


def test_a_part_that_may_be_two_things_is_marked(tmp_path, capsys):
    chairs = [("chair", 0.0), ("chair", 4.0), ("chair", 8.0), ("chair", 12.0), ("chair", 12.15), ("chair", 12.3)]
    save_scenes(tmp_path, a=scene([("wall", 30.0), *chairs], 1))
    assert main(["search", "chair", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "in 4 parts" in said, said
    assert [" ?" in line for line in said.splitlines()[3:7]] == [True, False, False, False], said
    assert "?: more than 1.6 times as long as the median" in said


def test_words_are_marked_and_exact_asks_the_fields(runs, capsys):
    assert main(["search", "chair", str(runs), "--threshold", "0.6"]) == 0
    by_words = capsys.readouterr().out
    assert f"~{COUNT}" in by_words
    assert "--exact" in by_words
    assert main(["search", "chair", str(runs), "--threshold", "0.6", "--exact", "5"]) == 0
    assert "~" not in capsys.readouterr().out


def test_a_phrase_and_an_example(runs, monkeypatch, capsys):
    import kfgs.teachers.load

    monkeypatch.setattr(kfgs.teachers.load, "load_teacher", lambda *_: Words())
    assert main(["search", "lamp", str(runs), "--teacher", "toy"]) == 0
    out = capsys.readouterr().out
    assert "lamp: in 1 of 2 scenes" in out
    assert "note: not asked: other/field" in out
    example = str(runs / "a" / "field")
    assert main(["search", str(runs), "--like", example, "--index", str(COUNT + 1)]) == 0
    assert f"like {example}:{COUNT + 1}: in 1 of 2 scenes" in capsys.readouterr().out


def test_while_another_process_extends_the_index_the_old_one_answers(tmp_path, capsys):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    with locked(tmp_path, LOCK):
        assert main(["search", "chair", str(tmp_path)]) == 1  # there is none yet
    assert main(["search", "chair", str(tmp_path)]) == 0
    save_scenes(tmp_path, b=scene([("wall", 0.0), ("chair", 0.0)], 2))
    capsys.readouterr()
    with locked(tmp_path, LOCK):
        assert main(["search", "chair", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "note: the index is not extended now" in out
    assert "in 1 of 1 scenes" in out


def test_a_folder_that_cannot_be_written_to_is_still_searched(tmp_path, capsys):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    assert main(["search", "chair", str(tmp_path)]) == 0
    save_scenes(tmp_path, b=scene([("wall", 0.0), ("chair", 0.0)], 2))
    (tmp_path / LOCK).unlink()
    (tmp_path / LOCK).mkdir()  # an OSError, also for root
    capsys.readouterr()
    assert main(["search", "chair", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "note: the index is not extended now" in out
    assert "in 1 of 1 scenes" in out


def test_copied_fields_are_not_called_new(tmp_path, capsys):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    assert main(["search", "chair", str(tmp_path)]) == 0
    before = (tmp_path / NAME).read_bytes()
    (tmp_path / "a" / "field" / "field.json").touch()
    capsys.readouterr()
    assert main(["search", "chair", str(tmp_path)]) == 0
    assert "index:" not in capsys.readouterr().out
    assert (tmp_path / NAME).read_bytes() != before  # it knows the new time


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["chair"], "QUERY FOLDER"),
        (["chair", "RUNS", "--index", "3"], "--index"),
        (["chair", "RUNS", "--like", "RUNS/a/field", "--index", "3"], "--like"),
        (["RUNS", "--like", "RUNS/a/field"], "--index N"),
        (["RUNS", "--like", "RUNS/a/field", "--index", "3", "--text", "x.safetensors"], "--text: expected none"),
        (["RUNS", "--like", "RUNS/a/field", "--index", "100000"], "index"),
        (["chair", "RUNS", "--weights", "w"], "--weights"),
        (["chair", "RUNS", "--exact", "-1"], "--exact"),
        (["chair", "RUNS", "--top", "0"], "--top"),
        (["chair", "RUNS/nothing"], "expected a folder with runs"),
        (["cheir", "RUNS"], "did you mean 'chair'"),
        (["cheir", "RUNS"], "pass --teacher and --weights"),
        (["chair", "RUNS", "--threshold", "7"], "--threshold"),
    ],
)
def test_wrong_arguments_are_one_line(runs, arguments, message, capsys):
    assert main(["search", *(word.replace("RUNS", str(runs)) for word in arguments)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_names_of_the_cases_are_those_of_their_table():
    assert table().names == NAMES
