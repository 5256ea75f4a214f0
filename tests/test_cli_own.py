"""Commands replace what the user names and what they wrote themselves, nothing else, and follow no link in an output."""

import os

import pytest
import torch
from small_room import fit_run, make_room

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("own") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


@pytest.fixture
def splat(tmp_path):
    count = 300
    cloud = Gaussians(
        torch.rand(count, 3),
        torch.nn.functional.normalize(torch.rand(count, 4)),
        torch.full((count, 3), 0.1),
        torch.full((count,), 0.5),
        sh=torch.rand(count, 1, 3),
        labels=torch.arange(count) % 2,
    )
    write_splats(cloud, tmp_path / "a.ply")
    (tmp_path / "a.ply.classes.json").write_text('{"class_id": {"0": "chair", "1": "table"}}')
    return tmp_path / "a.ply"


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(words, capsys, *parts):
    assert main([str(word) for word in words]) == 1
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines() if line.startswith("error: ")]
    for part in parts:
        assert str(part) in line


def words_of(text, **places):
    return [word.format(**places) for word in text.split()]


def test_each_output_of_edit_has_its_own_edits(splat, tmp_path):
    scene = tmp_path / "e.edits.json"
    scene.write_text("mine")
    for suffix, name in ((".ply", "chair"), (".spz", "table")):
        assert main(["edit", str(splat), "--out", str(tmp_path / f"e{suffix}"), "--remove", name]) == 0
    assert scene.read_text() == "mine"
    for suffix, kept in ((".ply", 1), (".spz", 0)):
        edits = EditList.load(tmp_path / f"e{suffix}.edits.json")
        assert len(edits) == 1
        assert set(edits.apply(read_splats(splat)).labels.tolist()) == {kept}


@pytest.mark.parametrize(
    "text",
    [
        "fit {room} --out |",
        "color {room} --out=|",
        "attach {run}/field.kfgs {splat} --out |",
        "convert {splat} |",
        "convert |",
        "fit | --out {out}",
    ],
)
def test_an_empty_path_is_not_the_current_folder(text, room, run, splat, tmp_path, capsys, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(SemanticField, "load", None)
    words = [word.replace("|", "") for word in words_of(text, room=room, run=run, splat=splat, out=tmp_path / "out")]
    refused(words, capsys, "empty", "write . for this folder")
    assert os.listdir() == []


def test_an_empty_class_is_no_path(run, capsys):
    refused(["select", "", run / "field.kfgs"], capsys, "expected a name", "empty text")
