"""Commands replace what the user names and what they wrote themselves, nothing else, and follow no link in an output."""

import json
import os
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from small_room import fit_run, make_room

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import EditList
from kfgs.viz import save_picture


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("own") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def other(run, tmp_path_factory):
    """Another result, to compare with."""
    out = tmp_path_factory.mktemp("other") / "tiny.kfgs.safetensors"
    assert main(["pack", str(run / "field"), str(out), "--precision", "tiny"]) == 0
    return out


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
    write_splats(tmp_path / "a.ply", cloud)
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


OTHERS = {  # files of the user, whose names the commands would use
    "segment {run}/field --out {out}": ["scores.json", "confusion.png", "iou.png", "predicted/view_000.png"],
    "color {room} --out {out} --preset quick --steps 20": ["scores.json", "views/view_000.png"],
    "label {run}/field --out {out}": ["gaussians.ply", "gaussians.ply.classes.json"],
    "label {run}/field --cloud {splat} --out {out}": ["cloud.ply", "cloud.ply.classes.json"],
    "select chair {splat} --out {out}": ["selection.json", "selection.ply", "parts.png"],
    "compare {run}/field {other} --out {out}": ["compare.json", "compare.txt"],
    "compare {run}/field {other} --scene {room} --out {out}": ["view_000.png"],
    "fit {room} --out {out} --method paper --mode adc --steps 20": ["report.html", "preview.png", "field.png"],
    "demo --out {out}": ["scores.json", "gaussians.ply", "color.ply", "removed.png"],
    "view {run}/field --out {out} --where html": ["view.html"],
    "edit {splat} --remove chair --out {out}/a.ply": ["a.ply.edits.json"],
    "edit {splat} --remove chair --scene {room} --out {out}/a.ply": ["a.ply.png"],
}


def of_the_user(path, splat):
    """A whole file of the right kind, which another program wrote."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        Image.fromarray(np.zeros((5, 5, 3), np.uint8)).save(path)
    elif path.suffix == ".ply":
        path.write_bytes(splat.read_bytes())  # even one of kfgs: it is not what this command wrote
    else:
        path.write_text('{"mine": 1}\n')


@pytest.mark.parametrize(("text", "name"), [(text, name) for text, names in OTHERS.items() for name in names])
def test_a_file_that_the_command_did_not_write_is_not_replaced(
    text, name, room, run, other, splat, tmp_path, capsys, monkeypatch
):
    views = sorted(path.stem for path in (room / "images").iterdir())
    testing = json.loads((room / "split.json").read_text())["test"]
    assert set(testing) < set(views)
    out = tmp_path / "out"
    place = out / name.replace("view_000", testing[0])
    of_the_user(place, splat)
    before = files(tmp_path)
    if text.startswith("label"):
        monkeypatch.setattr(SemanticField, "load", None)  # the work
    refused(words_of(text, room=room, run=run, other=other, splat=splat, out=out), capsys, place, "move it away")
    lock = out / ".run.lock"
    assert {path: data for path, data in files(tmp_path).items() if path != lock} == before


AGAIN = [
    "segment {run}/field --out {out}",
    "label {run}/field --cloud {splat} --out {out}",
    "select chair {splat} --out {out}",
    "compare {run}/field {other} --scene {room} --out {out}",
    "edit {splat} --remove chair --scene {room} --out {out}/a.ply",
    "view {run}/field --out {out} --where html",
    "fit {room} --out {out} --method paper --mode adc --steps 20 --max-gaussians 500",
    "color {room} --out {out} --preset quick --steps 20 --max-gaussians 500",
]


@pytest.mark.parametrize("text", AGAIN)
def test_what_the_command_wrote_itself_is_replaced_and_no_link_in_it_is_followed(
    text, room, run, other, splat, tmp_path, capsys
):
    out = tmp_path / "out"
    words = words_of(text, room=room, run=run, other=other, splat=splat, out=out)
    assert main(words) == 0
    assert main(words) == 0
    folders = [path for path in out.rglob("*") if path.is_dir()]
    assert folders or not text.startswith(("segment", "color", "fit"))
    for number, folder in enumerate(folders):
        mine, aside = tmp_path / f"mine{number}", tmp_path / "aside"
        shutil.copytree(folder, mine)
        folder.rename(aside)
        for file in mine.rglob("*"):
            if file.is_file():
                file.write_text("mine")
        folder.symlink_to(mine)
        before = files(tmp_path)
        capsys.readouterr()
        refused(words, capsys, folder, "a link")
        assert files(tmp_path) == before
        folder.unlink()
        aside.rename(folder)


def test_colors_and_segments_of_one_folder_do_not_replace_each_others_scores(room, run, tmp_path, capsys):
    for name, other in (("color", "segment {run}/field"), ("segmentation", "color {room}")):
        out = tmp_path / name
        out.mkdir()
        (out / "scores.json").write_text(json.dumps({name: {"miou": 1}}))
        before = files(out)
        words = words_of(other, room=room, run=run)
        refused([*words, "--out", out], capsys, out / "scores.json")
        assert files(out) == before


def test_each_output_of_edit_has_its_own_edits(splat, tmp_path):
    scene = tmp_path / "e.edits.json"
    scene.write_text("mine")
    for suffix, name in ((".ply", "chair"), (".spz", "table")):
        assert main(["edit", str(splat), "--out", str(tmp_path / f"e{suffix}"), "--remove", name]) == 0
    assert scene.read_text() == "mine"
    for suffix, kept in ((".ply", 1), (".spz", 0)):
        edits = EditList.load(tmp_path / f"e{suffix}.edits.json")
        assert len(edits) == 1
        assert set(edits.apply(read_splats(splat)).gaussians.labels.tolist()) == {kept}


def test_a_comparison_puts_no_picture_over_one_of_the_scene(room, run, other, capsys):
    before = files(room)
    words = ["compare", run / "field", other, "--scene", room, "--out", room / "images"]
    refused(words, capsys, room / "images", "pictures and feature maps")
    assert files(room) == before


@pytest.mark.parametrize(
    "text",
    [
        "fit {room} --out |",
        "color {room} --out=|",
        "label {run}/field --out |",
        "convert {splat} |",
        "info |",
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
    refused(["select", "", run / "field"], capsys, "QUERY: expected a class", "such as chair")


@pytest.mark.parametrize("name", [".run.lock", ".kfgs-unfinished", "field"])
def test_a_strangers_run_folder_leads_nowhere(name, room, run, tmp_path, capsys):
    theirs, mine = tmp_path / "run", tmp_path / "mine"
    shutil.copytree(run, theirs)
    if name == ".run.lock":
        mine.write_text("mine")
    else:
        shutil.copytree(run / "field", mine)
    before = {mine: mine.read_bytes()} if mine.is_file() else files(mine)
    place = theirs / name
    shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    place.symlink_to("../mine")
    words = ["fit", room, "--out", theirs, "--method", "paper", "--mode", "adc", "--steps", "20"]
    refused(words, capsys, place, "a link")
    assert ({mine: mine.read_bytes()} if mine.is_file() else files(mine)) == before


def test_pictures_say_that_kfgs_drew_them(tmp_path):
    save_picture(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.info["Software"] == "kfgs"
