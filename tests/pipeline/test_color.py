"""A colour field of a room of six small pictures, as a stage of a run folder."""

import dataclasses

import pytest
import torch
from cases_training import changed
from messages import tells
from safetensors.torch import load_file
from small_room import make_room, stages

from kfgs.cameras import Distortion, Similarity
from kfgs.evaluation.color import score_views
from kfgs.fields import Training
from kfgs.formats import read_splats
from kfgs.pipeline.color import ColorConfig, TrainingPictures, fit_color
from kfgs.scenes import load_scene

FIELD = changed(
    ColorConfig.quick().training.with_steps(120),
    every=10,
    maximum=3_000,
    report_every=20,
    checkpoint_every=25,
)
CONFIG = dataclasses.replace(ColorConfig.quick(), training=FIELD)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(make_room(tmp_path_factory.mktemp("room") / "scene"))


@pytest.fixture(scope="module")
def fitted(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, fit_color(scene, folder, CONFIG)


def made(scene, folder, config, **options):
    """Whether the stage was found or done."""
    lines = []
    fit_color(scene, folder, config, report=lines.append, **options)
    return stages(lines)["color"]


def same(a, b):
    return all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in ("means", "quats", "scales", "opacities", "sh")
    )


def test_a_small_field_already_resembles_unseen_views(fitted, scene):
    folder, gaussians = fitted
    assert score_views(gaussians, scene, "train").psnr.value > 20
    assert score_views(gaussians, scene).psnr.value > 15.5  # of six stamps; the mean colour scores 13.3
    assert not list((folder / "unfinished").glob("*"))


def test_the_unit_of_the_world_does_not_matter(fitted, scene, tmp_path):
    smaller = Similarity(0.05, torch.eye(3), torch.zeros(3))
    small = dataclasses.replace(
        scene,
        cameras=[smaller.apply_to_camera(camera) for camera in scene.cameras],
        points=smaller.apply(scene.points),
    )
    psnr = score_views(fit_color(small, tmp_path, CONFIG), small, "train").psnr.value
    assert psnr == pytest.approx(score_views(fitted[1], scene, "train").psnr.value, abs=0.5)
    cut = dataclasses.replace(small, cameras=[dataclasses.replace(c, near=0.2) for c in small.cameras])
    quick = dataclasses.replace(CONFIG, training=dataclasses.replace(FIELD, steps=2))
    assert (
        made(small, tmp_path, quick) == made(cut, tmp_path, quick) == "done"
    )  # the near plane decides what is learned


def test_the_splat_file_holds_the_field(fitted):
    folder, gaussians = fitted
    read = read_splats(folder / "color.ply")
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(read, name), getattr(gaussians, name))
    torch.testing.assert_close(read.scales, gaussians.scales)
    torch.testing.assert_close(read.opacities, gaussians.opacities)


def test_a_second_run_redoes_nothing(fitted, scene):
    folder, gaussians = fitted
    assert made(scene, folder, CONFIG) == "found"
    assert same(fit_color(scene, folder, CONFIG), gaussians)


def test_killed_in_the_middle_it_goes_on_and_ends_the_same(fitted, scene, tmp_path):
    def kill(row):
        if row["step"] == 60:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_color(scene, tmp_path, CONFIG, progress=kill)
    assert not (tmp_path / "color.ply").exists()
    steps = []
    resumed = fit_color(scene, tmp_path, CONFIG, progress=lambda row: steps.append(row["step"]))
    assert steps[0] == 60  # from the checkpoint at 50
    assert same(resumed, fitted[1])


def test_other_options_and_other_pictures_make_another_field(fitted, scene, tmp_path):
    quick = dataclasses.replace(CONFIG, training=dataclasses.replace(FIELD, steps=2))
    inverted = dataclasses.replace(scene, colors=255 - scene.colors)
    assert made(scene, tmp_path, quick) == "done"
    assert made(scene, tmp_path, dataclasses.replace(quick, ssim_weight=0.0)) == "done"
    assert made(scene, tmp_path, quick, seed=1) == "done"
    assert made(inverted, tmp_path, quick) == "done"
    assert made(scene, tmp_path, quick) == "found"
    assert not same(fit_color(scene, tmp_path, quick), fit_color(inverted, tmp_path, quick))


def test_pictures_are_kept_as_bytes_at_the_training_size(scene):
    views = scene.views("train")
    cameras = [scene.cameras[i].resized(30, 40) for i in views]
    pictures = TrainingPictures(scene, views, cameras)
    assert len(pictures) == 6
    picture = pictures[2]
    blocks = scene.image(views[2]).view(30, 2, 40, 2, 3).mean(dim=(1, 3))
    assert picture.shape == (30, 40, 3)
    assert (picture - blocks).abs().mean() < 0.02
    assert torch.equal((picture * 255).round() / 255, picture)
    assert torch.equal(pictures[2], picture)


def test_where_the_lens_saw_nothing_the_picture_is_unknown(scene):
    lens = Distortion("brown_conrady", (0.3, 0.0, 0.0, 0.0))
    bent = dataclasses.replace(scene, cameras=[dataclasses.replace(c, distortion=lens) for c in scene.cameras])
    straight = bent.undistorted()
    views = straight.views("train")
    whole = TrainingPictures(straight, views, [straight.cameras[i] for i in views])[0]
    assert torch.equal(whole[..., 0].isnan(), ~straight.mask(views[0]))
    half = TrainingPictures(straight, views, [straight.cameras[i].resized(30, 40) for i in views])[0]
    assert 0 < int(half[..., 0].isnan().sum()) < 600
    assert half[15, 20].isfinite().all()


def test_pictures_that_give_no_points_are_refused(scene, tmp_path):
    """The toy room's pictures are too small for features; without points there is nothing to start from."""
    bare = dataclasses.replace(scene, points=scene.points[:0], colors=scene.colors[:0])
    with pytest.raises(ValueError, match=tells("scene:", "agree with the poses")):
        fit_color(bare, tmp_path, CONFIG)
    assert not (tmp_path / "color.ply").exists()


def test_few_points_are_used_where_pictures_give_none(scene, tmp_path):
    said = []
    few = dataclasses.replace(scene, points=scene.points[:20], colors=scene.colors[:20])
    fit_color(few, tmp_path, dataclasses.replace(CONFIG, training=FIELD.with_steps(1)), report=said.append)
    assert any("the scene has only 20 points" in line for line in said)
    assert any("the few points of the scene are used: scene: expected pictures that fit" in line for line in said)
    (stage,) = (tmp_path / "stages").glob("points-*/points.safetensors")
    assert torch.equal(load_file(stage)["points"], few.points)


def test_bad_input_is_refused_before_any_work(scene, tmp_path):
    lens = Distortion("brown_conrady", (0.3, 0.0, 0.0, 0.0))
    bent = dataclasses.replace(scene, cameras=[dataclasses.replace(c, distortion=lens) for c in scene.cameras])
    with pytest.raises(ValueError, match=tells("scene:", "distortion", "scene.undistorted()")):
        fit_color(bent, tmp_path, CONFIG)
    with pytest.raises(ValueError, match=tells("split:", "train, test", "got 'val'")):
        fit_color(scene, tmp_path, CONFIG, split="val")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh_degree": 4}, ("sh_degree:", "[0, 3]", "got 4")),
        ({"picture_scale": 0.0}, ("picture_scale:", "(0, 1]", "got 0")),
        ({"ssim_weight": -0.1}, ("ssim_weight:", "got -0.1")),
        ({"max_points": 1}, ("max_points:", "got 1")),
    ],
)
def test_wrong_options(change, message):
    with pytest.raises(ValueError, match=tells(*message)):
        ColorConfig(**change)


def test_the_published_schedule_is_the_default():
    assert ColorConfig.paper() == ColorConfig()
    assert ColorConfig().training == Training()
    assert (ColorConfig().sh_degree, ColorConfig().ssim_weight, ColorConfig().picture_scale) == (3, 0.2, 1.0)
