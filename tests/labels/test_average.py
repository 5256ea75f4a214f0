import pytest
import torch

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.labels import average_views


def camera(size=8, name="front"):
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return Camera(torch.eye(4), K, size, size, name)


def cloud(means, opacity=0.9, scale=0.15):
    means = torch.tensor(means)
    n = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)
    return Gaussians(means, quats, torch.full((n, 3), scale), torch.full((n,), opacity))


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
    with pytest.raises(ValueError, match="views: expected at least one camera, got none"):
        average_views(gaussians, [])
    with pytest.raises(ValueError, match=r"views: expected a map \(8, 8, 2\) for camera 'front', got \(4, 8, 2\)"):
        average_views(gaussians, [(camera(), torch.zeros(4, 8, 2))])
    with pytest.raises(ValueError, match=r"views: expected a map \(8, 8, 2\) for camera 'second', got \(8, 8, 3\)"):
        average_views(gaussians, [(camera(), torch.zeros(8, 8, 2)), (camera(name="second"), torch.zeros(8, 8, 3))])
