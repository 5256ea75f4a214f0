import pytest
from messages import refused

from kfgs.fields import Densify, Rates, Training


def test_defaults_are_the_published_values():
    training = Training()
    assert (training.steps, training.render_scale, training.sh_degree_every) == (30_000, None, 1_000)
    rates = training.rates
    assert (rates.features, rates.means, rates.means_final) == (0.005, 1.6e-4, 1.6e-6)
    others = rates.opacities, rates.scales, rates.quats, rates.sh0, rates.sh_rest
    assert others == (0.05, 0.005, 0.001, 0.0025, 0.000125)
    densify = training.densify
    assert (densify.start, densify.stop, densify.every, densify.reset_every) == (500, 15_000, 100, 3_000)
    assert (densify.gradient, densify.percent_dense, densify.prune_opacity) == (2e-4, 0.01, 0.005)


def test_with_steps_keeps_the_schedule_in_proportion():
    short = Training(half_until=6_000).with_steps(3_000)
    assert (short.steps, short.half_until, short.sh_degree_every) == (3_000, 600, 100)
    assert (short.densify.start, short.densify.stop, short.densify.reset_every) == (50, 1_500, 300)
    assert (short.densify.every, short.rates) == (100, Rates())
    assert Training(densify=None).with_steps(5).densify is None
    assert Training.cpu().steps <= 5_000


def test_a_limit_of_gaussians():
    assert Training().with_maximum(7).densify == Densify(maximum=7)
    assert Training.cpu().with_maximum(None) == Training.cpu()
    assert Training.cpu().with_maximum(0).densify.maximum is None


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (Training, {"steps": 0}, ("steps:", "got 0")),
        (Training, {"steps": 2.5}, ("steps:", "got 2.5")),
        (Training, {"extent": 0.0}, ("extent:", "got 0.0")),
        (Training, {"render_scale": 0.0}, ("render_scale:", "got 0.0")),
        (Training, {"half_until": 10, "render_scale": 2.0}, ("half_until:", "0", "render_scale = 2.0")),
        (Training, {"sh_degree_every": -1}, ("sh_degree_every:", "got -1")),
        (Densify, {"reset_every": -1}, ("reset_every:", "got -1")),
        (Densify, {"maximum": 0}, ("maximum:", "got 0")),
        (Rates, {"means": 0.0}, ("means:", "got 0.0")),
        (Rates, {"features": -1.0}, ("features:", "got -1.0")),
    ],
)
def test_wrong_values(kind, change, message):
    refused(lambda: kind(**change), *message)
