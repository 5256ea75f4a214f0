import pytest

from kfgs.fields import FieldConfig


def test_defaults_are_the_published_values():
    config = FieldConfig()
    assert (config.steps, config.features_lr, config.adam_eps) == (30_000, 0.005, 1e-15)
    assert (config.means_lr, config.means_lr_final) == (1.6e-4, 1.6e-6)
    assert (config.opacities_lr, config.scales_lr, config.quats_lr) == (0.05, 0.005, 0.001)
    assert (config.densify_from, config.densify_until, config.densify_every) == (500, 15_000, 100)
    assert (config.densify_gradient, config.percent_dense, config.prune_opacity) == (2e-4, 0.01, 0.005)
    assert (config.reset_every, config.render_scale, config.max_gaussians) == (3_000, None, None)
    assert FieldConfig.paper(steps=7) == FieldConfig(steps=7)


def test_cpu_preset_is_short_and_can_be_changed():
    assert FieldConfig.cpu().steps <= 5_000
    assert FieldConfig.cpu(steps=12, features_lr=0.1).features_lr == 0.1


def test_with_steps_keeps_the_schedule_in_proportion():
    short = FieldConfig().with_steps(3_000)
    assert (short.steps, short.densify_from, short.densify_until, short.reset_every) == (3_000, 50, 1_500, 300)
    assert (short.densify_every, short.means_lr) == (100, 1.6e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps: expected a whole number of at least 1, got 0"),
        ({"steps": 2.5}, "steps: expected a whole number"),
        ({"reset_every": -1}, "reset_every: expected a whole number of at least 0"),
        ({"max_gaussians": 0}, "max_gaussians: expected a whole number of at least 1"),
        ({"means_lr": 0.0}, "means_lr: expected a number in"),
        ({"features_lr": -1.0}, "features_lr: expected a number in"),
        ({"reset_opacity": 1.0}, "reset_opacity: expected a number in"),
        ({"render_scale": 0.0}, "render_scale: expected a number in"),
        ({"densify_gradient_size": "image"}, "densify_gradient_size: expected one of 'render', 'target', got 'image'"),
    ],
)
def test_wrong_values(change, message):
    with pytest.raises(ValueError, match=message):
        FieldConfig(**change)
