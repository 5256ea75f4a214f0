"""Words on the command line: a table made once, and queries that it answers."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
from cases_color import surface
from cases_text import DIM, TEACHER, letters, save_letters
from messages import refused, tells
from PIL import Image

from kfgs.cli import features, main
from kfgs.cli.features import read_words
from kfgs.cli.options import Classes, Teacher, Views
from kfgs.fields import SemanticField
from kfgs.labels import load_label_set
from kfgs.teachers.prompts import make_label_set

LETTERS = ["--teacher", "cases_text:TEACHER"]


def text(names, teacher, out):
    features(words=names, views=Views(), teacher=Teacher(teacher), out=out)


@pytest.fixture(scope="module")
def names(room):
    return json.loads((room / "classes.json").read_text())


@pytest.fixture(scope="module")
def truth(room):
    return surface(room)[1]


@pytest.fixture(scope="module")
def field(room, tmp_path_factory):
    return save_letters(room, tmp_path_factory.mktemp("letters"))[0]


def count(truth, names, name):
    return int((truth == names.index(name)).sum())


def test_words_are_words_whatever_lies_in_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "chair").mkdir()
    assert read_words("chair") == ["chair"]
    many = [f"class number {i}" for i in range(400)]  # longer than any file name, and than any path
    assert read_words(",".join(many)) == many
    refused(lambda: read_words("a" * 300 + ".txt"), "no such file", "text", error=FileNotFoundError)


def test_text_writes_a_table_with_its_origin(tmp_path, capsys):
    out = tmp_path / "new" / "t.safetensors"
    text("wall,chair;seat", "cases_text:TEACHER", out)
    said = capsys.readouterr().out
    assert f"2 classes, {DIM} channels each, by letters, as" in said
    assert "chair: also seat" in said
    assert f"wrote:\n  {out}" in said
    found = load_label_set(out)
    assert found.names == ("wall", "chair")
    expected = make_label_set(TEACHER, ["wall", "chair;seat"])
    assert found.embeddings.equal(expected.embeddings)
    assert found.negatives.equal(expected.negatives)


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        ("wall", {"out": "t.npy"}, ("out:", ".safetensors")),
        ("wall", {"out": "."}, ("out:", ".safetensors")),
        ("wall", {"teacher": "cases_text:MUTE"}, ("teacher 'mute':", "text encoder")),
        ("wall", {"teacher": "no_such_teacher"}, ("teacher:", "got 'no_such_teacher'")),
        (" , ", {}, ("words:", "got none")),
        ("", {}, ("words:", "got none", "''")),
        ("{tmp}/a.yaml", {}, ("words:", ".json", ".txt")),
        ("{tmp}/no.json", {}, ("no such file", "JSON")),
        ("{tmp}/no.txt", {}, ("no such file", "text", "class")),
        ("{tmp}/a.json", {}, ("words:", "got {'wall': 1}")),
        ("{tmp}/a.txt", {}, ("UTF-8", "text")),
    ],
)
def test_text_names_what_is_wrong_and_writes_nothing(tmp_path, names, options, message):
    (tmp_path / "a.json").write_text('{"wall": 1}')
    (tmp_path / "a.txt").write_bytes(b"K\xfcche")
    (tmp_path / "a.yaml").write_text("- wall")
    given = {"teacher": "cases_text:TEACHER", "out": "t.safetensors"} | options
    given["out"] = tmp_path / given["out"]
    with pytest.raises((ValueError, FileNotFoundError, NotImplementedError), match=tells(*message)):
        text(names.format(tmp=tmp_path), **given)
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", "a.txt", "a.yaml"}


def test_a_table_in_the_scene_is_found(field, room, truth, names, tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(room, scene, ignore=shutil.ignore_patterns("classes.json", "text.npy"))
    text(",".join(reversed(names)), "cases_text:TEACHER", scene / "text.safetensors")
    assert Classes(scene).load_classes().names == tuple(reversed(names))
    assert main(["select", "lamp", str(field), "--scene", str(scene)]) == 0
    assert "lamp: " in capsys.readouterr().out
    shutil.copy(room / "classes.json", scene)  # label pictures count as it does
    assert Classes(scene).load_classes().names == tuple(names)
    assert capsys.readouterr().out == ""
    whole = Classes(scene, text=scene / "text.safetensors").load_classes()
    assert whole.names == tuple(reversed(names))
    assert "note: label numbers follow the class list of" in capsys.readouterr().out
    np.save(scene / "text.npy", np.ones((len(names), 3), np.float32))
    assert Classes(scene).load_classes().embeddings.shape == (len(names), 3)  # the pair of old goes first


def test_any_phrase_with_a_teacher_and_no_table(field, truth, names, capsys):
    """Letters count without case, so LAMP is where the lamp is, and "object" is another word."""
    assert main(["select", "LAMP", str(field), *LETTERS]) == 0
    said = capsys.readouterr().out
    assert "more like the query than like any of 4 negatives" in said
    field_rows = SemanticField.load(field).latents.double()
    lamp = letters(["lamp", *["object", "things", "stuff", "texture"]])
    cosine = torch.nn.functional.normalize(field_rows, dim=1) @ torch.nn.functional.normalize(lamp.double(), dim=1).T
    expected = int((cosine[:, 0] > cosine[:, 1:].amax(dim=1) + 1e-6).sum())
    assert f"LAMP: {expected} of 4000 Gaussians" in said
    assert expected >= count(truth, names, "lamp")


def test_words_of_another_teacher_are_noted(field, names, tmp_path, capsys):
    table = tmp_path / "t.safetensors"
    made = make_label_set(TEACHER, names)
    made.info["teacher"] = {"name": "clip"}
    made.save(table)
    assert main(["select", "lamp", str(field), "--text", str(table)]) == 0
    said = capsys.readouterr().out
    assert "note: --text: expected those of the field's teacher, got text of another teacher (name 'clip'" in said
    assert main(["select", "palm", str(field), "--text", str(table), *LETTERS]) == 0
    said = capsys.readouterr().out
    note = "note: --text: expected a table by the query's teacher (from --teacher and --weights), got one by another"
    assert note in said
    assert "they cannot be compared: use the table's teacher for the query" in said
    assert "field's teacher" not in said  # the query is of the field's own


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lampp", "--text", "{table}"], ("class:", "got 'lampp'", "'lamp'?", "--teacher", "--weights")),
        (["lamp", "--text", "{table}", "--weights", "a.pt"], ("--weights:", "--teacher", "got a.pt")),
        (["lamp", "--teacher", "cases_text:MUTE"], ("teacher 'mute':", "text encoder")),
        (["lamp"], ("--text:", "got none", "`kfgs features FIELD --examples clicks.json")),
        (["palm", "--text", "{other}", *LETTERS], ("--text:", "[C, 16]", "teacher")),
        (["lamp", "--text", "{other}"], ("--text:", "[C, 16]", "got ({count}, 5)")),
        (["lamp", "--text", "{shown}"], ("--text:", "[C, 16]", "another teacher", "`kfgs features FIELD --examples")),
        (["lamp", "--text", "{tmp}/no.safetensors"], ("no.safetensors:", "no such file")),
    ],
)
def test_wrong_queries_are_named(field, names, tmp_path, capsys, arguments, message):
    made = make_label_set(TEACHER, names)
    paths = {name: tmp_path / f"{name}.safetensors" for name in ("table", "bare", "other", "shown")}
    made.save(paths["table"])
    make_label_set(TEACHER, names, negatives=None).save(paths["bare"])
    type(made)(made.names, torch.eye(len(names), 5) + 1).save(paths["other"])
    type(made)(made.names, torch.eye(len(names), 5) + 1, info={"examples": {"lamp": 1}}).save(paths["shown"])
    given = [argument.format(tmp=tmp_path, **paths) for argument in arguments]
    assert main(["select", given[0], str(field), *given[1:]]) == 1
    error = capsys.readouterr().err
    assert re.search(tells(*(part.replace("{count}", str(len(names))) for part in message)), error)
    assert error.count("\n") == 1


def test_examples_are_drawn_in_the_photographs_of_the_field(desk, tmp_path, capsys):
    shutil.copytree(desk / "run", tmp_path / "run")
    (tmp_path / "scene").symlink_to(desk / "scene")
    clicks, out = tmp_path / "clicks.json", tmp_path / "shown.safetensors"
    view = SemanticField.load(tmp_path / "run").cameras[0].name
    clicks.write_text(json.dumps({"chair": [{"view": view, "points": [[20, 30]]}], "wall": [{"gaussians": [3]}]}))
    words = ["features", str(tmp_path / "run/field.kfgs"), "--examples", str(clicks), "--out", str(out)]
    assert main(words) == 0
    picture = tmp_path / "shown.safetensors.png"
    assert f"wrote:\n  {out}\n  {picture}\n" in capsys.readouterr().out
    with Image.open(picture) as opened:
        assert opened.size[0] > 480
    picture.unlink()
    (tmp_path / "scene").unlink()
    assert main(words) == 0  # without photographs there is no picture
    assert not picture.exists()
