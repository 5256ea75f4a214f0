"""Pictures without a display: films of `kfgs render`, the picture of `kfgs view` and the page that it writes."""

import json
import shutil

import numpy as np
import pytest
from cases_color import surface
from cases_text import save_letters
from PIL import Image, ImageSequence

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.scenes import load_scene
from kfgs.viz import palette, plotter
from kfgs.viz.plotter import trouble


@pytest.fixture(scope="module")
def run(desk):
    return desk / "run"


def frames(path):
    with Image.open(path) as film:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]


def film(*arguments):
    return main(["render", *map(str, arguments), "--frames", "3"])


@pytest.mark.parametrize("path", ["orbit", "cameras"])
def test_each_path_makes_a_film(run, tmp_path, path, capsys):
    out = tmp_path / "a.gif"
    assert film(run, "--out", out, "--path", path) == 0
    said = capsys.readouterr().out
    assert f"colours: {run / 'color.ply'}" in said
    assert str(out) in said
    made = frames(out)
    assert len(made) == 3
    assert made[0].shape[1] > 2 * 480  # colours and classes
    assert all(len(np.unique(frame.reshape(-1, 3), axis=0)) > 50 for frame in made)
    assert (made[0] != made[1]).any()


def test_a_labelled_splat(desk, tmp_path):
    labelled, out = desk / "labelled.ply", tmp_path / "a.gif"
    assert film(labelled, "--out", out, "--show", "photo,labels,query=chair") == 0
    assert film(labelled, "--out", out, "--path", "cameras", "--scene", desk / "scene") == 0


def test_cameras_of_your_own_are_the_frames(run, tmp_path):
    model = tmp_path / "model"
    shutil.copytree(run.parent / "scene" / "sparse" / "0", model)  # no pictures here
    words = ["render", str(run), "--show", "photo", "--path", str(model), "--out"]
    assert main([*words, str(tmp_path / "a.gif")]) == 0
    scene, made = load_scene(run.parent / "scene"), frames(tmp_path / "a.gif")
    assert len(made) == len(scene)
    assert main([*words, str(tmp_path / "b.gif"), "--frames", "4", "--width", "40"]) == 0
    assert len(frames(tmp_path / "b.gif")) == 4
    assert frames(tmp_path / "b.gif")[0].shape[1] == made[0].shape[1] - (scene.cameras[0].width - 40)
    poses = [np.linalg.inv(camera.viewmat.numpy()) @ np.diag([1, -1, -1, 1]) for camera in scene.cameras[:2]]
    views = [{"transform_matrix": pose.tolist(), "h": h} for pose, h in zip(poses, (30, 60), strict=True)]
    listed = {"w": 40, "fl_x": 30, "frames": views}
    (tmp_path / "two.json").write_text(json.dumps(listed))
    assert main([*words[:-2], str(tmp_path / "two.json"), "--out", str(tmp_path / "c.gif")]) == 0
    assert len(frames(tmp_path / "c.gif")) == 2  # the second is seen whole in a picture of the first one's size


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
