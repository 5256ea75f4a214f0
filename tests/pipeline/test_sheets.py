import numpy as np
import torch
from PIL import Image
from small_room import make_room

from kfgs.evaluation import load_label_map
from kfgs.labels import LabelSet
from kfgs.pipeline.apply import save_colored_labels
from kfgs.pipeline.sheets import WIDTH, segmentation_sheet, teacher_labels
from kfgs.scenes import load_scene, save_feature_map
from kfgs.viz import palette

NAMES = ["wall", "chair", "rug"]


def halves():
    labels = torch.zeros(60, 80, dtype=torch.int64)
    labels[:, 40:] = 1
    return torch.full((60, 80, 3), 0.5), labels


def test_a_sheet_has_the_panels_that_there_are():
    photo, labels = halves()
    teacher, truth = labels[::10, ::10], labels.clone()
    truth[:15] = -1
    truth[15:30] = 2  # a third of what is known
    features = np.zeros((60, 80, 3), np.uint8)
    alone = segmentation_sheet(photo, labels, NAMES)
    full = segmentation_sheet(photo, labels, NAMES, truth=truth, teacher=teacher, features=features)
    assert segmentation_sheet(photo, labels, NAMES, teacher=teacher).shape[1] == alone.shape[1]  # an empty place
    four = segmentation_sheet(photo, labels, NAMES, truth=truth, features=features)
    assert alone.shape[1] == four.shape[1] < full.shape[1]  # two, two and three in a row
    assert abs(full.shape[1] - 3 * WIDTH) < 30
    assert alone.shape[0] < four.shape[0]
    assert (full == 0).all(-1).sum() > 0.9 * WIDTH * WIDTH * 3 / 4  # the features fill the row
    assert (four == 0).all(-1).sum() < 0.1 * WIDTH * WIDTH * 3 / 4
    vermilion = (full[..., 0].astype(int) - full[..., 2] > 120) & (full[..., 1] > 60) & (full[..., 1] < 140)
    assert abs(vermilion.sum() / (WIDTH * WIDTH * 3 / 4) - 0.25) < 0.05


def test_label_maps_in_colour_keep_the_numbers(tmp_path):
    _, labels = halves()
    labels[0] = -1
    path = tmp_path / "a.png"
    save_colored_labels(path, labels, NAMES)
    picture = Image.open(path)
    assert picture.mode == "P"
    assert torch.equal(load_label_map(path), labels)
    np.testing.assert_array_equal(np.asarray(picture.convert("RGB")), palette(labels, NAMES))


def test_a_teacher_speaks_where_it_has_a_map(tmp_path):
    scene = load_scene(make_room(tmp_path / "scene"))
    view = scene.views("test")[0]
    map_ = torch.zeros(6, 8, 3)
    map_[..., 0], map_[:, 4:, 1] = 1, 2
    save_feature_map(tmp_path / "maps", scene.stem(view), map_)
    classes = LabelSet(("wall", "chair"), torch.eye(3)[:2])
    found = teacher_labels(scene, view, tmp_path / "maps", classes)
    assert found.tolist() == [[0] * 4 + [1] * 4] * 6
    assert teacher_labels(scene, scene.views("test")[1], tmp_path / "maps", classes) is None
    assert teacher_labels(scene, view, tmp_path / "maps", LabelSet(("wall",), torch.ones(1, 5))) is None
