import oracles_quant as oracle
import pytest
import torch

from kfgs.quant import Codebook, PaperCodebook, paper
from kfgs.quant.paper import EvolvingCodebook, class_balanced_loss, farthest_points


def expand(codewords, features, *, threshold=0.9, maximum=100):
    similarity = Codebook(codewords).nearest(features).similarity
    return paper.expand(features, similarity, threshold=threshold, room=maximum - len(codewords))


def prune(codewords, threshold=0.99):
    return paper.prune(codewords, threshold=threshold)


def rows_at(*degrees):
    angles = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    return torch.stack([angles.cos(), angles.sin()], dim=1)


def random_rows(n, dim, seed):
    return torch.randn(n, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_expand_closed_form():
    # Within 25 degrees (cos > 0.9) of a codeword nothing joins. 100 is farthest and joins first; then 60 is 40 from it
    # and 60 from the codeword, and 30 is 30 from both: 60 joins, then 30. 95 is covered by 100 and stays out.
    chosen = expand(rows_at(0), rows_at(20, 60, 100, 95, 30), threshold=0.9, maximum=10)
    assert chosen.tolist() == [2, 1, 4]


@pytest.mark.parametrize("maximum", [3, 5, 9, 1000])
def test_expand_against_loops(maximum):
    codewords, features = random_rows(3, 4, maximum), random_rows(25, 4, maximum + 10)
    features[7] = 0
    chosen = expand(codewords, features, threshold=0.8, maximum=maximum).tolist()
    assert chosen == oracle.expand(codewords.numpy(), features.numpy(), 0.8, maximum)


def test_expand_tie_goes_to_lowest_row():
    assert expand(torch.eye(3)[:1], torch.eye(3)[[2, 1, 2]], maximum=2).tolist() == [0]


def test_prune_drops_the_later_of_a_pair():
    # 0 and 5 degrees are similar (cos 0.996 > 0.99), as are 90 and 94; the released script would drop 0 and 90.
    assert prune(rows_at(0, 90, 5, 94, 45)).tolist() == [0, 1, 4]


def test_prune_of_a_chain_compares_with_what_stays():
    # 0-6 and 6-12 are similar, 0-12 is not: 6 goes, so nothing stands in for 12, which stays.
    assert prune(rows_at(0, 6, 12)).tolist() == [0, 2]


@pytest.mark.parametrize("seed", range(4))
def test_prune_against_loops_and_twice_is_once(seed):
    codewords = random_rows(5, 3, seed)[torch.arange(20) % 5] + 0.1 * random_rows(20, 3, seed + 50)
    stays = prune(codewords, threshold=0.97)
    assert stays.tolist() == oracle.prune(codewords.numpy(), 0.97)
    assert 0 < stays.numel() < 20
    assert prune(codewords[stays], threshold=0.97).tolist() == list(range(stays.numel()))


def run_torch(rows, gradients):
    leaf = rows.clone().requires_grad_()
    optimizer = torch.optim.Adam([leaf], lr=8e-4, eps=1e-9)
    for gradient in gradients:
        leaf.grad = gradient.clone()
        optimizer.step()
    return leaf.detach()


def test_each_row_runs_as_if_it_were_alone():
    """Two codewords take 20 steps, and one that joins late 12: for each it is torch's Adam on its own."""
    gradients, rows = random_rows(60, 5, 0).view(20, 3, 5), 0.1 + torch.arange(15.0).double().view(3, 5) ** 2
    book = EvolvingCodebook(rows[:2], PaperCodebook(initial=1, maximum=3, expand_below=1.0, prune_above=1.0), joins=1)
    for number, gradient in enumerate(gradients):
        if number == 8:
            book.learn_from(rows[2:])
        book.state["gradient"], book.gathered = gradient[: len(book.rows)], 1
        book.step()
    expected = torch.cat([run_torch(rows[:2], gradients[:, :2]), run_torch(rows[2:], gradients[8:, 2:])])
    torch.testing.assert_close(book.rows, expected, rtol=0, atol=1e-12)


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
def test_loss_against_loops(seed):
    features, codewords, index = example(seed)
    expected = oracle.balanced_loss(features.numpy(), codewords.numpy(), index.numpy())
    assert class_balanced_loss(features, codewords, index)[0].item() == pytest.approx(expected, rel=1e-12)


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
