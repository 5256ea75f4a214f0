import pytest
import torch
from cases_gltf import random_cloud
from scipy.spatial.transform import Rotation

from kfgs import Gaussians
from kfgs.cameras import Similarity
from kfgs.formats.values import flip_axes
from kfgs.splat import transform_gaussians
from kfgs.splat.sh import evaluate_sh


@pytest.mark.parametrize("axes", [(1, -1, -1), (-1, 1, 1), (1, 1, -1), (-1, -1, -1)])
def test_turned_axes_show_the_same_colours(axes):
    cloud = random_cloud(20)
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
    cloud = random_cloud(20)
    expected = transform_gaussians(cloud, Similarity(1.0, torch.diag(torch.tensor(axes)).double(), torch.zeros(3)))
    turned = flip_axes(cloud, axes)
    torch.testing.assert_close(turned.means, expected.means)
    torch.testing.assert_close(turned.sh, expected.sh, rtol=0, atol=1e-5)
    # S R S has the same ellipsoid as S R: the axes of a Gaussian have no sense
    covariances = [_covariances(g) for g in (turned, expected)]
    torch.testing.assert_close(*covariances)


def test_no_zero_becomes_negative():
    cloud = random_cloud(20).replace(means=torch.zeros(20, 3))
    assert not torch.signbit(flip_axes(cloud, (1, -1, -1)).means).any()


def _covariances(g: Gaussians) -> torch.Tensor:  # [N, 3, 3]
    R = torch.from_numpy(Rotation.from_quat(g.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()).float()
    return R @ torch.diag_embed(g.scales**2) @ R.transpose(1, 2)
