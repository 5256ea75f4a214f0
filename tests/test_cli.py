import json
import shutil

import numpy as np
from PIL import Image

import kfgs
from kfgs.cli import main
from kfgs.formats.ply import read_header, read_ply, write_ply


def test_attach_carries_classes_to_points_and_keeps_their_columns(desk, room, tmp_path):
    surface = np.load(room / "surface.npz")["points"].astype(np.float32)
    cloud = {name: np.ascontiguousarray(surface[:, i]) for i, name in enumerate("xyz")}
    red = np.full(len(surface), 200, np.uint8)
    columns = cloud | {"mass": np.arange(len(surface), dtype=np.float32), "red": red, "green": red, "blue": red}
    write_ply(tmp_path / "cloud.ply", columns, comments=("SplatRenderMode: mip",))
    out = tmp_path / "labelled.ply"
    arguments = ["attach", str(desk / "run"), str(tmp_path / "cloud.ply"), "--scene", str(room)]
    assert main([*arguments, "--out", str(out)]) == 0
    columns = read_ply(out)
    np.testing.assert_array_equal(columns["mass"], np.arange(len(surface)))
    assert (columns["class_id"] >= 0).mean() > 0.8
    assert set(columns["red"].tolist()) == {200}
    assert "SplatRenderMode: mip" in read_header(out).comments
    names = json.loads((tmp_path / "labelled.ply.classes.json").read_text())
    assert names["class_id"]["1"] == "floor"
    assert names["distance"] > 0


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

    monkeypatch.setattr(kfgs, "run_sfm", placed)
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    assert main(["sfm", str(photos), "--out", str(scene)]) == 0
    assert (scene / "images").is_symlink()
    assert f"{scene / 'images'} is a link to {photos}: keep the photos there\n" in capsys.readouterr().out
