import pytest
from messages import tells

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
        ({"steps": 0}, ("steps:", "got 0")),
        ({"steps": 2.5}, ("steps:", "got 2.5")),
        ({"reset_every": -1}, ("reset_every:", "got -1")),
        ({"max_gaussians": 0}, ("max_gaussians:", "got 0")),
        ({"means_lr": 0.0}, ("means_lr:", "got 0.0")),
        ({"features_lr": -1.0}, ("features_lr:", "got -1.0")),
        ({"reset_opacity": 1.0}, ("reset_opacity:", "got 1.0")),
        ({"render_scale": 0.0}, ("render_scale:", "got 0.0")),
        ({"densify_gradient_size": "image"}, ("densify_gradient_size:", "'render', 'target'", "got 'image'")),
    ],
)
def test_wrong_values(change, message):
    with pytest.raises(ValueError, match=tells(*message)):
        FieldConfig(**change)


def test_published_rates_of_colours():
    config = FieldConfig()
    assert (config.sh0_lr, config.sh_rest_lr, config.sh_degree_every) == (0.0025, 0.000125, 1_000)
    assert [config.sh_degree(step) for step in (1, 999, 1_000, 2_999, 3_000)] == [0, 0, 1, 2, 3]
    assert FieldConfig(sh_degree_every=0).sh_degree(1) == 3


def test_pictures_start_small_on_schedule():
    config = FieldConfig(steps=100, coarse=((30, 4), (60, 2)))
    assert [config.divisor(step) for step in (1, 30, 31, 60, 61, 100)] == [4, 4, 2, 2, 1, 1]
    assert FieldConfig().divisor(1) == 1
    assert config.with_steps(1_000).coarse == ((300, 4), (600, 2))
    assert FieldConfig(coarse=[[30, 4], [60, 2]]).coarse == config.coarse  # as JSON has it


def test_degrees_go_on_from_that_of_the_start():
    assert [FieldConfig().sh_degree(step, 2) for step in (1, 999, 1_000)] == [2, 2, 3]


def test_a_very_short_schedule_keeps_one_pair_per_step():
    config = FieldConfig(steps=100, coarse=((50, 4), (90, 2)))
    assert config.with_steps(1).coarse == ((1, 2),)
    assert config.with_steps(2).coarse == ((1, 4), (2, 2))
    assert FieldConfig(steps=100, coarse=((10, 8), (20, 4), (90, 2))).with_steps(5).coarse == ((1, 4), (4, 2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh0_lr": -1.0}, ("sh0_lr:", "got -1.0")),
        ({"sh_degree_every": -1}, ("sh_degree_every:", "got -1")),
        ({"coarse": ((10, 0),)}, ("coarse:", "divisor:", "got 0")),
        ({"coarse": ((10, 2, 3),)}, ("coarse:", "got (10, 2, 3)")),
        ({"coarse": ((20, 2), (10, 1))}, ("coarse:", "increasing")),
        ({"coarse": ((10, 2), (10, 4))}, ("coarse:", "increasing")),
        ({"coarse": ((10, 2),), "render_scale": 2.0}, ("coarse:", "()", "render_scale = 2.0")),
    ],
)
def test_wrong_values_of_colours(change, message):
    with pytest.raises(ValueError, match=tells(*message)):
        FieldConfig(**change)


@pytest.mark.parametrize("extent", ["2", True, [1.0]])
def test_an_extent_that_is_no_number_is_refused(extent):
    with pytest.raises(TypeError, match=tells("extent", repr(extent), "float")):
        FieldConfig(extent=extent)


def test_fits_from_before_several_views_per_step_keep_their_identity():
    """Else every run folder would be fitted again."""
    before = {name for name in FieldConfig().identity()}
    assert "views_per_step" not in before
    assert len(before) == 29
    assert FieldConfig(views_per_step=2).identity() == FieldConfig().identity() | {"views_per_step": 2}
