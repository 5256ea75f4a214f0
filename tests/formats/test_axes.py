import pytest
import torch

from kfgs import Gaussians
from kfgs.cameras import Similarity
from kfgs.formats.values import flip_axes
from kfgs.splat import evaluate_sh, transform_gaussians


def _cloud(n: int = 20) -> Gaussians:
    g = torch.Generator().manual_seed(3)
    return Gaussians(
        means=torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.rand(n, 3, generator=g) + 0.1,
        opacities=torch.rand(n, generator=g),
        sh=torch.randn(n, 16, 3, generator=g),
    )


@pytest.mark.parametrize("axes", [(1, -1, -1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1)])
def test_turned_axes_show_the_same_colours(axes):
    cloud = _cloud()
    directions = torch.nn.functional.normalize(cloud.means.roll(1, 0), dim=1)
    turned = flip_axes(cloud, axes)
    assert torch.equal(turned.means, cloud.means * torch.tensor(axes))
    seen = evaluate_sh(turned.sh, directions * torch.tensor(axes, dtype=torch.float32))
    torch.testing.assert_close(seen, evaluate_sh(cloud.sh, directions))
    again = flip_axes(turned, axes)
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(again, name), getattr(cloud, name))


@pytest.mark.parametrize("axes", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_two_axes_turned_are_half_a_turn(axes):
    cloud = _cloud()
    expected = transform_gaussians(cloud, Similarity(1.0, torch.diag(torch.tensor(axes)).double(), torch.zeros(3)))
    turned = flip_axes(cloud, axes)
    torch.testing.assert_close(turned.means, expected.means)
    torch.testing.assert_close(turned.sh, expected.sh, rtol=0, atol=1e-5)
    # S R S has the same ellipsoid as S R: the axes of a Gaussian have no sense
    covariances = [_covariances(g) for g in (turned, expected)]
    torch.testing.assert_close(*covariances)


def test_no_zero_becomes_negative():
    cloud = _cloud().replace(means=torch.zeros(20, 3))
    assert not torch.signbit(flip_axes(cloud, (1, -1, -1)).means).any()


def _covariances(g: Gaussians) -> torch.Tensor:  # [N, 3, 3]
    w, x, y, z = torch.nn.functional.normalize(g.quats, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    R = torch.stack([torch.stack(row, 1) for row in rows], 1)
    return R @ torch.diag_embed(g.scales**2) @ R.transpose(1, 2)
