"""`kfgs view` without a display: its picture, and what it says of wrong input before anything is drawn."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_color import surface
from cases_text import TEACHER
from PIL import Image
from small_room import make_room

from kfgs.cli import main
from kfgs.fields import Identity, SemanticField
from kfgs.formats import write_splats
from kfgs.scenes import load_scene
from kfgs.splat.sh import rgb_to_sh0
from kfgs.teachers.prompts import make_label_set
from kfgs.viz import palette, plotter
from kfgs.viz.plotter import trouble

LETTERS = ["--teacher", "cases_text:TEACHER"]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("view") / "scene")


@pytest.fixture(scope="module")
def files(room, tmp_path_factory):
    """A field (the room's surface with its classes' text), the same as a labelled splat, and a colour splat."""
    cloud, truth = surface(room)
    names, folder = json.loads((room / "classes.json").read_text()), tmp_path_factory.mktemp("files")
    scene = load_scene(room)
    table = make_label_set(TEACHER, names)
    table.save(folder / "text.safetensors")
    info = {"views": [scene.cameras[i].name for i in scene.views("train")], "teacher": TEACHER.identity}
    SemanticField(cloud.replace(features=table.embeddings[truth]), Identity(table.dim), info=info).save(
        folder / "field.kfgs"
    )
    write_splats(cloud.replace(labels=truth, names=tuple(names)), folder / "labelled.ply")
    colored = cloud.replace(sh=rgb_to_sh0(torch.full((len(cloud), 3), 0.5))[:, None], labels=None)
    write_splats(colored, folder / "color.ply")
    return folder


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def drawn(arguments, capsys):
    if trouble():
        pytest.skip("no OpenGL here")
    code = main(["view", *map(str, arguments)])
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    return said.out


def count(folder, truth, name):
    return int((truth == json.loads((folder / "classes.json").read_text()).index(name)).sum())


def test_a_question_lights_up_on_both_sides(room, files, tmp_path, capsys):
    truth = surface(room)[1]
    names = json.loads((room / "classes.json").read_text())
    name = names[int(truth.mode().values)]
    words = ["--text", files / "text.safetensors", "--color", files / "color.ply"]
    said = drawn([files / "field.kfgs", *words, "--ask", name, "--where", "picture", "--out", tmp_path / "out"], capsys)
    n, total = count(room, truth, name), len(truth)
    assert f"semantic: {n} of {total} Gaussians" in said.replace(",", "")
    assert f"colour: {n} of {total} Gaussians" in said.replace(",", "")  # every colour Gaussian lies on its source
    picture = np.asarray(Image.open(tmp_path / "out" / "view.png").convert("RGB")).astype(int)
    color = palette(truth.mode().values[None], names)[0].astype(int)
    near = np.abs(picture - color).max(axis=2) < 12
    half = picture.shape[1] // 2
    assert near[:, :half].sum() > 200
    assert near[:, half:].sum() > 200


def test_a_file_to_share_needs_no_driver(room, files, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plotter, "trouble", lambda: "the trial picture crashed")
    words = ["--scene", room, "--text", files / "text.safetensors", *LETTERS]
    arguments = [
        files / "field.kfgs",
        *words,
        "--color",
        files / "color.ply",
        "--ask",
        "zebra crossing",
        "--where",
        "html",
    ]
    assert main(["view", *map(str, arguments), "--out", str(tmp_path / "out")]) == 0
    assert "view.html" in capsys.readouterr().out
    page = (tmp_path / "out" / "view.html").read_text()
    header = json.loads(page.split('id="header">')[1].split("</script>")[0])
    assert list(header["query"]) == [*json.loads((room / "classes.json").read_text()), "zebra crossing"]
    assert header["start"]["words"] == "zebra crossing"
    assert header["title"] == files.name  # of files/field: all fields have this name
    assert header["cameras"][0]["thumbnail"] == "thumbnails/0"


def test_a_run_folder_brings_its_colours_and_the_photos_of_its_scene(room, files, tmp_path, capsys):
    scene = load_scene(room)
    made = SemanticField.load(files / "field.kfgs")
    train = tuple(scene.cameras[i] for i in scene.views("train"))
    replace(made, info=made.info | {"scene": str(room)}, cameras=train).save(tmp_path / "run" / "field.kfgs")
    shutil.copy(files / "color.ply", tmp_path / "run" / "color.ply")
    words = ["--text", files / "text.safetensors"]
    assert main(["view", *map(str, [tmp_path / "run", *words, "--where", "html", "--out", tmp_path / "out"])]) == 0
    assert f"colours: {tmp_path / 'run' / 'color.ply'}" in capsys.readouterr().out
    header = json.loads((tmp_path / "out" / "view.html").read_text().split('id="header">')[1].split("</script>")[0])
    assert list(header["sides"]) == ["semantic", "color"]
    assert [camera["thumbnail"] for camera in header["cameras"]] == [f"thumbnails/{i}" for i in range(len(train))]
    assert header["title"] == "run"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FIELD", "--where", "window"], "--where: expected a display for a window, got none"),
        (["FIELD", "--where", "picture"], "--text: expected a table of words"),
        (["FIELD", "--text", "TABLE", "--where", "picture", "--weights", "x"], "--weights: expected --teacher with it"),
        (["FIELD", "--text", "TABLE", "--where", "picture", "--ask", "wal"], "wal"),
        (["COLOR", "--where", "picture"], "SOURCE: expected a splat with classes"),
        (["nowhere", "--where", "picture"], "SOURCE: expected a field (RUN/field.kfgs"),
        (["FIELD", "--text", "TABLE", "--color", "FIELD", "--where", "picture"], "--color: expected a splat file"),
    ],
)  # fmt: skip
def test_wrong_input_is_told(files, tmp_path, capsys, arguments, message):
    where = {"FIELD": "field.kfgs", "SPLAT": "labelled.ply", "COLOR": "color.ply", "TABLE": "text.safetensors"}
    given = [str(files / where[word]) if word in where else word for word in arguments]
    assert main(["view", *given, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
