"""Label pictures and sheets of views."""

import numpy as np
import pytest
import torch
from messages import refused
from PIL import Image

from kfgs import Gaussians
from kfgs.cameras import Camera
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.fields import Identity, SemanticField
from kfgs.labels import LabelSet
from kfgs.pipeline import segment_cameras, segment_scene
from kfgs.pipeline.segment import WIDTH, save_label_map
from kfgs.scenes import Scene
from kfgs.viz import palette

WORDS = LabelSet(("wall", "chair", "door"), torch.eye(3))


def parts(folder):
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=32, height=24, name="a.png")
    cloud = Gaussians(torch.eye(3), torch.ones(3, 4), torch.ones(3, 3), torch.full((3,), 0.5), features=torch.eye(3))
    (folder / "images").mkdir()
    Image.fromarray(np.full((24, 32, 3), 128, np.uint8)).save(folder / "images/a.png")
    none = torch.zeros(0, 3)
    scene = Scene([camera], [folder / "images/a.png"], none, none.byte(), {"test": [0]}, folder=folder)
    return SemanticField(cloud, Identity(3)), scene, WORDS


def test_views_get_label_pictures_and_a_sheet(tmp_path):
    field, scene, words = parts(tmp_path)
    truth = {"a": torch.full((24, 32), 2)}
    labels = segment_scene(field, scene, words, tmp_path / "out", truth=truth)["a"]
    assert torch.equal(labels, field.segment(scene.cameras[0], words))
    for folder in ("predicted", "colored"):
        assert torch.equal(load_label_map(tmp_path / "out" / folder / "a.png"), labels)
    with Image.open(tmp_path / "out" / "sheets" / "a.png") as sheet:
        assert abs(sheet.width - 4 * WIDTH) < 60  # photograph, truth, field, features
    assert torch.equal(segment_cameras(field, scene.cameras, words, tmp_path / "other")["a"], labels)
    assert not (tmp_path / "other" / "sheets").exists()


def test_true_labels_of_other_classes_are_refused_before_the_work(tmp_path):
    truth = {"a": torch.full((24, 32), 7)}
    refused(lambda: segment_scene(*parts(tmp_path), tmp_path / "out", truth=truth), "truth['a']", "got 7")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("names", [["a.png", "a.jpg"], [""], ["../a.png"], ["/a.png"]])
def test_names_that_cannot_be_those_of_pictures_are_refused(names, tmp_path):
    field, scene, words = parts(tmp_path)
    cameras = [Camera(scene.cameras[0].viewmat, scene.cameras[0].K, 32, 24, name=name) for name in names]
    refused(lambda: segment_cameras(field, cameras, words, tmp_path / "out"), "cameras:", "a name of its own")
    assert not (tmp_path / "out").exists()


def test_label_maps_in_colour_keep_the_numbers(tmp_path):
    labels = torch.zeros(60, 80, dtype=torch.int64)
    labels[:, 40:], labels[0] = 1, -1
    colors = np.zeros((256, 3), np.uint8)
    colors[[0, 1, 255]] = palette(np.array([0, 1, -1]), WORDS.names)
    save_label_map(tmp_path / "a.png", labels, colors)
    picture = Image.open(tmp_path / "a.png")
    assert picture.mode == "P"
    assert torch.equal(load_label_map(tmp_path / "a.png"), labels)
    np.testing.assert_array_equal(np.asarray(picture.convert("RGB")), palette(labels, WORDS.names))
