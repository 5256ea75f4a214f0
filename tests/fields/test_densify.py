import math
from dataclasses import replace

import torch

from kfgs.fields import Densify, GaussianParams, optimizer
from kfgs.fields.optimizer import GradientStatistics

CONFIG = Densify()
EXTENT = 10.0  # cloned up to scale 0.1, pruned beyond scale 1
HOT, COLD = 3e-4, 1e-4


def params(scales, opacities=None):
    n = len(scales)
    generator = torch.Generator().manual_seed(0)
    opacities = torch.full((n,), 0.5) if opacities is None else torch.tensor(opacities)
    return GaussianParams(
        means=torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        log_scales=torch.tensor(scales)[:, None].log() + torch.tensor([0.0, -0.5, -1.0]),
        logit_opacities=torch.logit(opacities),
        features=torch.randn(n, 4, generator=generator),
    )


def densify(params, gradient, options=CONFIG, *, extent=EXTENT, prune_large=False, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return optimizer.densify(params, gradient, options, extent=extent, prune_large=prune_large, generator=generator)


def rows(params, index):
    return params.map(lambda value: value[torch.as_tensor(index)])


def assert_same(a, b, names=("means", "quats", "log_scales", "logit_opacities", "features")):
    for name in names:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_small_hot_gaussians_are_copied():
    start = params([0.05, 0.05, 0.09])
    grown = densify(start, torch.tensor([HOT, COLD, 2e-4]), CONFIG, extent=EXTENT)
    assert grown.source.tolist() == [0, 1, 2, 0, 2]  # the threshold itself is hot
    assert grown.fresh.tolist() == [False, False, False, True, True]
    assert_same(grown.params, rows(start, [0, 1, 2, 0, 2]))


def test_large_hot_gaussians_become_two_smaller_ones():
    start = params([0.05, 0.5, 0.5])
    grown = densify(start, torch.tensor([COLD, HOT, COLD]), CONFIG, extent=EXTENT)
    assert grown.source.tolist() == [0, 2, 1, 1]
    assert grown.fresh.tolist() == [False, False, True, True]
    parents = rows(start, [0, 2, 1, 1])
    assert_same(grown.params, parents, ("quats", "logit_opacities", "features"))
    torch.testing.assert_close(grown.params.log_scales[2:], parents.log_scales[2:] - math.log(1.6))
    assert torch.equal(grown.params.means[:2], parents.means[:2])
    assert not torch.equal(grown.params.means[2], grown.params.means[3])


def test_children_are_drawn_from_their_parent():
    """Over many splits of one Gaussian, mean and covariance of the children are the parent's: R diag(s^2) R^T."""
    n = 20_000
    turn = math.radians(40)
    quat = torch.tensor([math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)])  # about z, (w, x, y, z)
    start = GaussianParams(
        means=torch.tensor([1.0, -2.0, 3.0]).repeat(n, 1),
        quats=3 * quat.repeat(n, 1),
        log_scales=torch.tensor([0.9, 0.3, 0.1]).log().repeat(n, 1),
        logit_opacities=torch.zeros(n),
        features=torch.zeros(n, 1),
    )
    grown = densify(start, torch.full((n,), HOT), CONFIG, extent=EXTENT, seed=5)
    R = torch.tensor([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    expected = R @ torch.diag(torch.tensor([0.81, 0.09, 0.01])) @ R.T
    assert len(grown.params) == 2 * n
    torch.testing.assert_close(grown.params.means.mean(dim=0), start.means[0], atol=0.02, rtol=0)  # 4 standard errors
    torch.testing.assert_close(grown.params.means.T.cov(), expected, atol=0.025, rtol=0)


def test_faint_ones_are_dropped():
    start = params([0.05, 0.05, 0.05], [0.004, 0.006, 0.5])
    grown = densify(start, torch.full((3,), COLD), CONFIG, extent=EXTENT)
    assert grown.source.tolist() == [1, 2]
    assert len(densify(grown.params, torch.full((2,), COLD), CONFIG, extent=EXTENT).params) == 2


def test_oversized_ones_are_dropped_only_when_asked():
    start = params([0.05, 1.2, 1.5])
    cold, split = torch.full((3,), COLD), torch.tensor([COLD, COLD, HOT])
    assert len(densify(start, cold, CONFIG, extent=EXTENT).params) == 3
    assert densify(start, cold, CONFIG, extent=EXTENT, prune_large=True).source.tolist() == [0]
    # The children of the third (1.5 / 1.6 < 1) are small enough to stay.
    assert densify(start, split, CONFIG, extent=EXTENT, prune_large=True).source.tolist() == [0, 2, 2]


def test_a_limit_lets_the_strongest_grow_first():
    start = params([0.05, 0.05, 0.5, 0.5])
    gradient = torch.tensor([3e-4, 5e-4, 4e-4, 6e-4])
    limited = replace(CONFIG, maximum=6)
    grown = densify(start, gradient, limited, extent=EXTENT)
    assert grown.source.tolist() == [0, 1, 2, 1, 3, 3]
    assert len(densify(start, gradient, replace(CONFIG, maximum=3), extent=EXTENT).params) == 4
    assert len(densify(start, gradient, replace(CONFIG, maximum=8), extent=EXTENT).params) == 8


def test_statistics_are_means_of_ndc_gradients_over_views_that_saw_it():
    statistics = GradientStatistics.zeros(params([0.1, 0.1, 0.1]))
    statistics.add_(torch.tensor([0, 2]), torch.tensor([[3e-3, 4e-3], [1.0, 0.0]]), (200, 200))
    statistics.add_(torch.tensor([2]), torch.tensor([[0.0, 1.0]]), (100, 300))
    # 0: 100 * |(3e-3, 4e-3)| = 0.5; 1: never seen; 2: (1 * 100 + 1 * 50) / 2, width and height not mixed up
    torch.testing.assert_close(statistics.mean(), torch.tensor([0.5, 0.0, 75.0]))
