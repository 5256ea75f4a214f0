from functools import partial

import pytest
import torch
from cases_clouds import balls
from messages import refused, tells

from kfgs.cameras import Camera
from kfgs.splat import average_views, vote_labels


def camera(size=8, name="front"):
    return _camera(size, size, size, name)


def _camera(width=32, height=24, focal=30.0, name=""):
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(torch.eye(4), K, width, height, name)


cloud = partial(balls, scale=0.1)


def test_a_constant_signal_is_its_own_average_and_the_unseen_get_none():
    gaussians = cloud([[0.0, 0.0, 2.0], [0.3, 0.2, 3.0], [0.0, 0.0, -2.0]])
    signal = torch.tensor([0.25, -3.0]).expand(8, 8, 2)
    values, weights = average_views(gaussians, [(camera(), signal), (camera(), signal)])
    torch.testing.assert_close(values[:2], torch.tensor([[0.25, -3.0]] * 2))
    assert values[2].tolist() == [0, 0]
    assert (weights > 0).tolist() == [True, True, False]


def test_each_gaussian_takes_the_pixels_that_show_it():
    gaussians = cloud([[-0.6, 0.0, 2.0], [0.6, 0.0, 2.0], [-1.2, 0.0, 4.0]])  # the third hides behind the first
    signal = torch.zeros(8, 8, 1)
    signal[:, 4:] = 1
    values, weights = average_views(gaussians, [(camera(), signal)])
    assert values[:, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)
    assert weights[2] < 0.5 * weights[0]


def test_views_count_by_the_pixels_that_they_show():
    gaussians = cloud([[0.0, 0.0, 2.0]])
    small, large = camera(8), camera(16, "large")  # the same view with four times the pixels
    zeros, ones = (small, torch.zeros(8, 8, 1)), (large, torch.ones(16, 16, 1))
    first, second = (average_views(gaussians, [view]).weights.item() for view in (zeros, ones))
    values, weights = average_views(gaussians, [zeros, ones])
    assert 2 < second / first < 4  # four, less what the low-pass filter adds to a small footprint
    assert weights.item() == pytest.approx(first + second)
    assert values.item() == pytest.approx(second / (first + second))


def test_wrong_input_is_named():
    gaussians = cloud([[0.0, 0.0, 2.0]])
    refused(lambda: average_views(gaussians, []), "views:", "got none")
    with pytest.raises(ValueError, match=tells("views:", "(8, 8, 2)", "'front'", "got (4, 8, 2)")):
        average_views(gaussians, [(camera(), torch.zeros(4, 8, 2))])
    with pytest.raises(ValueError, match=tells("views:", "(8, 8, 2)", "'second'", "got (8, 8, 3)")):
        average_views(gaussians, [(camera(), torch.zeros(8, 8, 2)), (camera(name="second"), torch.zeros(8, 8, 3))])


def test_each_gaussian_takes_the_class_of_the_pixels_that_show_it():
    gaussians = cloud([(-0.5, 0.0, 2.0), (0.5, 0.0, 2.0), (0.0, 0.0, -2.0)])  # left, right, behind the camera
    labels = torch.zeros(24, 32, dtype=torch.int64)
    labels[:, 16:] = 2
    votes = vote_labels(gaussians, [(_camera(), labels)], 3)
    assert votes.labels.tolist() == [0, 2, -1]
    assert votes.shares.tolist() == pytest.approx([1.0, 1.0, 0.0], abs=1e-3)
    assert votes.weights[2] == 0


def test_what_stands_behind_has_no_say_about_pixels_it_does_not_show():
    front, back = (0.0, 0.0, 2.0), (0.0, 0.0, 4.0)
    gaussians = cloud([front, back], opacity=0.99, scale=0.5)
    votes = vote_labels(gaussians, [(_camera(), torch.ones(24, 32, dtype=torch.int64))], 2)
    assert votes.weights[1] < 0.2 * votes.weights[0]


def test_the_majority_of_views_wins_and_unlabelled_pixels_do_not_vote():
    gaussians = cloud([(0.0, 0.0, 2.0)])
    maps = [torch.full((24, 32), label) for label in (1, 0, 1, 1, -1, -1, -1)]
    votes = vote_labels(gaussians, [(_camera(), m) for m in maps], 2)
    assert votes.labels.tolist() == [1]
    assert float(votes.shares) == pytest.approx(3 / 4, abs=1e-5)


def test_a_divided_vote_gives_no_label_unless_asked_to():
    views = [(_camera(), torch.full((24, 32), label)) for label in (1, 0, 1, 0, 1)]
    gaussians = cloud([(0.0, 0.0, 2.0)])
    assert vote_labels(gaussians, views, 2).labels.tolist() == [-1]
    assert vote_labels(gaussians, views, 2, min_share=0).labels.tolist() == [1]
    refused(lambda: vote_labels(gaussians, views, 2, min_share=1.5), "min_share:", "got 1.5")


def test_votes_are_the_sums_of_compositing_weights():
    gaussians = cloud([(0.1, 0.0, 2.0)], opacity=0.5)
    camera = _camera()
    votes = vote_labels(gaussians, [(camera, torch.zeros(24, 32, dtype=torch.int64))], 1)
    # one Gaussian alone: the sum over pixels of o * exp(-d^2 / (2 s^2)) is o * 2 pi s^2 up to the cut at 1/255
    s2 = (0.1 * 30 / 2) ** 2 + 0.3
    assert float(votes.weights) == pytest.approx(0.5 * 2 * torch.pi * s2, rel=0.03)


def test_bad_input_is_named():
    gaussians = cloud([(0.0, 0.0, 2.0)])
    with pytest.raises(ValueError, match=tells("views:", "(24, 32)", "got (3, 3)")):
        vote_labels(gaussians, [(_camera(), torch.zeros(3, 3, dtype=torch.int64))], 2)
    refused(lambda: vote_labels(gaussians, [(_camera(), torch.full((24, 32), 5))], 2), "views:", "below 2", "up to 5")
