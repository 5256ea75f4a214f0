import torch

from kfgs.quant.grow import refine, spherical_kmeans


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def groups(n=30, spread=0.05, seed=0):
    """Features around three orthogonal directions in turn, of unequal lengths."""
    g = generator(seed)
    features = torch.eye(3, 8)[torch.arange(n) % 3] + spread * torch.randn(n, 8, generator=g)
    return features * (0.1 + 10 * torch.rand(n, 1, generator=g))


def test_a_centre_is_the_mean_direction_of_its_features():
    features, weights = groups(), 1 + torch.arange(30) % 2
    centres, (index, _) = spherical_kmeans(features, weights, 3, rounds=50)
    unit = features / features.norm(dim=1, keepdim=True)
    for k in index.unique():
        mine = index == k
        mean = (weights[mine, None] * unit[mine]).sum(0)
        torch.testing.assert_close(centres[k], mean / mean.norm())
    nearest = [max(range(3), key=lambda k: float(row @ centres[k])) for row in unit]
    assert index.tolist() == nearest


def test_one_huge_weight_is_held():
    features = torch.tensor([[1.0, 0.0]]).repeat(1000, 1)
    features[0] = torch.tensor([0.0, 1.0])
    weights = torch.ones(1000)
    weights[0] = 1e9
    assert spherical_kmeans(features, weights, 1)[0][0, 0] > 0.99


def test_features_without_weight_or_length_move_nothing_but_get_a_group():
    features = torch.cat([groups(), torch.zeros(2, 8), -groups(3)])
    weights = torch.cat([torch.ones(32), torch.zeros(3)])
    centres, nearest = spherical_kmeans(features, weights, 3)
    alone, nearest_alone = spherical_kmeans(groups(), torch.ones(30), 3)
    torch.testing.assert_close(centres, alone)
    assert torch.equal(nearest.codeword[:30], nearest_alone.codeword)
    assert nearest.codeword[30:32].tolist() == [0, 0]


def test_a_centre_without_features_stays():
    unit, far = torch.eye(4)[[0, 0, 1]], -torch.eye(4)[:1]
    assert torch.equal(refine(unit, torch.cat([torch.eye(4)[:2], far]), 3)[0][2:], far)
