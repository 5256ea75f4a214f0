import json
import re
import shutil

import numpy as np
import pytest
from messages import tells
from PIL import Image
from small_room import fit_run, make_room

from kfgs import scenes
from kfgs.cli import main
from kfgs.formats.ply import read_header, read_ply, write_ply


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("cli") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


def test_attach_carries_classes_to_points_and_keeps_their_columns(run, room, tmp_path, capsys):
    surface = np.load(room / "surface.npz")["points"].astype(np.float32)
    cloud = {name: np.ascontiguousarray(surface[:, i]) for i, name in enumerate("xyz")}
    red = np.full(len(surface), 200, np.uint8)
    columns = cloud | {"mass": np.arange(len(surface), dtype=np.float32), "red": red, "green": red, "blue": red}
    write_ply(tmp_path / "cloud.ply", columns, comments=("SplatRenderMode: mip",))
    out = tmp_path / "labelled.ply"
    arguments = ["attach", str(run / "field.kfgs"), str(tmp_path / "cloud.ply"), "--scene", str(room)]
    assert main([*arguments, "--out", str(out)]) == 0
    columns = read_ply(out)
    np.testing.assert_array_equal(columns["mass"], np.arange(len(surface)))
    assert (columns["class_id"] >= 0).mean() > 0.8
    assert set(columns["red"].tolist()) == {200}
    assert "SplatRenderMode: mip" in read_header(out).comments
    names = json.loads((tmp_path / "labelled.ply.classes.json").read_text())
    assert names["class_id"]["1"] == "floor"
    assert names["distance"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["convert", "{tmp}/nothing"], ("{tmp}/nothing:", "no such file or folder")),
        (
            ["segment", "{tmp}", "--scene", "{room}", "--out", "{tmp}/o"],
            ("FIELD:", "field.kfgs", "got {tmp}", "`kfgs fit`"),
        ),
        (
            ["fit", "{room}", "--features", "{tmp}/nothing", "--out", "{tmp}/o"],
            ("--features:", "got {tmp}/nothing", "`kfgs features`"),
        ),
        (["fit", "{room}", "--features", "{tmp}", "--out", "{tmp}/o"], ("{tmp}", "expected at least one view")),
        (["fit", "{tmp}", "--features", "{room}/features", "--out", "{tmp}/o"], ("{tmp}:", "COLMAP", "`kfgs sfm")),
        (
            ["fit", "{room}", "--features", "{room}/features", "--out", "{tmp}/o", "--split", "val"],
            ("--split:", "train, test", "got 'val'"),
        ),
        (
            ["fit", "{room}", "--out", "{tmp}/o", "--method", "paper", "--splat", "a.ply"],
            ("--splat:", "--method paper", "got a.ply"),
        ),
        (
            ["attach", "{run}/field.kfgs", "{room}/no.ply", "--scene", "{room}", "--out", "{tmp}/o/a.ply"],
            ("{room}/no.ply:", "no such file"),
        ),
        (["sfm", "{tmp}", "--out", "{tmp}/o"], ("{tmp}:", "3 images", "got 0")),
    ],
)
def test_bad_input_ends_with_1_one_message_and_no_files(arguments, message, run, room, tmp_path, capsys):
    fill = {"tmp": str(tmp_path), "room": str(room), "run": str(run)}
    assert main([a.format(**fill) for a in arguments]) == 1
    captured = capsys.readouterr()
    assert re.search(tells(*(part.format(**fill) for part in message)), captured.err)
    assert captured.err.startswith("error: ")
    assert "Traceback" not in captured.err
    assert not (tmp_path / "o").exists()


def test_wrong_usage_ends_with_2():
    for arguments in (["fly"], ["fit"], ["fit", "x", "--out", "y", "--features", "z", "--method", "gpu"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2


def test_a_scene_without_points_is_told_that_some_are_found(room, tmp_path, capsys):
    (tmp_path / "images").mkdir()
    frames = []
    for number, picture in enumerate(sorted((room / "images").iterdir())[:2]):
        shutil.copy(picture, tmp_path / "images")
        pose = np.eye(4)
        pose[0, 3] = number
        frames.append({"file_path": f"images/{picture.name}", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    with Image.open(picture) as opened:
        lens |= {"w": opened.width, "h": opened.height}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    assert main(["fit", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    said = capsys.readouterr()
    assert "triangulate some from the poses before they train" in said.out
    assert said.err.startswith("error: --features: expected a folder of feature maps")


def test_sfm_says_that_the_images_of_the_scene_are_a_link(tmp_path, monkeypatch, capsys):
    def placed(images, out, **_):
        (out / "sparse" / "0").mkdir(parents=True)
        return "2 of 2 images registered"

    monkeypatch.setattr(scenes, "run_sfm", placed)
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    assert main(["sfm", str(photos), "--out", str(scene)]) == 0
    assert (scene / "images").is_symlink()
    assert f"{scene / 'images'} is a link to {photos}: keep the photos there\n" in capsys.readouterr().out
