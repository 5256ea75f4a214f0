import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kfgs.fields import Densify, GaussianParams, Rates, Training
from kfgs.fields import optimizer as module
from kfgs.fields.optimizer import FieldOptimizer, GradientStatistics

CONFIG = Training(steps=100, extent=4.0)
RATES = {"quats": 0.001, "log_scales": 0.005, "logit_opacities": 0.05, "features": 0.005}
HOT, COLD, DENSIFY = 3e-4, 1e-4, Densify()


def params(n=5, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    return GaussianParams(
        *(torch.randn(shape, generator=generator, dtype=dtype) for shape in ((n, 3), (n, 4), (n, 3), (n,), (n, 6)))
    )


def gradient(name, step, shape):
    generator = torch.Generator().manual_seed(100 * step + len(name))
    return torch.randn(shape, generator=generator, dtype=torch.float64) * 1e-3


def give_gradients(optimizer, step):
    for name, value in optimizer.params.to_tensors().items():
        value.grad = gradient(name, step, value.shape)


def state_tensors(optimizer):
    groups = zip(optimizer.params.to_tensors(), optimizer.adam.state_dict()["state"].values(), strict=True)
    return {f"{name}.{key}": value for name, group in groups for key, value in group.items()}


def adam_by_hand(start, gradients, rates, eps):
    """Adam as Kingma and Ba wrote it (their algorithm 1), in numpy."""
    x, m, v = start.copy(), np.zeros_like(start), np.zeros_like(start)
    for t, (g, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g * g
        x = x - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + eps)
    return x


def test_every_group_follows_adam_at_its_rate():
    start = params()
    optimizer = FieldOptimizer(start, CONFIG)
    for step in range(1, 8):
        give_gradients(optimizer, step)
        optimizer.step_(step)
    means_rates = [4.0 * np.exp(np.log(1.6e-4) * (1 - t / 100) + np.log(1.6e-6) * t / 100) for t in range(1, 8)]
    for name, value in start.to_tensors().items():
        gradients = [gradient(name, step, value.shape).numpy() for step in range(1, 8)]
        rates = means_rates if name == "means" else [RATES[name]] * 7
        expected = adam_by_hand(value.numpy(), gradients, rates, 1e-15)
        np.testing.assert_allclose(getattr(optimizer.params, name).detach().numpy(), expected, rtol=1e-9, err_msg=name)


def test_moments_follow_their_gaussians():
    """Reordering and dropping Gaussians changes nothing for those that stay."""
    source = torch.tensor([4, 0, 2])
    plain, moved = (FieldOptimizer(params(), CONFIG) for _ in range(2))
    for optimizer in (plain, moved):
        for step in (1, 2, 3):
            give_gradients(optimizer, step)
            optimizer.step_(step)
    moved.replace_(moved.params.map(lambda value: value[source]), source, torch.zeros(3, dtype=torch.bool))
    give_gradients(plain, 4)
    for name, value in moved.params.to_tensors().items():
        value.grad = getattr(plain.params, name).grad[source]
    for optimizer in (plain, moved):
        optimizer.step_(4)
    for name, value in moved.params.to_tensors().items():
        assert torch.equal(value, getattr(plain.params, name)[source]), name


def test_new_gaussians_start_without_moments():
    optimizer = FieldOptimizer(params(), CONFIG)
    give_gradients(optimizer, 1)
    optimizer.step_(1)
    before = {name: value.clone() for name, value in state_tensors(optimizer).items()}
    source, fresh = torch.tensor([0, 1, 1]), torch.tensor([False, False, True])
    optimizer.replace_(optimizer.params.map(lambda value: value[source]), source, fresh)
    after = state_tensors(optimizer)
    assert torch.equal(after["features.exp_avg"][:2], before["features.exp_avg"][:2])
    assert torch.equal(after["features.exp_avg"][2], torch.zeros(6, dtype=torch.float64))
    assert torch.equal(after["features.exp_avg_sq"][2], torch.zeros(6, dtype=torch.float64))


def test_a_reset_lowers_opacities_and_forgets_only_their_moments():
    optimizer = FieldOptimizer(params(), CONFIG)
    give_gradients(optimizer, 1)
    optimizer.step_(1)
    before = optimizer.params.logit_opacities.detach().sigmoid()
    optimizer.lower_opacities_(0.4)
    state = state_tensors(optimizer)
    assert 0 < int((before > 0.4).sum()) < 5
    torch.testing.assert_close(optimizer.params.logit_opacities.detach().sigmoid(), before.clamp_max(0.4))
    assert not state["logit_opacities.exp_avg"].any()
    assert not state["logit_opacities.exp_avg_sq"].any()
    assert state["means.exp_avg"].all()


def test_rates_fall_in_the_second_half_to_their_final_share():
    config = Training(steps=100, extent=1.0, rates=Rates(final=0.1))
    optimizer = FieldOptimizer(params(), config)
    found = {}
    for step in (1, 50, 75, 100):
        optimizer.step_(step)
        found[step] = {group["name"]: group["lr"] for group in optimizer.adam.param_groups}
    assert found[1] | {"means": None} == found[50] | {"means": None}
    assert found[75]["quats"] == pytest.approx(0.1**0.5 * config.rates.quats)
    assert found[100]["log_scales"] == pytest.approx(0.1 * config.rates.scales)
    assert found[100]["means"] == pytest.approx(config.rates.means_final)


# Density control


def cloud(scales, opacities=None):
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


def densify(params, gradient, options=DENSIFY, *, prune_large=False, seed=0):
    """The extent of 10 clones up to scale 0.1, and prunes beyond scale 1."""
    generator = torch.Generator().manual_seed(seed)
    return module.densify(params, gradient, options, extent=10.0, prune_large=prune_large, generator=generator)


def rows(params, index):
    return params.map(lambda value: value[torch.as_tensor(index)])


def assert_same(a, b, names=("means", "quats", "log_scales", "logit_opacities", "features")):
    for name in names:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_small_hot_gaussians_are_copied():
    start = cloud([0.05, 0.05, 0.09])
    grown = densify(start, torch.tensor([HOT, COLD, 2e-4]))
    assert grown.source.tolist() == [0, 1, 2, 0, 2]  # the threshold itself is hot
    assert grown.fresh.tolist() == [False, False, False, True, True]
    assert_same(grown.params, rows(start, [0, 1, 2, 0, 2]))


def test_large_hot_gaussians_become_two_smaller_ones():
    start = cloud([0.05, 0.5, 0.5])
    grown = densify(start, torch.tensor([COLD, HOT, COLD]))
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
    grown = densify(start, torch.full((n,), HOT), seed=5)
    R = torch.tensor([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    expected = R @ torch.diag(torch.tensor([0.81, 0.09, 0.01])) @ R.T
    assert len(grown.params) == 2 * n
    torch.testing.assert_close(grown.params.means.mean(dim=0), start.means[0], atol=0.02, rtol=0)  # 4 standard errors
    torch.testing.assert_close(grown.params.means.T.cov(), expected, atol=0.025, rtol=0)


def test_faint_ones_are_dropped():
    start = cloud([0.05, 0.05, 0.05], [0.004, 0.006, 0.5])
    grown = densify(start, torch.full((3,), COLD))
    assert grown.source.tolist() == [1, 2]
    assert len(densify(grown.params, torch.full((2,), COLD)).params) == 2


def test_oversized_ones_are_dropped_only_when_asked():
    start = cloud([0.05, 1.2, 1.5])
    cold, split = torch.full((3,), COLD), torch.tensor([COLD, COLD, HOT])
    assert len(densify(start, cold).params) == 3
    assert densify(start, cold, prune_large=True).source.tolist() == [0]
    # The children of the third (1.5 / 1.6 < 1) are small enough to stay.
    assert densify(start, split, prune_large=True).source.tolist() == [0, 2, 2]


def test_a_limit_lets_the_strongest_grow_first():
    start = cloud([0.05, 0.05, 0.5, 0.5])
    gradient = torch.tensor([3e-4, 5e-4, 4e-4, 6e-4])
    limited = replace(DENSIFY, maximum=6)
    grown = densify(start, gradient, limited)
    assert grown.source.tolist() == [0, 1, 2, 1, 3, 3]
    assert len(densify(start, gradient, replace(DENSIFY, maximum=3)).params) == 4
    assert len(densify(start, gradient, replace(DENSIFY, maximum=8)).params) == 8


def test_statistics_are_means_of_ndc_gradients_over_views_that_saw_it():
    statistics = GradientStatistics.zeros(cloud([0.1, 0.1, 0.1]))
    statistics.add_(torch.tensor([0, 2]), torch.tensor([[3e-3, 4e-3], [1.0, 0.0]]), (200, 200))
    statistics.add_(torch.tensor([2]), torch.tensor([[0.0, 1.0]]), (100, 300))
    # 0: 100 * |(3e-3, 4e-3)| = 0.5; 1: never seen; 2: (1 * 100 + 1 * 50) / 2, width and height not mixed up
    torch.testing.assert_close(statistics.mean(), torch.tensor([0.5, 0.0, 75.0]))
