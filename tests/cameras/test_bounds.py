import torch
from messages import refused

from kfgs.cameras import robust_bounds


def test_outliers_do_not_move_the_box() -> None:
    g = torch.Generator().manual_seed(3)
    cloud = torch.rand(1000, 3, generator=g) * torch.tensor([4.0, 2.0, 1.0])
    far = torch.tensor([[-139.0, 5.0, 0.5], [2.0, 300.0, 0.5], [2.0, 1.0, -77.0]])
    bounds = robust_bounds(torch.cat([cloud, far]))
    assert bounds.inside[:1000].float().mean() > 0.99
    assert not bounds.inside[1000:].any()
    torch.testing.assert_close(bounds.high - bounds.low, torch.tensor([4.0, 2.0, 1.0]) * 1.2, rtol=0.05, atol=0)


def test_full_coverage_is_the_plain_box() -> None:
    points = torch.tensor([[0.0, 1.0, 2.0], [4.0, -1.0, 2.0], [1.0, 0.0, 5.0]])
    bounds = robust_bounds(points, coverage=1.0, margin=0.0)
    assert bounds.low.tolist() == [0, -1, 2]
    assert bounds.high.tolist() == [4, 1, 5]
    assert bounds.inside.all()
    assert repr(bounds).endswith("inside=[3] bool)")


def test_arguments_are_checked() -> None:
    refused(lambda: robust_bounds(torch.zeros(0, 3)), "points:", "got none")
    refused(lambda: robust_bounds(torch.zeros(2, 3), coverage=0.0), "coverage:", "got 0.0")
