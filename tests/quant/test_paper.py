import oracles_quant as oracle
import pytest
import torch

from kfgs.quant import Codebook, PaperCodebook, paper
from kfgs.quant.paper import EvolvingCodebook, class_balanced_loss, farthest_points, prune


def expand(codewords, features, **options):
    similarity = Codebook(codewords).nearest(features).similarity
    return EvolvingCodebook(codewords, PaperCodebook(initial=1, **options)).expand(features, similarity).tolist()


def rows_at(*degrees):
    angles = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    return torch.stack([angles.cos(), angles.sin()], dim=1)


def test_expand_closed_form():
    # Within 25 degrees (cos > 0.9) of the codeword nothing joins: all but 20 do, the least similar first.
    features = rows_at(20, 60, 100, 95, 30)
    assert expand(rows_at(0), features) == [2, 3, 1, 4]
    assert expand(rows_at(0), features, maximum=3) == [2, 3]
    # With similarities updated, 60 is 40 from 100 and 60 from the codeword, and 30 is 30 from both; 95 is covered by 100.
    assert expand(rows_at(0), features, joins_per_image=9) == [2, 1, 4]
    assert expand(rows_at(0), features, joins_per_image=2) == [2, 1]


@pytest.mark.parametrize("joins", [None, 1])
def test_expand_tie_goes_to_lowest_row(joins):
    assert expand(torch.eye(3)[:1], torch.eye(3)[[2, 1, 2]], maximum=2, joins_per_image=joins) == [0]


def test_prune_drops_the_later_of_a_pair_and_leaves_the_first_of_a_chain():
    # 0 and 5 degrees are similar (cos 0.996 > 0.99), as are 90 and 94; the released script would drop 0 and 90.
    assert prune(rows_at(0, 90, 5, 94, 45), threshold=0.99).tolist() == [0, 1, 4]
    # 0-6 and 6-12 are similar, 0-12 is not: Eq. 9 holds for e = 6, g = 12, whether 6 goes or not.
    assert prune(rows_at(0, 6, 12), threshold=0.99).tolist() == [0]


def example(seed=0, n=30, K=6, dim=5):
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(n, dim, generator=generator, dtype=torch.float64)
    codewords = 3 * torch.randn(K, dim, generator=generator, dtype=torch.float64)
    index = torch.randint(0, K - 1, (n,), generator=generator)  # the last codeword has no features
    return features, codewords, index


def test_closed_form_of_two_unequal_classes():
    features = torch.tensor([[2.0, 0.0], [0.0, 5.0], [1.0, 0.0], [0.0, -1.0]])
    codewords = torch.tensor([[1.0, 0.0], [0.0, 4.0], [7.0, 7.0]])
    loss, _ = class_balanced_loss(features, codewords, torch.tensor([0, 0, 0, 1]))
    # class 0: (0 + 1 + 0) / 3; class 1: 2; class 2 is absent, so T = 2
    assert loss.item() == pytest.approx((1 / 3 + 2) / 2)


@pytest.mark.parametrize("seed", range(3))
def test_gradient_against_autograd(seed):
    features, codewords, index = example(seed)
    leaf = codewords.clone().requires_grad_()
    distance = 1 - torch.nn.functional.cosine_similarity(features, leaf[index], dim=1)
    classes = index.unique()
    torch.stack([distance[index == tau].mean() for tau in classes]).mean().backward()
    torch.testing.assert_close(class_balanced_loss(features, codewords, index)[1], leaf.grad)


def test_farthest_points_closed_form():
    angles = torch.tensor([0.0, 10.0, 170.0, 90.0, 20.0]).deg2rad()
    points = torch.stack([angles.cos(), angles.sin()], dim=1) * torch.tensor([[1.0], [9.0], [2.0], [0.1], [5.0]])
    # 0 and 170 degrees are the least similar pair; then 90 (80 away from both sides), then 20.
    assert farthest_points(points, 4).tolist() == [0, 2, 3, 4]


@pytest.mark.parametrize("block", [1, 5, 64])
def test_farthest_points_against_loops(block, monkeypatch):
    monkeypatch.setattr(paper, "BLOCK", block)
    features = torch.randn(17, 4, generator=torch.Generator().manual_seed(block), dtype=torch.float64)
    assert farthest_points(features, 6).tolist() == oracle.farthest_points(features.numpy(), 6)


def test_first_pair_tie_goes_to_lowest_rows_and_equal_rows_are_picked_once_each():
    axes = torch.eye(3)[[0, 1, 2, 0]]  # all pairs but (0, 3) are equally dissimilar
    assert farthest_points(axes, 4).tolist() == [0, 1, 2, 3]
