import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kfgs import Gaussians
from kfgs.fields import Densify, Rates, Training
from kfgs.fields import optimizer as module
from kfgs.fields.optimizer import FieldOptimizer, GradientStatistics, to_gaussians, to_raw
from kfgs.fields.train import used_sh_degree

CONFIG = Training(steps=100, extent=4.0)
RATES = {"quats": 0.001, "scales": 0.005, "opacities": 0.05, "features": 0.005}
NAMES = ("means", "quats", "scales", "opacities", "features")
HOT, COLD, DENSIFY = 3e-4, 1e-4, Densify()


def params(n=5, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    shapes = zip(NAMES, ((n, 3), (n, 4), (n, 3), (n,), (n, 6)), strict=True)
    return {name: torch.randn(shape, generator=generator, dtype=dtype) for name, shape in shapes}


def gradient(name, step, shape):
    generator = torch.Generator().manual_seed(100 * step + len(name))
    return torch.randn(shape, generator=generator, dtype=torch.float64) * 1e-3


def give_gradients(optimizer, step):
    for name, value in optimizer.raw.items():
        value.grad = gradient(name, step, value.shape)


def state_tensors(optimizer):
    groups = zip(optimizer.raw, optimizer.adam.state_dict()["state"].values(), strict=True)
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
    for name, value in start.items():
        gradients = [gradient(name, step, value.shape).numpy() for step in range(1, 8)]
        rates = means_rates if name == "means" else [RATES[name]] * 7
        expected = adam_by_hand(value.numpy(), gradients, rates, 1e-15)
        np.testing.assert_allclose(optimizer.raw[name].detach().numpy(), expected, rtol=1e-9, err_msg=name)


def test_moments_follow_their_gaussians():
    """Reordering and dropping Gaussians changes nothing for those that stay."""
    parent = torch.tensor([4, 0, 2])
    plain, moved = (FieldOptimizer(params(), CONFIG) for _ in range(2))
    for optimizer in (plain, moved):
        for step in (1, 2, 3):
            give_gradients(optimizer, step)
            optimizer.step_(step)
    moved.replace_(rows(moved.raw, parent), parent, torch.zeros(3, dtype=torch.bool))
    give_gradients(plain, 4)
    for name, value in moved.raw.items():
        value.grad = plain.raw[name].grad[parent]
    for optimizer in (plain, moved):
        optimizer.step_(4)
    for name, value in moved.raw.items():
        assert torch.equal(value, plain.raw[name][parent]), name


def test_new_gaussians_start_without_moments():
    optimizer = FieldOptimizer(params(), CONFIG)
    give_gradients(optimizer, 1)
    optimizer.step_(1)
    before = {name: value.clone() for name, value in state_tensors(optimizer).items()}
    parent, fresh = torch.tensor([0, 1, 1]), torch.tensor([False, False, True])
    optimizer.replace_(rows(optimizer.raw, parent), parent, fresh)
    after = state_tensors(optimizer)
    assert torch.equal(after["features.exp_avg"][:2], before["features.exp_avg"][:2])
    assert torch.equal(after["features.exp_avg"][2], torch.zeros(6, dtype=torch.float64))
    assert torch.equal(after["features.exp_avg_sq"][2], torch.zeros(6, dtype=torch.float64))


def test_a_reset_lowers_opacities_and_forgets_only_their_moments():
    optimizer = FieldOptimizer(params(), CONFIG)
    give_gradients(optimizer, 1)
    optimizer.step_(1)
    before = optimizer.raw["opacities"].detach().sigmoid()
    optimizer.lower_opacities_()
    state = state_tensors(optimizer)
    assert 0 < int((before > 0.01).sum()) < 6
    torch.testing.assert_close(optimizer.raw["opacities"].detach().sigmoid(), before.clamp_max(0.01))
    assert not state["opacities.exp_avg"].any()
    assert not state["opacities.exp_avg_sq"].any()
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
    assert found[100]["scales"] == pytest.approx(0.1 * config.rates.scales)
    assert found[100]["means"] == pytest.approx(config.rates.means_final)


# Raw values


@pytest.mark.parametrize("look", [{"features": (7, 5)}, *({"sh": (7, K, 3)} for K in (1, 4, 9, 16))])
def test_activation_and_its_inverse(look):
    g = torch.Generator().manual_seed(3)
    gaussians = Gaussians(
        means=torch.randn(7, 3, generator=g, dtype=torch.float64),
        quats=torch.randn(7, 4, generator=g, dtype=torch.float64),
        scales=torch.rand(7, 3, generator=g, dtype=torch.float64) + 0.1,
        opacities=torch.tensor([0.0, 1e-3, 0.1, 0.5, 0.9, 0.99, 1.0], dtype=torch.float64),
        **{name: torch.randn(shape, generator=g, dtype=torch.float64) for name, shape in look.items()},
    )
    raw = to_raw(gaussians)
    assert torch.isfinite(raw["opacities"]).all()
    again = to_gaussians(raw, gaussians)
    for name in ("means", "quats", "scales", "opacities", *look):
        torch.testing.assert_close(getattr(again, name), getattr(gaussians, name))


def test_flat_gaussians_have_finite_logarithms():
    scales = torch.tensor([[0.1, 0.0, 0.2], [0.0, 0.0, 1e-20]])
    gaussians = Gaussians(torch.zeros(2, 3), torch.ones(2, 4), scales, torch.full((2,), 0.5), sh=torch.zeros(2, 1, 3))
    raw = to_raw(gaussians)
    assert torch.isfinite(raw["scales"]).all()
    torch.testing.assert_close(to_gaussians(raw, gaussians).scales, scales, rtol=1e-5, atol=2e-38)


def test_the_degree_in_use_is_the_highest_that_is_not_all_zero():
    sh = torch.zeros(10, 16, 3)
    found = [used_sh_degree(sh)]
    for row in (1, 3, 4, 8, 9, 15):
        sh.zero_()
        sh[4, row, 1] = -1e-3
        found.append(used_sh_degree(sh))
    assert found == [0, 1, 1, 2, 2, 3, 3]
    assert used_sh_degree(sh[:, :1]) == 0
    assert used_sh_degree(sh[:0]) == 0


def test_fewer_degrees_on_request():
    whole = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(0))
    gaussians = Gaussians(torch.zeros(5, 3), torch.ones(5, 4), torch.ones(5, 3), torch.full((5,), 0.5), sh=whole)
    shown = {degree: to_gaussians(to_raw(gaussians), gaussians, degree).sh for degree in (0, 1, 2, 3, 7, None)}
    assert [sh.shape[1] for sh in shown.values()] == [1, 4, 9, 16, 16, 16]
    assert torch.equal(shown[1], whole[:, :4])


# Density control


def cloud(scales, opacities=None):
    n = len(scales)
    generator = torch.Generator().manual_seed(0)
    opacities = torch.full((n,), 0.5) if opacities is None else torch.tensor(opacities)
    return {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.tensor(scales)[:, None].log() + torch.tensor([0.0, -0.5, -1.0]),
        "opacities": torch.logit(opacities),
        "features": torch.randn(n, 4, generator=generator),
    }


def densify(raw, gradient, options=DENSIFY, *, prune_large=False, seed=0):
    """The extent of 10 clones up to scale 0.1, and prunes beyond scale 1."""
    generator = torch.Generator().manual_seed(seed)
    return module.densify(raw, gradient, options, extent=10.0, prune_large=prune_large, generator=generator)


def rows(raw, index):
    return {name: value[torch.as_tensor(index)] for name, value in raw.items()}


def assert_same(a, b, names=NAMES):
    for name in names:
        assert torch.equal(a[name], b[name]), name


def test_small_hot_gaussians_are_copied():
    start = cloud([0.05, 0.05, 0.09])
    grown = densify(start, torch.tensor([HOT, COLD, 2e-4]))
    assert grown.parent.tolist() == [0, 1, 2, 0, 2]  # the threshold itself is hot
    assert grown.fresh.tolist() == [False, False, False, True, True]
    assert_same(grown.raw, rows(start, [0, 1, 2, 0, 2]))


def test_large_hot_gaussians_become_two_smaller_ones():
    start = cloud([0.05, 0.5, 0.5])
    grown = densify(start, torch.tensor([COLD, HOT, COLD]))
    assert grown.parent.tolist() == [0, 2, 1, 1]
    assert grown.fresh.tolist() == [False, False, True, True]
    parents = rows(start, [0, 2, 1, 1])
    assert_same(grown.raw, parents, ("quats", "opacities", "features"))
    torch.testing.assert_close(grown.raw["scales"][2:], parents["scales"][2:] - math.log(1.6))
    assert torch.equal(grown.raw["means"][:2], parents["means"][:2])
    assert not torch.equal(grown.raw["means"][2], grown.raw["means"][3])


def test_children_are_drawn_from_their_parent():
    """Over many splits of one Gaussian, mean and covariance of the children are the parent's: R diag(s^2) R^T."""
    n = 20_000
    turn = math.radians(40)
    quat = torch.tensor([math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)])  # about z, (w, x, y, z)
    start = {
        "means": torch.tensor([1.0, -2.0, 3.0]).repeat(n, 1),
        "quats": 3 * quat.repeat(n, 1),
        "scales": torch.tensor([0.9, 0.3, 0.1]).log().repeat(n, 1),
        "opacities": torch.zeros(n),
        "features": torch.zeros(n, 1),
    }
    grown = densify(start, torch.full((n,), HOT), seed=5)
    R = torch.tensor([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    expected = R @ torch.diag(torch.tensor([0.81, 0.09, 0.01])) @ R.T
    assert len(grown.parent) == 2 * n
    mean = grown.raw["means"].mean(dim=0)
    torch.testing.assert_close(mean, start["means"][0], atol=0.02, rtol=0)  # 4 standard errors
    torch.testing.assert_close(grown.raw["means"].T.cov(), expected, atol=0.025, rtol=0)


def test_faint_ones_are_dropped():
    start = cloud([0.05, 0.05, 0.05], [0.004, 0.006, 0.5])
    grown = densify(start, torch.full((3,), COLD))
    assert grown.parent.tolist() == [1, 2]
    assert len(densify(grown.raw, torch.full((2,), COLD)).parent) == 2


def test_oversized_ones_are_dropped_only_when_asked():
    start = cloud([0.05, 1.2, 1.5])
    cold, split = torch.full((3,), COLD), torch.tensor([COLD, COLD, HOT])
    assert len(densify(start, cold).parent) == 3
    assert densify(start, cold, prune_large=True).parent.tolist() == [0]
    # The children of the third (1.5 / 1.6 < 1) are small enough to stay.
    assert densify(start, split, prune_large=True).parent.tolist() == [0, 2, 2]


def test_a_limit_lets_the_strongest_grow_first():
    start = cloud([0.05, 0.05, 0.5, 0.5])
    gradient = torch.tensor([3e-4, 5e-4, 4e-4, 6e-4])
    limited = replace(DENSIFY, maximum=6)
    grown = densify(start, gradient, limited)
    assert grown.parent.tolist() == [0, 1, 2, 1, 3, 3]
    assert len(densify(start, gradient, replace(DENSIFY, maximum=3)).parent) == 4
    assert len(densify(start, gradient, replace(DENSIFY, maximum=8)).parent) == 8


def test_statistics_are_means_of_ndc_gradients_over_views_that_saw_it():
    statistics = GradientStatistics.zeros(torch.zeros(3, 3))
    statistics.add_(torch.tensor([0, 2]), torch.tensor([[3e-3, 4e-3], [1.0, 0.0]]), (200, 200))
    statistics.add_(torch.tensor([2]), torch.tensor([[0.0, 1.0]]), (100, 300))
    # 0: 100 * |(3e-3, 4e-3)| = 0.5; 1: never seen; 2: (1 * 100 + 1 * 50) / 2, width and height not mixed up
    torch.testing.assert_close(statistics.mean(), torch.tensor([0.5, 0.0, 75.0]))
