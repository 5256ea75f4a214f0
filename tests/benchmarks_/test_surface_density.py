import numpy as np
import torch
from oracles_editing import density
from surface_density import surface_density

from kfgs.gaussians import Gaussians


def _cloud(n: int = 40) -> Gaussians:
    g = torch.Generator().manual_seed(5)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) * torch.tensor([0.5, 0.1, 0.02]) + 0.005,
        opacities=torch.rand(n, generator=g),
    )


def test_it_is_the_sum_of_the_definition():
    cloud = _cloud()
    g = torch.Generator().manual_seed(6)
    near = cloud.means + 0.05 * torch.randn(40, 3, generator=g)
    points = torch.cat([cloud.means, near, torch.randn(20, 3, generator=g)])
    expected = [density(cloud, point) for point in points.double().numpy()]
    assert sum(value > 0.01 for value in expected) >= 60  # most points see something
    np.testing.assert_allclose(surface_density(cloud, points).numpy(), expected, rtol=1e-6, atol=1e-9)


def test_places_far_from_zero_are_counted_from_the_clouds_origin():
    utm = (448262.25, 5411932.5, 200.0)
    near = Gaussians(torch.zeros(1, 3), torch.eye(4)[:1], torch.full((1, 3), 0.1), torch.tensor([0.5]))
    places = torch.tensor([[0.0, 0, 0], [0.1, 0, 0]], dtype=torch.float64)
    world = places + torch.tensor(utm, dtype=torch.float64)
    far = near.replace(origin=utm)
    torch.testing.assert_close(surface_density(far, world), surface_density(near, places))
