"""`kfgs segment` for other programs: COCO's JSON with its pictures, and the label pictures of a camera path."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from kfgs.cli import main
from kfgs.evaluation.coco import load_coco_labels
from kfgs.fields import SemanticField
from kfgs.scenes import load_scene


def segment(desk, out, *words):
    return main(["segment", str(desk / "run" / "field.kfgs"), "--out", str(out), *map(str, words)])


def read(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def as_predicted(labels):
    return torch.where(labels < 0, 255, labels).numpy()


def test_coco_of_the_views_of_a_split_has_their_photographs(desk, tmp_path, capsys):
    assert segment(desk, tmp_path, "--coco") == 0
    assert segment(desk, tmp_path, "--coco") == 0  # its own files may be replaced
    assert str(tmp_path / "coco") in capsys.readouterr().out
    scene = load_scene(desk / "scene")
    truth = load_coco_labels(tmp_path / "coco" / "annotations.json")
    assert truth.names == SemanticField.load(desk / "run" / "field.kfgs").classes.names
    assert set(truth.maps) == {scene.stem(i) for i in scene.views("test")}
    for i in scene.views("test"):
        stem = scene.stem(i)
        assert np.array_equal(as_predicted(truth.maps[stem]), read(tmp_path / "predicted" / f"{stem}.png"))
        assert np.array_equal(read(tmp_path / "coco" / "images" / f"{stem}.png"), read(scene.image_paths[i])[..., :3])


@pytest.mark.parametrize("path", ["orbit", "cameras"])
def test_a_path_is_segmented_with_the_colours_that_it_sees(desk, tmp_path, path, capsys):
    words = ["--path", path, "--frames", 3, "--coco"]
    assert segment(desk, tmp_path, *words) == 0
    said = capsys.readouterr().out
    for name in ("predicted", "colored", "coco"):
        assert str(tmp_path / name) in said
    written = json.loads((tmp_path / "coco" / "annotations.json").read_text())
    assert len(written["images"]) == 3
    truth = load_coco_labels(tmp_path / "coco" / "annotations.json")
    for one in written["images"]:
        seen = read(tmp_path / "predicted" / one["file_name"])
        assert seen.shape == (one["height"], one["width"])
        assert seen.shape[1] == 480
        assert np.array_equal(as_predicted(truth.maps[one["file_name"].removesuffix(".png")]), seen)
        assert len(np.unique(read(tmp_path / "coco" / "images" / one["file_name"]).reshape(-1, 3), axis=0)) > 50
    assert len(np.unique(read(tmp_path / "predicted" / "{}".format(written["images"][0]["file_name"])))) > 2


def own_cameras(folder, cameras, name="{}"):
    """A transforms.json without pictures, as another program writes one."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    frames = []
    for i, camera in enumerate(cameras):
        fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        pose = (torch.linalg.inv(camera.viewmat) @ flip).tolist()
        lens = {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        frames.append({"file_path": name.format(i), "transform_matrix": pose, **lens})
    folder.mkdir()
    (folder / "path.json").write_text(json.dumps({"frames": frames}))
    return folder / "path.json"


def test_exactly_the_cameras_of_a_file_are_segmented(desk, tmp_path, capsys):
    field = SemanticField.load(desk / "run" / "field.kfgs")
    cameras = [camera.resized(30 + i, 40) for i, camera in enumerate(field.cameras[:3])]
    file = own_cameras(tmp_path / "in", cameras, "views/v_{}.jpg")
    assert segment(desk, tmp_path / "out", "--path", file, "--coco") == 0
    capsys.readouterr()
    for i, camera in enumerate(cameras):
        expected = as_predicted(field.segment(camera, field.classes))
        found = read(tmp_path / "out" / "predicted" / "views" / f"v_{i}.png")
        assert found.shape == camera.size
        assert (found != expected).mean() < 2e-3  # the inverse of a pose is rounded: a pixel or two at an edge
        assert read(tmp_path / "out" / "coco" / "images" / "views" / f"v_{i}.png").shape[:2] == camera.size


def test_a_path_through_the_cameras_of_a_scene_without_pictures(desk, tmp_path):
    (tmp_path / "scene").mkdir()
    shutil.copytree(desk / "scene" / "sparse", tmp_path / "scene" / "sparse")
    assert segment(desk, tmp_path / "out", "--path", tmp_path / "scene", "--frames", 4) == 0
    assert sorted(one.name for one in (tmp_path / "out/predicted").iterdir()) == [f"path_{i:04d}.png" for i in range(4)]
    assert read(tmp_path / "out" / "predicted" / "path_0000.png").shape == (60, 80)
