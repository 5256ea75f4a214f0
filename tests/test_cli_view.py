"""`kfgs view` without a display: its picture, and the page that it writes."""

import json

import numpy as np
import pytest
from cases_color import surface
from cases_text import save_letters
from PIL import Image

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.viz import palette, plotter
from kfgs.viz.plotter import trouble


def view(capsys, out, *words):
    assert main(["view", *map(str, words), "--out", str(out)]) == 0
    return capsys.readouterr().out


def header_of(page):
    return json.loads(page.read_text().split('id="header">')[1].split("</script>")[0])


def test_a_question_lights_up_on_both_sides(room, desk, tmp_path, capsys):
    if trouble():
        pytest.skip("no OpenGL here")
    truth, names = surface(room)[1], json.loads((room / "classes.json").read_text())
    most = truth.mode().values
    words = ["--scene", room, "--color", desk / "my.ply", "--ask", names[int(most)], "--where", "picture"]
    said = view(capsys, tmp_path, desk / "true", *words).replace(",", "")
    n = int((truth == most).sum())
    assert f"semantic: {n} of 4000 Gaussians" in said
    assert f"colour: {n} of 4000 Gaussians" in said  # every colour Gaussian lies on its source
    picture = np.asarray(Image.open(tmp_path / "view.png").convert("RGB")).astype(int)
    near = np.abs(picture - palette(most[None], names)[0].astype(int)).max(axis=2) < 12
    half = picture.shape[1] // 2
    assert near[:, :half].sum() > 200
    assert near[:, half:].sum() > 200


def test_a_file_to_share_needs_no_driver_and_has_the_answer_of_a_teacher(room, desk, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plotter, "trouble", lambda: "the trial picture crashed")
    field, table = save_letters(room, tmp_path / "letters")
    words = ["--scene", room, "--text", table, "--teacher", "cases_text:TEACHER", "--color", desk / "my.ply"]
    assert "view.html" in view(capsys, tmp_path, field, *words, "--ask", "zebra crossing", "--where", "html")
    header = header_of(tmp_path / "view.html")
    assert list(header["query"]) == [*json.loads((room / "classes.json").read_text()), "zebra crossing"]
    assert header["start"]["words"] == "zebra crossing"
    assert header["title"] == "letters"  # of letters/field.kfgs: all fields have this name
    assert header["cameras"][0]["thumbnail"] == "thumbnails/0"


def test_a_run_folder_brings_its_colours_and_the_photos_of_its_scene(desk, tmp_path, capsys):
    said = view(capsys, tmp_path, desk / "run", "--where", "html")
    assert f"colours: {desk / 'run' / 'color.ply'}" in said
    header = header_of(tmp_path / "view.html")
    assert list(header["sides"]) == ["semantic", "color"]
    cameras = SemanticField.load(desk / "run").cameras
    assert [camera["thumbnail"] for camera in header["cameras"]] == [f"thumbnails/{i}" for i in range(len(cameras))]
    assert header["title"] == "run"


def test_a_splat_without_classes_opens(desk, tmp_path, capsys):
    assert "semantic: 4,000 Gaussians" in view(capsys, tmp_path, desk / "my.ply", "--where", "html")
    header = header_of(tmp_path / "view.html")
    assert (header["classes"], header["query"], header["start"]["show"]) == ([], {}, "color")
    assert header["up"] == [0, -1, 0]
    view(capsys, tmp_path, desk / "my.ply", "--where", "html", "--up", "z-down")
    assert header_of(tmp_path / "view.html")["up"] == [0, 0, -1]
