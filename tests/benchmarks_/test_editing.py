"""The protocols judged by edits whose outcome is known: by true labels, by wrong labels, by halves, by nothing."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch
from editing import ClassTruth, score_recolor, score_removal
from messages import tells
from oracles_editing import paint_room
from PIL import Image

from kfgs.evaluation import find_points
from kfgs.labels.color import recolor
from kfgs.metrics import psnr
from kfgs.scenes import load_scene
from kfgs.splat import rasterize
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


def test_removing_nothing_leaves_everything(room, cloud):
    report = score_removal(cloud, cloud, room, "chair")
    assert (report.gone_pixels, report.changed_pixels, report.gone_points) == (0, 0, 0)
    assert (report.untouched_pixels, report.untouched_off_border, report.kept_points) == (1, 1, 1)
    assert not report.passed


def test_removing_everything_leaves_nothing(room, cloud):
    nothing = cloud.select(torch.zeros(len(cloud), dtype=torch.bool))
    report = score_removal(cloud, nothing, room, "chair")
    assert (report.gone_pixels, report.gone_points, report.kept_points) == (1, 1, 0)
    assert report.untouched_pixels < 0.2
    assert not report.passed


def test_removing_a_wrong_class_fails(room, cloud, mask):
    report = score_removal(cloud, cloud.select(~mask["table"]), room, "chair")
    assert report.gone_pixels < 0.05
    assert report.gone_points < 0.05
    assert report.untouched_pixels < 0.95
    assert report.kept_points < 0.99
    assert not report.passed


def test_removing_half_scores_half(room, cloud, mask):
    """By place: the rug's half with x > 0.05, its centre. A pixel or a point is either gone or it is not."""
    half = mask["rug"] & (cloud.means[:, 0] > 0.05)
    report = score_removal(cloud, cloud.select(~half), room, "rug")
    surface = find_points(room)
    rug = next(i for i, name in surface.names.items() if name == "rug")
    share = float((surface.points[surface.labels == rug][:, 0] > 0.05).double().mean())
    assert abs(report.gone_points - share) < 0.03
    assert 0.1 < report.gone_pixels < 0.9
    assert not report.passed


def test_a_class_that_looks_as_before_is_not_removed(room, cloud, mask):
    report = score_removal(cloud, cloud.select(~mask["rug"]), room, "rug")
    perfect = {"gone_pixels": 1.0, "gone_points": 1.0, "untouched_pixels": 1.0, "kept_points": 1.0}
    assert dataclasses.replace(report, **perfect).passed
    assert not dataclasses.replace(report, **perfect, changed_pixels=0.5).passed
    assert not dataclasses.replace(report, **perfect, changed_pixels=math.nan).passed


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_fields_on_a_gpu_score_the_same(room, cloud, mask):
    after = cloud.select(~mask["chair"])
    here, there = (score_removal(cloud.to(d), after.to(d), room, "chair").to_json() for d in ("cpu", "cuda"))
    assert there == pytest.approx(here, abs=0.01)
    after = recolor(cloud, mask["chair"], BLUE)
    here, there = (score_recolor(cloud.to(d), after.to(d), room, "chair", BLUE) for d in ("cpu", "cuda"))
    assert there.hue_inside == pytest.approx(here.hue_inside, abs=0.01)
    assert there.psnr_outside == pytest.approx(here.psnr_outside, abs=0.5)


def test_an_object_that_was_not_there_is_no_success(room, cloud, mask):
    without = cloud.select(~mask["chair"])
    report = score_removal(without, without, room, "chair")
    assert report.measured_pixels < 0.05
    assert not report.passed


def test_a_report_is_plain_json(room, cloud, mask):
    report = score_removal(cloud, cloud.select(~mask["rug"]), room, "rug")
    plain = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert plain["protocol"].startswith("kfgs-removal/1: ")
    assert plain["name"] == "rug"
    assert plain["gone_pixels"] == report.gone_pixels
    assert plain["passed"] is report.passed
    assert f"{report.gone_pixels:.4f} of its pixels gone" in str(report)
    assert "kfgs-removal/1, 2 views" in str(report)
    void = dataclasses.replace(report, gone_points=math.nan)
    assert void.to_json()["gone_points"] is None
    assert not void.passed


@pytest.mark.parametrize("name", ["chair", "rug"])
def test_recolouring_by_true_labels_stays_inside(room, cloud, mask, name):
    report = score_recolor(cloud, recolor(cloud, mask[name], BLUE), room, name, BLUE)
    assert report.hue_inside > 0.9
    assert report.hue_before < 0.1
    assert report.measured_pixels > 0.9
    assert report.rgb == BLUE
    assert report.psnr_off_border > 35


def test_recolouring_nothing_changes_nothing(room, cloud):
    report = score_recolor(cloud, cloud, room, "chair", BLUE)
    assert report.psnr_outside == math.inf
    assert report.psnr_off_border == math.inf
    assert report.hue_inside == report.hue_before < 0.1
    assert not report.passed
    assert report.to_json()["psnr_outside"] is None


def test_recolouring_a_wrong_class_fails(room, cloud, mask):
    report = score_recolor(cloud, recolor(cloud, mask["wall"], BLUE), room, "chair", BLUE)
    assert report.psnr_outside < 20
    assert not report.passed


def test_the_psnr_is_over_all_pixels_outside(room, cloud, mask):
    after = recolor(cloud, mask["rug"], BLUE)
    scene = load_scene(room)
    old, new = [], []
    for i in scene.views("test"):
        outside = np.array(Image.open(room / "labels" / f"{scene.stem(i)}.png")) != 3  # rug
        old.append(rasterize(cloud, scene.cameras[i]).map.clamp(0, 1)[torch.from_numpy(outside)])
        new.append(rasterize(after, scene.cameras[i]).map.clamp(0, 1)[torch.from_numpy(outside)])
    expected = float(psnr(torch.cat(new)[None], torch.cat(old)[None]))
    report = score_recolor(cloud, after, room, "rug", BLUE)
    assert report.psnr_outside == pytest.approx(expected, abs=1e-3)
    assert report.psnr_off_border > report.psnr_outside  # soft edges are where the error is


def test_the_border_is_two_pixels_wide(room):
    for _, inside, far in ClassTruth(room, "chair", "test").views():
        for row in range(40, 100, 7):
            for column in range(10, 150, 7):
                around = inside[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
                assert far[row, column] == (not around.any())


def test_what_cannot_be_scored_is_named(room, cloud, tmp_path):
    with pytest.raises(ValueError, match=tells("name:", "wall, floor", "got 'dragon'")):
        score_removal(cloud, cloud, room, "dragon")
    with pytest.raises(ValueError, match=tells("split:", "got 'holdout'")):
        score_removal(cloud, cloud, room, "chair", split="holdout")
    with pytest.raises(ValueError, match=tells("before, after:", "sh ", "got None")):
        score_removal(cloud, cloud.replace(sh=None), room, "chair")
    with pytest.raises(ValueError, match=tells("rgb:", "[0, 1]", "got (255, 0, 0)")):
        score_recolor(cloud, cloud, room, "chair", (255, 0, 0))
    with pytest.raises(ValueError, match=tells("rgb:", "hue", "(0.5, 0.5, 0.5)")):
        score_recolor(cloud, cloud, room, "chair", (0.5, 0.5, 0.5))
    with pytest.raises(FileNotFoundError, match=tells("classes.json:", "no such file")):
        score_removal(cloud, cloud, tmp_path, "chair")


def test_a_scene_without_truth_is_named(room, cloud, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(room, copy, ignore=shutil.ignore_patterns("features", "depth"))
    surface = copy / "surface.npz"
    np.savez(surface, points=np.zeros((1, 3), np.float32))
    with pytest.raises(ValueError, match=tells("surface.npz:", "'points' and 'labels'")):
        score_removal(cloud, cloud, copy, "chair")
    surface.write_bytes(b"PK nonsense")
    with pytest.raises(ValueError, match=tells("surface.npz:", "arrays", "room")):
        score_removal(cloud, cloud, copy, "chair")
    surface.unlink()
    with pytest.raises(FileNotFoundError, match=tells("truth:", "labelled points", "surface.npz", "found none")):
        score_removal(cloud, cloud, copy, "chair")
    names = copy / "classes.json"
    names.write_text(json.dumps([*json.loads(names.read_text()), "ghost"]))
    with pytest.raises(ValueError, match=tells("name:", "got 'ghost'")):
        score_removal(cloud, cloud, copy, "ghost")
    scene = load_scene(copy)
    picture = copy / "labels" / f"{scene.stem(scene.views('test')[0])}.png"
    Image.fromarray(np.full((5, 6), 5, np.uint8)).save(picture)
    with pytest.raises(ValueError, match=tells("view_001.png:", "(120, 160)", "got (5, 6)")):
        score_recolor(cloud, cloud, copy, "chair", BLUE)
