import pytest
import torch
from baselines import cf3
from small_task import cloud, task

from kfgs.splat import covariance_3d


def test_merge_matches_moments():
    one = cloud(3).replace(features=torch.eye(3))
    weights = torch.tensor([1.0, 5.0, 3.0])
    merged = cf3.merge_pairs(one, weights, torch.tensor([[0, 2]]))
    assert len(merged) == 2
    assert torch.equal(merged.means[0], one.means[1])
    generator = torch.Generator().manual_seed(0)  # the mixture, sampled
    axes = torch.linalg.cholesky(covariance_3d(one.quats, one.scales).double())
    which = torch.where(torch.rand(400_000, generator=generator) < 0.25, 0, 2)
    noise = torch.randn(400_000, 3, 1, generator=generator, dtype=torch.float64)
    samples = one.means.double()[which] + (axes[which] @ noise)[..., 0]
    assert torch.allclose(merged.means[1].double(), samples.mean(0), atol=5e-3)
    covariance = covariance_3d(merged.quats, merged.scales)[1].double()
    assert torch.allclose(covariance, torch.cov(samples.T), atol=5e-3)
    assert torch.allclose(merged.features[1], torch.tensor([0.25, 0.0, 0.75]))
    assert float(merged.opacities[1]) == pytest.approx(float(0.25 * one.opacities[0] + 0.75 * one.opacities[2]))


def test_pairs_need_like_features_and_nearness():
    one = cloud(4)
    means = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [3.0, 0, 0], [3.05, 0, 0]])
    features = torch.tensor([[1.0, 0, 0], [1, 0.01, 0], [1, 0, 0], [0, 1, 0]])
    one = one.replace(means=means, features=features)
    everyone = torch.ones(4, dtype=torch.bool)
    assert cf3.find_pairs(one, 0.9, everyone).tolist() == [[0, 1]]  # 2 and 3 are near, but unlike
    assert cf3.find_pairs(one, 0.9, torch.tensor([True, False, True, True])).tolist() == []
    far = one.replace(means=100 * means)
    assert cf3.find_pairs(far, 0.9, everyone).tolist() == []


def test_fit_has_gaussians_of_its_own():
    found = cf3.fit(task(), cf3.CF3Config(epochs=20, batch=8, rounds=2, steps=10))
    assert found.own_geometry
    assert len(found.method.gaussians) <= 12
    assert found.method.gaussians.features.shape[1] == 3
