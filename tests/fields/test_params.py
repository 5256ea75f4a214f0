import numpy as np
import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.fields import GaussianParams
from kfgs.fields.params import point_spacing


def cloud(n=400, seed=0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor([4.0, 3.0, 2.0])


def brute_spacing(points):
    """Root mean square distance to the three nearest others, from the full distance matrix."""
    x = points.double().numpy()
    distance = np.sqrt(((x[:, None] - x[None]) ** 2).sum(axis=2))
    np.fill_diagonal(distance, np.inf)
    return np.sqrt((np.sort(distance, axis=1)[:, :3] ** 2).mean(axis=1))


def test_spacing_is_rms_of_three_nearest_within_bounds():
    points = cloud()
    expected = brute_spacing(points)
    found = point_spacing(points).numpy()
    free = expected <= np.quantile(expected, 0.99)
    np.testing.assert_allclose(found[free], expected[free], rtol=1e-6)
    assert found.max() <= np.quantile(expected, 0.99) * (1 + 1e-6)


def test_start_values():
    params = GaussianParams.from_points(cloud(), 9, initial_opacity=0.1)
    gaussians = params.activated()
    assert params.channels == 9
    assert torch.equal(gaussians.quats, torch.tensor([1.0, 0, 0, 0]).expand(400, 4))
    assert torch.equal(gaussians.features, torch.zeros(400, 9))
    torch.testing.assert_close(gaussians.opacities, torch.full((400,), 0.1))
    torch.testing.assert_close(gaussians.scales[:, 0], gaussians.scales[:, 2])
    assert torch.equal(gaussians.means, cloud())


def test_far_outliers_are_dropped_and_change_no_spacing():
    inside = cloud()
    far = torch.randn(20, 3, generator=torch.Generator().manual_seed(1)) * 5 + torch.tensor([-139.0, 40.0, 90.0])
    with_far = GaussianParams.from_points(torch.cat([inside, far]), 2)
    assert torch.equal(with_far.means, inside)
    torch.testing.assert_close(with_far.log_scales, GaussianParams.from_points(inside, 2).log_scales)


def test_duplicates_share_the_spacing_of_their_place():
    points = cloud(50)
    doubled = GaussianParams.from_points(torch.cat([points, points, points, points, points]), 1)
    single = GaussianParams.from_points(points, 1)
    torch.testing.assert_close(doubled.log_scales.view(5, 50, 3)[3], single.log_scales)


def test_two_points_and_identical_points():
    two = GaussianParams.from_points(torch.tensor([[0.0, 0, 0], [0, 0, 2]]), 1)
    torch.testing.assert_close(two.log_scales.exp(), torch.full((2, 3), 2.0))
    with pytest.raises(ValueError, match=tells("points:", "got 5")):
        GaussianParams.from_points(torch.ones(5, 3), 1)
    with pytest.raises(ValueError, match=tells("points:", "got 0")):
        GaussianParams.from_points(torch.ones(0, 3), 1)


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
    params = GaussianParams.from_gaussians(gaussians)
    assert torch.isfinite(params.logit_opacities).all()
    again = GaussianParams(**params.to_tensors()).activated()
    for name in ("means", "quats", "scales", "opacities", *look):
        torch.testing.assert_close(getattr(again, name), getattr(gaussians, name))
    with pytest.raises(ValueError, match=tells("gaussians:", "got neither")):
        GaussianParams.from_gaussians(gaussians.replace(features=None, sh=None))


def test_flat_gaussians_have_finite_logarithms():
    scales = torch.tensor([[0.1, 0.0, 0.2], [0.0, 0.0, 1e-20]])
    gaussians = Gaussians(torch.zeros(2, 3), torch.ones(2, 4), scales, torch.full((2,), 0.5), sh=torch.zeros(2, 1, 3))
    params = GaussianParams.from_gaussians(gaussians)
    assert torch.isfinite(params.log_scales).all()
    torch.testing.assert_close(params.activated().scales, scales, rtol=1e-5, atol=2e-38)


def test_the_degree_in_use_is_the_highest_that_is_not_all_zero():
    params = GaussianParams.from_points(cloud(10), colors=torch.rand(10, 3), sh_degree=3)
    found = [params.used_sh_degree()]
    for row in (0, 2, 3, 7, 8, 14):
        params.sh_rest.zero_()
        params.sh_rest[4, row, 1] = -1e-3
        found.append(params.used_sh_degree())
    assert found == [0, 1, 1, 2, 2, 3, 3]
    assert GaussianParams.from_points(cloud(10), 3).used_sh_degree() == 0
    empty = params.map(lambda value: value[:0])
    assert empty.used_sh_degree() == 0


def test_a_colour_field_shows_its_points_colours():
    from kfgs.splat import evaluate_sh

    colors = torch.randint(0, 256, (400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    colors[0] = torch.tensor([0, 128, 255])
    params = GaussianParams.from_points(cloud(), colors=colors, sh_degree=2)
    assert (params.channels, params.sh_degree, params.features) == (3, 2, None)
    assert list(params.to_tensors()) == ["means", "quats", "log_scales", "logit_opacities", "sh0", "sh_rest"]
    gaussians = params.activated()
    assert gaussians.sh.shape == (400, 9, 3)
    shown = evaluate_sh(gaussians.sh, torch.randn(400, 3, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(shown, colors / 255)
    floats = GaussianParams.from_points(cloud(), colors=colors / 255, sh_degree=0)
    assert torch.equal(floats.sh0, params.sh0)
    assert floats.sh_rest is None
    assert "SH degree 2" in repr(params)
    torch.testing.assert_close(params.log_scales, GaussianParams.from_points(cloud(), 9).log_scales)


def test_colours_stay_with_their_points_when_some_are_dropped():
    inside = cloud()
    far = torch.full((5, 3), 500.0) + torch.arange(15.0).view(5, 3)
    points = torch.cat([far, inside])
    colors = ((points - points.min(dim=0).values) / (points.max() - points.min())).clamp(0, 1)
    params = GaussianParams.from_points(points, colors=colors, sh_degree=0)
    assert torch.equal(params.means, inside)
    torch.testing.assert_close(params.sh0 * 0.28209479 + 0.5, colors[5:])


def test_fewer_degrees_on_request():
    params = GaussianParams.from_points(cloud(10), colors=torch.rand(10, 3), sh_degree=3)
    params.sh_rest.copy_(torch.randn(10, 15, 3, generator=torch.Generator().manual_seed(0)))
    whole = params.activated().sh
    assert [params.activated(degree).sh.shape[1] for degree in (0, 1, 2, 3, 7)] == [1, 4, 9, 16, 16]
    assert torch.equal(params.activated(1).sh, whole[:, :4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh0": None}, ("features, sh0:", "got neither")),
        ({"features": torch.zeros(4, 2)}, ("features, sh0:", "got both")),
        ({"sh_rest": torch.zeros(4, 5, 3)}, ("sh_rest:", "expected 3, 8 or 15", "got 5")),
        ({"sh0": None, "features": torch.zeros(4, 2), "sh_rest": torch.zeros(4, 3, 3)}, ("sh_rest:", "got 3", "sh0")),
        ({"sh0": torch.zeros(5, 3)}, ("sh0:", "[N, 3]", "N = 4", "got (5, 3)")),
    ],
)
def test_a_field_has_features_or_colours(change, message):
    tensors = GaussianParams.from_points(cloud(4), colors=torch.zeros(4, 3), sh_degree=0).to_tensors()
    with pytest.raises(ValueError, match=tells(*message)):
        GaussianParams(**(tensors | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colors": torch.full((10, 3), 2.0)}, ("colors:", "uint8", "[0, 1]", "divide by 255")),
        ({"colors": torch.full((10, 3), 128)}, ("colors:", "uint8", "[0, 1]", "divide by 255")),
        ({"colors": torch.zeros(9, 3)}, ("colors:", "[P, 3]", "P = 10", "got (9, 3)")),
        ({"colors": None}, ("features, sh0:", "got neither")),
        ({"channels": 3}, ("features, sh0:", "got both")),
        ({"sh_degree": 4}, ("sh_degree:", "[0, 3]", "got 4")),
        ({"initial_opacity": 1.0}, ("initial_opacity:", "(0, 1)", "got 1.0")),
        ({"colors": None, "channels": 0}, ("channels:", "got 0")),
        ({"points": torch.full((10, 3), torch.nan)}, ("points:", "finite", "got others")),
        ({"points": torch.ones(10, 2)}, ("points:", "[P, 3]", "got (10, 2)")),
    ],
)
def test_wrong_arguments(change, message):
    with pytest.raises(ValueError, match=tells(*message)):
        GaussianParams.from_points(**({"points": cloud(10), "colors": torch.zeros(10, 3)} | change))
