"""Label pictures find their views, whatever the views were made of."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import write_model, write_picture
from messages import refused, tells
from PIL import Image

from kfgs.evaluation import label_views
from kfgs.evaluation.views import match_views, sized_view
from kfgs.pipeline import true_labels
from kfgs.scenes import Scene, load_scene


def _scene(folder: Path, names: list[str]) -> Scene:
    write_model(folder / "sparse/0", names)
    for name in names:
        write_picture(folder / "images" / name)
    return load_scene(folder)


def _save(path: Path, value: int, size: tuple[int, int] = (48, 64)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full(size, value, np.uint8)).save(path, "PNG")


def test_cameras_get_the_size_of_the_truth(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["a.png"])
    assert sized_view(scene, 0, (24, 32)).camera.size == (24, 32)
    refused(lambda: sized_view(scene, 0, (32, 24)), "'a'", "64x48", "24x32", "turned")
    _save(tmp_path / "labels/a.png", 1, (24, 32))
    (tmp_path / "classes.json").write_text('["x", "y"]')
    truth, views = label_views(scene, tmp_path)
    assert (truth.names, [view.camera.size for view in views]) == (("x", "y"), [(24, 32)])
    assert truth.maps["a"].unique().tolist() == [1]


def test_labels_of_one_folder_are_not_those_of_another(tmp_path: Path) -> None:
    """A rig has a picture `a` in each folder: flat labels could be of both."""
    scene = _scene(tmp_path, ["left/a.png", "right/a.png", "left/b.png"])
    _save(tmp_path / "a.png", 0)
    _save(tmp_path / "b.png", 1)
    assert [*true_labels(scene, tmp_path, "all")] == ["left/b"]
    assert match_views(scene, ["b"], None) == {"b": 1}
    refused(lambda: match_views(scene, ["right/b"], None), "right/b", "not in it")


def test_truth_of_another_scene(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["frame_1.png", "b.png"])
    with pytest.raises(
        ValueError, match=tells("2 views", "frame_00001 too (1 of 1", "did you mean 'frame_1.png'?", "one data set")
    ):
        match_views(scene, ["frame_00001"], None)
    scene = dataclasses.replace(scene, splits={"test": [0]})
    assert match_views(scene, ["b", "frame_00001"], None, "test") == {"b": 0}
    refused(lambda: match_views(scene, ["frame_1"], "test"), "split", "got 'test'", "1 pictures with truth")


def test_names_that_are_spelled_otherwise(tmp_path: Path) -> None:
    scene = _scene(tmp_path, ["A.JPG", "K\u00fcche.png", "left/b.png"])
    for name, value in {"a.png": 0, "Ku\u0308che.PNG": 1, "left/b.png.png": 2}.items():
        _save(tmp_path / "labels" / name, value)
    (tmp_path / "labels/classes.json").write_text('["x", "y", "z"]', encoding="utf-8-sig")
    labels = true_labels(scene, tmp_path / "labels", "all")
    expected = {"A": 0, "K\u00fcche": 1, "left/b": 2}
    assert {stem: int(each[0, 0]) for stem, each in labels.items()} == expected
    truth, views = label_views(scene, tmp_path, split="all")
    assert {stem: int(truth.maps[stem][0, 0]) for stem in truth.maps} == expected
    assert {view.stem for view in views} == set(expected)


def test_labels_lose_the_lens_of_their_picture(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse/0", ["a.png"], model="SIMPLE_RADIAL", params=[50, 31, 25, 0.1])
    write_picture(tmp_path / "images/a.png")
    _save(tmp_path / "labels/a.png", 1)
    (tmp_path / "classes.json").write_text('["x", "y"]')
    scene = load_scene(tmp_path).undistorted()
    truth, views = label_views(scene, tmp_path)
    recorded = scene.mask(0)
    assert views[0].camera.size == scene.cameras[0].size
    assert truth.maps["a"][recorded].float().mean() > 0.99
    assert torch.equal(truth.maps["a"] == -1, ~recorded) or float((truth.maps["a"] == -1).float().mean()) > 0
