import math

import cases_clouds
import numpy as np
import oracles_merge
import pytest
import torch

from kfgs.cameras import Camera
from kfgs.fields import merge
from kfgs.fields.merge import merge_gaussians
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize
from kfgs.splat.covariance import covariance_3d


@pytest.fixture(autouse=True)
def nothing_is_faint(monkeypatch):
    """So that each Gaussian can be followed."""
    monkeypatch.setattr(merge, "FAINT", 0.0)


@pytest.fixture
def one_kind(monkeypatch):
    monkeypatch.setattr(merge, "CLUSTERS", 1)


def random_cloud(n=300, channels=5, kinds=4, seed=0):
    """Gaussians in a box, with features around a few directions."""
    g = torch.Generator().manual_seed(seed)
    features = torch.eye(kinds, channels)[torch.randint(kinds, (n,), generator=g)]
    cloud = Gaussians(
        means=torch.rand(n, 3, generator=g) * torch.tensor([4.0, 2.0, 3.0]) - 1,
        quats=torch.randn(n, 4, generator=g),
        scales=0.01 + 0.2 * torch.rand(n, 3, generator=g),
        opacities=0.1 + 0.8 * torch.rand(n, generator=g),
        features=features + 0.05 * torch.randn(n, channels, generator=g),
    )
    return cloud, 0.6 + 5 * torch.rand(n, generator=g)


def balls(means, features, scale=0.1, opacity=0.3):
    features = torch.as_tensor(features, dtype=torch.float32)
    return cases_clouds.balls(means, scale=scale, opacity=opacity, features=features)


def covariances(cloud):
    return covariance_3d(cloud.quats, cloud.scales)


def test_two_equal_balls_become_their_mixture(one_kind):
    """Two balls of deviation s at -a and +a along x: variances s^2 + a^2, s^2, s^2. The opacity keeps 2 o s^2 = o' s A."""
    a, s, o = 0.05, 0.1, 0.3
    cloud = balls([[1 - a, 2, 3], [1 + a, 2, 3]], [[1, 0], [0.8, 0.6]], s, o)
    merged = merge_gaussians(cloud, torch.tensor([2.0, 2.0]), 1)
    assert merged.group.tolist() == [0, 0]
    assert merged.pool(torch.tensor([2.0, 2.0])).tolist() == [4.0]
    found = merged.gaussians
    torch.testing.assert_close(found.means, torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(covariances(found)[0], torch.diag(torch.tensor([s * s + a * a, s * s, s * s])))
    torch.testing.assert_close(found.scales[0].sort().values, torch.tensor([s, s, math.hypot(s, a)]))
    assert found.opacities.item() == pytest.approx(2 * o * s * s / (s * math.hypot(s, a)), rel=1e-5)
    torch.testing.assert_close(found.features, torch.tensor([[0.9, 0.3]]))
    assert torch.linalg.vector_norm(found.quats).item() == pytest.approx(1, abs=1e-5)


def test_merged_balls_smaller_than_a_pixel_are_antialiased_and_cover_as_much(one_kind):
    """The opacity that keeps o A keeps the light on the screen, too: compensated, a Gaussian covers 2 pi o sqrt(det S)."""
    cloud = balls([[0.0, 0, 4], [0.002, 0, 4], [0, 0.003, 4]], [[1.0, 0]] * 3, 0.005, 0.5).replace(antialiased=True)
    merged = merge_gaussians(cloud, torch.ones(3), 1).gaussians
    camera = Camera(torch.eye(4), torch.tensor([[60.0, 0, 8.2], [0, 60, 7.9], [0, 0, 1]]), 16, 16)  # 0.08 pixels wide
    before = sum(float(rasterize(one, camera, engine="reference").alpha.sum()) for one in cloud)
    after = float(rasterize(merged, camera, engine="reference").alpha.sum())
    assert merged.antialiased
    assert after == pytest.approx(before, rel=0.05)  # alpha below 1/255 is not drawn


@pytest.mark.parametrize("seed", range(3))
def test_every_group_is_the_mixture_of_its_members(seed):
    cloud, weights = random_cloud(seed=seed)
    merged = merge_gaussians(cloud, weights, 60)
    assert 30 < len(merged.gaussians) <= 60
    parts = [
        x.double().numpy() for x in (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.features, weights)
    ]
    spreads = covariances(merged.gaussians).double().numpy()
    for k in range(len(merged.gaussians)):
        members = [i for i, group in enumerate(merged.group.tolist()) if group == k]
        mean, spread, opacity, feature = oracles_merge.merged(*parts, members)
        np.testing.assert_allclose(merged.gaussians.means[k].numpy(), mean, atol=2e-6)
        np.testing.assert_allclose(spreads[k], spread, atol=2e-6)
        np.testing.assert_allclose(merged.gaussians.features[k].numpy(), feature, atol=2e-6)
        assert merged.gaussians.opacities[k].item() == pytest.approx(opacity, rel=2e-5)


def test_what_is_few_enough_stays_as_it_is():
    cloud, weights = random_cloud(20)
    cloud = cloud.replace(sh=torch.zeros(20, 1, 3), labels=torch.zeros(20, dtype=torch.int64))
    merged = merge_gaussians(cloud, weights, 20)
    assert merged.group.tolist() == list(range(20))
    assert torch.equal(merged.pool(weights), weights)
    for name in ("means", "quats", "scales", "opacities", "features"):
        assert torch.equal(getattr(merged.gaussians, name), getattr(cloud, name))
    assert merged.gaussians.sh is None  # its colours and labels were of another cloud
    assert merged.gaussians.labels is None


@pytest.mark.parametrize(("share", "maximum", "dropped"), [(0.1, 9, [1, 4]), (0.0, 9, []), (0.9, 10, [])])
def test_the_faintest_are_dropped_as_far_as_their_share_goes(monkeypatch, share, maximum, dropped):
    """Weights 1 to 10 add up to 55: a tenth of it holds 1 and 2, but not 3 as well. Of 10, none is too many."""
    monkeypatch.setattr(merge, "FAINT", share)
    cloud, _ = random_cloud(10)
    group = merge_gaussians(cloud, torch.tensor([4.0, 2, 10, 6, 1, 8, 3, 9, 7, 5]), maximum).group
    assert (group < 0).nonzero()[:, 0].tolist() == dropped


PLACES = {
    "anywhere": lambda n, g: torch.rand(n, 3, generator=g),
    "all in one place": lambda n, g: torch.full((n, 3), 7.0),
    "in five places": lambda n, g: torch.randn(5, 3, generator=g)[torch.arange(n) % 5],
    "on a line": lambda n, g: torch.linspace(0, 1, n)[:, None] * torch.tensor([1.0, 0, 0]),
    "with outliers": lambda n, g: torch.cat([torch.tensor([[1e6] * 3, [-1e6] * 3]), torch.rand(n - 2, 3, generator=g)]),
    "far from the origin": lambda n, g: 1e4 + torch.rand(n, 3, generator=g),
}


@pytest.mark.parametrize("places", PLACES)
@pytest.mark.parametrize("maximum", [1, 3, 40, 199])
def test_at_most_maximum_are_left_and_no_weight_is_lost(places, maximum):
    """Each Gaussian has a feature of its own, so that there are 64 kinds in one place."""
    n, g = 200, torch.Generator().manual_seed(0)
    cloud, weights = random_cloud(n)
    cloud = cloud.replace(means=PLACES[places](n, g), features=torch.randn(n, 30, generator=g))
    merged = merge_gaussians(cloud, weights, maximum)
    assert 1 <= len(merged.gaussians) <= maximum
    assert (merged.group >= 0).all()
    sums = merged.pool(weights)
    torch.testing.assert_close(sums.sum(), weights.sum())
    assert (sums > 0).all()  # `group` is a map onto 0 ... M - 1
    for name in ("means", "quats", "scales", "opacities", "features"):
        assert torch.isfinite(getattr(merged.gaussians, name)).all(), name
    assert (merged.gaussians.scales > 0).all()


def test_what_lies_apart_stays_apart_in_a_grid_of_more_cubes_than_numbers():
    """40 would be allowed, so the search ends at its finest edge, with 2^23 cubes along y and z. The number of a cube in a
    single int64, (x * 2^23 + y) * 2^23 + z, would be the same for x = 0 and x = 2^18."""
    edge = 1.001 / 2**24
    far = (2**23 - 0.5) * edge
    near = (2**18 + 0.5) * edge
    places = torch.tensor([[0, 0, 0], [near, 0, 0], [1, 0, 0], [0, far, 0], [0, 0, far]], dtype=torch.float64)
    cloud = balls(torch.zeros(200, 3), torch.ones(200, 2)).to(torch.float64)
    cloud = cloud.replace(means=places[torch.arange(200) % 5])
    merged = merge_gaussians(cloud, torch.ones(200).double(), 40)
    assert len(merged.gaussians) == 5
    torch.testing.assert_close(merged.gaussians.means[merged.group], cloud.means)


def test_kinds_that_are_not_small_are_never_merged():
    """Two kinds of equal weight in each of four places."""
    places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    cloud = balls(places.repeat(6, 1), torch.eye(2)[torch.arange(24) // 4 % 2])
    merged = merge_gaussians(cloud, torch.ones(24), 8)
    assert len(merged.gaussians) == 8
    torch.testing.assert_close(merged.gaussians.features[merged.group], cloud.features)
    torch.testing.assert_close(merged.gaussians.means[merged.group], cloud.means)


@pytest.mark.parametrize(("light", "groups"), [(0.9, 1), (1.1, 2)])
def test_a_fragment_joins_the_heaviest_kind_of_its_cube(light, groups):
    """A kind with less than a quarter of the cube's weight is a fragment: 0.9 of 3.9, but not 1.1 of 4.1."""
    cloud = balls([[0, 0, 0]] * 4, [[1, 0], [1, 0], [1, 0], [0, 1]])
    weights = torch.tensor([1.0, 1.0, 1.0, light])
    merged = merge_gaussians(cloud, weights, 3)
    assert len(merged.gaussians) == groups
    expected = (3 * torch.tensor([1.0, 0]) + light * torch.tensor([0.0, 1])) / (3 + light)
    if groups == 1:
        torch.testing.assert_close(merged.gaussians.features[0], expected)
