"""Whether two clouds lie in the same frame."""

import pytest
import torch
from cases_clouds import room, surface
from messages import refused

from kfgs.cameras.similarity import Similarity
from kfgs.scenes.frames import frames_agree


def similarity(scale=1.0, shift=(0.0, 0.0, 0.0), rotation=None):
    return Similarity(scale, torch.eye(3) if rotation is None else rotation, torch.tensor(shift))


@pytest.mark.parametrize("counts", [(4_000, 4_000), (2_000, 15_000), (15_000, 2_000)])
def test_two_samples_of_one_surface_agree(counts):
    check = frames_agree(surface(counts[0], 0), surface(counts[1], 1))
    assert check.agree
    assert min(check.near) > 0.8  # uniform points: 1 - 0.5^4 = 0.94 within twice the median spacing
    assert "agree" in check.summary
    assert "disagree" not in check.summary


@pytest.mark.parametrize(
    "change",
    [
        similarity(scale=1.2),
        similarity(shift=(0.1, 0.1, 0.1)),  # 2 % of the size for each wall: the shares near hardly notice
        similarity(shift=(0.6, 0.4, 0.3)),
        similarity(rotation=torch.diag(torch.tensor([-1.0, -1.0, 1.0]))),
        similarity(rotation=torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), shift=(3.0, 0.0, 0.0)),
    ],
)
def test_another_frame_disagrees(change):
    check = frames_agree(surface(4_000, 0), change.apply(surface(4_000, 1)))
    assert not check.agree
    assert "disagree" in check.summary


def test_a_part_agrees_with_the_whole():
    part = surface(6_000, 1)
    part = part[part[:, 0] < 1.5]
    assert frames_agree(part, surface(6_000, 0)).agree
    assert frames_agree(surface(6_000, 0), part).agree


def test_a_fog_around_a_scene_is_another_scene():
    generator = torch.Generator().manual_seed(1)
    fog = 3 * torch.randn(4_000, 3, generator=generator)
    assert not frames_agree(surface(4_000, 0), fog).agree


@pytest.mark.parametrize("count", [100, 300, 2_000])
def test_few_points_agree_in_their_frame_and_in_no_other(count):
    scene, few = room(6_000, 0), room(8_000, 1)[:count]
    middle = scene.mean(0)
    assert frames_agree(scene, few).agree
    assert frames_agree(few, scene).agree
    assert not frames_agree(scene, few * torch.tensor([-1.0, -1.0, 1.0]) + middle * torch.tensor([2.0, 2.0, 0.0])).agree
    assert not frames_agree(scene, 1.05 * few).agree


def test_unrelated_points_in_the_same_box_disagree():
    for count in (300, 4_000):
        generator = torch.Generator().manual_seed(3)
        others = torch.rand(count, 3, generator=generator).double() * torch.tensor([4.0, 3.0, 2.0])
        assert not frames_agree(room(6_000, 0), others).agree


def test_five_per_cent_larger_is_another_frame_though_walls_stay_near_walls():
    """About the corner where three walls meet: only the things between them move."""
    scene, other = room(6_000, 0), room(8_000, 1)
    check = frames_agree(scene, 1.05 * other)
    assert max(check.near) > 0.8
    assert check.drift > 0.03
    assert not check.agree
    assert frames_agree(scene, other).drift < 0.003


def test_walls_that_slide_along_themselves_say_nothing():
    """Three planes through the origin: 5 % larger, they are the same planes."""
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(6_000, 3, generator=generator).double()
    corner[torch.arange(6_000), torch.arange(6_000) % 3] = 0.0
    check = frames_agree(corner[::2], 1.03 * corner[1::2])
    assert check.agree
    assert check.drift < 0.002


def test_nan_and_single_points_are_refused():
    good = surface(200, 0)
    bad = good.clone()
    bad[7, 1] = torch.nan
    refused(lambda: frames_agree(good, bad), "dst:", "got NaN", "row 7")
    refused(lambda: frames_agree(good[:1], good), "src:", "got 1")
    refused(lambda: frames_agree(good, good[:, :2]), "dst:", "[M, 3]", "got (200, 2)")
