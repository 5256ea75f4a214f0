import numpy as np
import pytest
import torch
from messages import refused

from kfgs.fields import gaussians_from_points
from kfgs.fields.start import point_spacing


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
    gaussians = gaussians_from_points(cloud(), 9, initial_opacity=0.1)
    assert torch.equal(gaussians.quats, torch.tensor([1.0, 0, 0, 0]).expand(400, 4))
    assert torch.equal(gaussians.features, torch.zeros(400, 9))
    torch.testing.assert_close(gaussians.opacities, torch.full((400,), 0.1))
    torch.testing.assert_close(gaussians.scales[:, 0], gaussians.scales[:, 2])
    assert torch.equal(gaussians.means, cloud())


def test_far_outliers_are_dropped_and_change_no_spacing():
    inside = cloud()
    far = torch.randn(20, 3, generator=torch.Generator().manual_seed(1)) * 5 + torch.tensor([-139.0, 40.0, 90.0])
    with_far = gaussians_from_points(torch.cat([inside, far]), 2)
    assert torch.equal(with_far.means, inside)
    torch.testing.assert_close(with_far.scales, gaussians_from_points(inside, 2).scales)


def test_duplicates_share_the_spacing_of_their_place():
    points = cloud(50)
    doubled = gaussians_from_points(torch.cat([points, points, points, points, points]), 1)
    single = gaussians_from_points(points, 1)
    torch.testing.assert_close(doubled.scales.view(5, 50, 3)[3], single.scales)


def test_two_points_and_identical_points():
    two = gaussians_from_points(torch.tensor([[0.0, 0, 0], [0, 0, 2]]), 1)
    torch.testing.assert_close(two.scales, torch.full((2, 3), 2.0))
    refused(lambda: gaussians_from_points(torch.ones(5, 3), 1), "points:", "got 5")
    refused(lambda: gaussians_from_points(torch.ones(0, 3), 1), "points:", "got 0")


def test_a_colour_field_shows_its_points_colours():
    from kfgs.splat.sh import evaluate_sh

    colors = torch.randint(0, 256, (400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    colors[0] = torch.tensor([0, 128, 255])
    gaussians = gaussians_from_points(cloud(), colors=colors, sh_degree=2)
    assert list(gaussians.tensors()) == ["means", "quats", "scales", "opacities", "sh"]
    assert gaussians.sh.shape == (400, 9, 3)
    shown = evaluate_sh(gaussians.sh, torch.randn(400, 3, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(shown, colors / 255)
    floats = gaussians_from_points(cloud(), colors=colors / 255, sh_degree=0)
    assert torch.equal(floats.sh, gaussians.sh[:, :1])
    torch.testing.assert_close(gaussians.scales, gaussians_from_points(cloud(), 9).scales)


def test_colours_stay_with_their_points_when_some_are_dropped():
    inside = cloud()
    far = torch.full((5, 3), 500.0) + torch.arange(15.0).view(5, 3)
    points = torch.cat([far, inside])
    colors = ((points - points.min(dim=0).values) / (points.max() - points.min())).clamp(0, 1)
    gaussians = gaussians_from_points(points, colors=colors, sh_degree=0)
    assert torch.equal(gaussians.means, inside)
    torch.testing.assert_close(gaussians.sh[:, 0] * 0.28209479 + 0.5, colors[5:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colors": torch.full((10, 3), 2.0)}, ("colors:", "uint8", "[0, 1]", "divide by 255")),
        ({"colors": torch.full((10, 3), 128)}, ("colors:", "uint8", "[0, 1]", "divide by 255")),
        ({"colors": torch.zeros(9, 3)}, ("colors:", "[P, 3]", "P = 10", "got (9, 3)")),
        ({"colors": None}, ("channels, colors:", "got neither")),
        ({"channels": 3}, ("channels, colors:", "got both")),
        ({"sh_degree": 4}, ("sh_degree:", "[0, 3]", "got 4")),
        ({"initial_opacity": 1.0}, ("initial_opacity:", "(0, 1)", "got 1.0")),
        ({"colors": None, "channels": 0}, ("channels:", "got 0")),
        ({"points": torch.full((10, 3), torch.nan)}, ("points:", "finite", "got others")),
        ({"points": torch.ones(10, 2)}, ("points:", "[P, 3]", "got (10, 2)")),
    ],
)
def test_wrong_arguments(change, message):
    refused(lambda: gaussians_from_points(**({"points": cloud(10), "colors": torch.zeros(10, 3)} | change)), *message)
