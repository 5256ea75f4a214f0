"""A colour field of a room of six small pictures, as a stage of a run folder."""

import dataclasses

import pytest
import torch
from cases_training import changed
from safetensors.torch import load_file
from small_room import stages

from kfgs.cameras import Distortion
from kfgs.evaluation.color import score_views
from kfgs.pipeline.color import ColorConfig, TrainingPictures, fit_color

FIELD = changed(
    ColorConfig.quick().training.with_steps(120), every=10, maximum=3_000, report_every=20, checkpoint_every=25
)
CONFIG = dataclasses.replace(ColorConfig.quick(), training=FIELD)


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
        torch.equal(getattr(a, name), getattr(b, name)) for name in ["means", "quats", "scales", "opacities", "sh"]
    )


def test_a_small_field_already_resembles_unseen_views(fitted, scene):
    folder, gaussians = fitted
    assert score_views(gaussians, scene, "train").psnr.value > 20
    assert score_views(gaussians, scene).psnr.value > 15.5  # of six stamps; the mean colour scores 13.3
    assert not list((folder / "unfinished").glob("*"))


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


def test_few_points_are_used_where_pictures_give_none(scene, tmp_path):
    said = []
    few = dataclasses.replace(scene, points=scene.points[:20], colors=scene.colors[:20])
    fit_color(few, tmp_path, dataclasses.replace(CONFIG, training=FIELD.with_steps(1)), report=said.append)
    assert any("the scene has 20, and training" in line for line in said)
    assert any("the few points of the scene are used: scene: expected pictures that fit" in line for line in said)
    (stage,) = (tmp_path / "stages").glob("points-*/points.safetensors")
    assert torch.equal(load_file(stage)["points"], few.points)
