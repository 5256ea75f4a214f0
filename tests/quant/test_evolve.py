import oracles_quant as oracle
import pytest
import torch
from messages import tells

from kfgs.quant import expand, prune
from kfgs.quant.evolve import RowAdam


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


def test_near_duplicates_do_not_fill_the_book():
    assert expand(rows_at(0), rows_at(90, 90.1, 90.2, 89.9), threshold=0.9, maximum=10).tolist() == [2]


@pytest.mark.parametrize("seed", range(4))
def test_expand_against_loops(seed):
    codewords, features = random_rows(3, 4, seed), random_rows(25, 4, seed + 10)
    features[7] = 0
    chosen = expand(codewords, features, threshold=0.8, maximum=9).tolist()
    assert chosen == oracle.expand(codewords.numpy(), features.numpy(), 0.8, 9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("maximum", [3, 5, 8, 1000])
def test_expand_never_passes_the_maximum_and_admits_only_below_alpha(seed, maximum):
    book, features = random_rows(3, 5, seed), random_rows(60, 5, seed + 10)
    chosen = expand(book, features, threshold=0.7, maximum=maximum)
    assert book.shape[0] + chosen.numel() <= maximum
    for i in chosen.tolist():
        assert max(oracle.cosine(features[i].numpy(), c) for c in book.numpy()) < 0.7
        book = torch.cat([book, features[i : i + 1]])
    if book.shape[0] < maximum:  # then it stopped because all are represented
        assert expand(book, features, threshold=0.7, maximum=maximum).numel() == 0
        assert all(max(oracle.cosine(f, c) for c in book.numpy()) >= 0.7 for f in features.numpy())


def test_a_book_over_the_maximum_takes_nothing():
    assert expand(torch.eye(3), -torch.eye(3), maximum=2).numel() == 0


def test_similarity_at_the_threshold_is_enough():
    assert expand(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]]), threshold=0.0).numel() == 0


def test_expand_tie_goes_to_lowest_row():
    assert expand(torch.eye(3)[:1], torch.eye(3)[[2, 1, 2]], maximum=2).tolist() == [0]


def test_zero_features_never_join():
    assert expand(torch.eye(2)[:1], torch.zeros(3, 2)).numel() == 0


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


def test_one_codeword_stays():
    assert prune(torch.ones(1, 3)).tolist() == [0]
    assert prune(torch.ones(4, 3)).tolist() == [0]


def test_bad_input():
    with pytest.raises(ValueError, match=tells("features:", "[n, D]", "D = 2", "got (4, 3)")):
        expand(torch.ones(1, 2), torch.ones(4, 3))
    with pytest.raises(ValueError, match=tells("threshold:", "[-1, 1]", "got 90")):
        expand(torch.ones(1, 2), torch.ones(4, 2), threshold=90)
    with pytest.raises(ValueError, match=tells("threshold:", "[-1, 1]", "got nan")):
        prune(torch.ones(1, 2), threshold=float("nan"))
    with pytest.raises(ValueError, match=tells("codewords:", "[K, D]", "got (2,)")):
        prune(torch.ones(2))


def gradients(steps, K, dim):
    return torch.randn(steps, K, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def run_torch(rows, gradients):
    leaf = rows.clone().requires_grad_()
    optimizer = torch.optim.Adam([leaf], lr=8e-4, eps=1e-9)
    for gradient in gradients:
        leaf.grad = gradient.clone()
        optimizer.step()
    return leaf.detach()


def test_agrees_with_torch_when_rows_stay():
    rows = torch.ones(3, 4, dtype=torch.float64)
    adam = RowAdam(rows, learning_rate=8e-4, eps=1e-9)
    for gradient in gradients(20, 3, 4):
        adam.step(gradient)
    torch.testing.assert_close(adam.rows, run_torch(rows, gradients(20, 3, 4)), rtol=0, atol=1e-12)
    assert rows.eq(1).all()


def test_each_row_runs_as_if_it_were_alone():
    """Rows 0 and 2 stay for 20 steps, row 1 leaves after 8 and a new row joins: each is torch's Adam on its own."""
    steps = gradients(20, 4, 5)
    rows = torch.arange(20, dtype=torch.float64).reshape(4, 5)
    adam = RowAdam(rows[:3], learning_rate=8e-4, eps=1e-9)
    for gradient in steps[:8]:
        adam.step(gradient[:3])
    adam.keep(torch.tensor([0, 2]))
    adam.append(rows[3:])
    for gradient in steps[8:]:
        adam.step(gradient[[0, 2, 3]])
    expected = torch.cat(
        [run_torch(rows[[0, 2]], steps[:, [0, 2]]), run_torch(rows[3:], steps[8:, 3:])],
    )
    torch.testing.assert_close(adam.rows, expected, rtol=0, atol=1e-12)
