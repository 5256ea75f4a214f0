"""`kfgs render`: films of a run, of a field and of a labelled splat."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image, ImageSequence

from kfgs.cli import main
from kfgs.scenes import load_scene


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
