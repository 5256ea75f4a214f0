import numpy as np
import pytest
import torch

from kfgs.fields import GaussianParams, Rates, Training
from kfgs.fields.optimizer import FieldOptimizer

CONFIG = Training(steps=100, extent=4.0)
RATES = {"quats": 0.001, "log_scales": 0.005, "logit_opacities": 0.05, "features": 0.005}


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
