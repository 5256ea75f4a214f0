"""The protocols judged by edits whose outcome is known: by true labels, by wrong labels, by halves, by nothing."""

import json
import math

import pytest
import torch
from editing import _edited, score_recolor, score_removal, score_uncovered
from oracles_editing import paint_room
from PIL import Image

from kfgs.evaluation.label_pictures import load_label_map
from kfgs.labels.color import recolor
from kfgs.scenes import load_scene
from kfgs.toy.room_folder import ToyConfig, make_toy_room

ROOM = ToyConfig(
    train_views=8, test_views=2, size=(120, 160), feature_size=(8, 8), feature_dim=16, surface_points=20_000, sparse_points=100
)  # fmt: skip
BLUE = (0.2, 0.3, 0.8)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_toy_room(tmp_path_factory.mktemp("editing") / "room", ROOM)


@pytest.fixture(scope="module")
def cloud(room):
    return paint_room(room, load_scene(room), voxel=0.035)


@pytest.fixture(scope="module")
def mask(room, cloud):
    names = json.loads((room / "classes.json").read_text())
    return {name: cloud.labels == i for i, name in enumerate(names)}


@pytest.mark.parametrize("name", ["chair", "rug", "picture"])  # free-standing, on the floor, flat on a wall
def test_removal_by_true_labels_is_near_one(room, cloud, mask, name):
    report = score_removal(cloud, cloud.select(~mask[name]), room, name)
    assert report.gone_pixels > 0.97
    assert report.gone_points > 0.97
    assert report.untouched_off_border > 0.97
    assert report.kept_points > 0.99
    assert report.changed_pixels > 0.97
    assert report.measured_pixels > 0.9
    assert report.views == 2


def test_uncovered_pixels_are_compared_with_the_room_without_the_class(room, cloud, tmp_path):
    scene, names = load_scene(room), json.loads((room / "classes.json").read_text())
    black = cloud.select([0]).replace(opacities=cloud.opacities[:1] * 0 + 1e-6)
    report = score_uncovered(cloud, black, room, "chair")
    (tmp_path / "without" / "images").mkdir(parents=True)
    squares, same = [], []
    for i in scene.views("test"):
        truth = _edited(room, scene.stem(i), scene.cameras[i], "chair", moved=False)
        picture = Image.fromarray((truth * 255).round().byte().numpy())
        picture.save(tmp_path / "without" / "images" / f"{scene.stem(i)}.png")
        chair = load_label_map(room / "labels" / f"{scene.stem(i)}.png") == names.index("chair")
        squares.append(truth[chair].square())
        same.append(((truth - scene.image(i)).abs() < 2 / 255).all(dim=-1)[~chair])
    assert report.psnr == pytest.approx(-10 * math.log10(float(torch.cat(squares).mean())), abs=1e-4)
    assert report.pixels == sum(map(len, squares)) > 1_000
    assert 0.8 < float(torch.cat(same).float().mean()) < 1  # all but the chairs' shadows
    assert report.untouched_pixels < 0.1
    for name in ("images", "labels", "sparse", "classes.json", "split.json"):  # a room of benchmarks/rooms.py
        (tmp_path / name).symlink_to(room / name)
    assert score_uncovered(cloud, black, tmp_path, "chair") == report
    (tmp_path / "without").rename(tmp_path / "moved").joinpath("labels").symlink_to(room / "labels")
    moved = score_uncovered(cloud, black, tmp_path, "chair", moved=True)
    assert (moved.psnr, moved.pixels) == (report.psnr, report.pixels)


def test_edits_of_nothing_and_of_a_wrong_class_do_not_pass(room, cloud, mask):
    report = score_removal(cloud, cloud, room, "chair")
    assert (report.gone_pixels, report.changed_pixels, report.gone_points) == (0, 0, 0)
    assert (report.untouched_pixels, report.untouched_off_border, report.kept_points) == (1, 1, 1)
    same = score_recolor(cloud, cloud, room, "chair", BLUE)
    assert same.psnr_outside == same.psnr_off_border == math.inf
    assert same.hue_inside == same.hue_before < 0.1
    assert same.to_json()["psnr_outside"] is None
    wrong = score_recolor(cloud, recolor(cloud, mask["wall"], BLUE), room, "chair", BLUE)
    assert [wrong.psnr_outside < 20, *(each.passed for each in (report, same, wrong))] == [True, False, False, False]


@pytest.mark.parametrize("name", ["chair", "rug"])
def test_recolouring_by_true_labels_stays_inside(room, cloud, mask, name):
    report = score_recolor(cloud, recolor(cloud, mask[name], BLUE), room, name, BLUE)
    assert report.hue_inside > 0.9
    assert report.hue_before < 0.1
    assert report.measured_pixels > 0.9
    assert report.rgb == BLUE
    assert report.psnr_off_border > 35
