"""The largest output of a perceptron, against float64 matrix products."""

from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("numba", reason="the CPU engine needs `pip install numba`")

from kfgs.splat.engines.cpu.perceptron import decide


def network(widths, seed=0, dtype=torch.float32):
    g = torch.Generator().manual_seed(seed)
    return tuple(
        (torch.randn(out, into, generator=g).to(dtype) / into**0.5, 0.3 * torch.randn(out, generator=g).to(dtype))
        for into, out in pairwise(widths)
    )


def outputs(layers, rows):
    x = rows.double().numpy()
    for k, (weight, bias) in enumerate(layers):
        x = (np.maximum(x, 0) if k else x) @ weight.double().numpy().T + bias.double().numpy()
    return x


def expected_lead(values):
    *_, second, best = [-np.inf, *sorted(values)]
    return (best - second) / best if best > 0 else 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 31, 32, 33, 100, 4097])
@pytest.mark.parametrize("widths", [(9, 32, 64, 50), (3, 7), (1, 1, 1), (5, 130, 8, 9)])
def test_winner_and_lead(widths, count, dtype):
    layers = network(widths, dtype=dtype)
    rows = torch.randn(count, widths[0], generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    winners, leads = decide(layers, rows)
    values = outputs(layers, rows)
    expected = np.array([expected_lead(row) for row in values])
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    taken = values[np.arange(count), winners.numpy()]
    scale = np.abs(values).max()
    np.testing.assert_allclose(taken, values.max(axis=1), atol=tolerance * scale)
    finite = np.isfinite(expected)
    wrong = (leads.numpy()[finite] - expected[finite]) * values.max(axis=1)[finite]  # relative to the largest output
    assert np.abs(wrong).max(initial=0) < tolerance * scale
    assert np.isinf(leads.numpy()[~finite]).all()
    assert (leads.numpy()[values.max(axis=1) < -tolerance * scale] == 0).all()


def test_a_tie_goes_to_the_lowest_and_leads_by_nothing():
    weight = torch.tensor([[1.0], [2.0], [2.0], [0.5]])
    winners, leads = decide([(weight, torch.zeros(4))], torch.tensor([[1.0], [3.0]]))
    assert winners.tolist() == [1, 1]
    assert leads.tolist() == [0, 0]


def test_no_rows_and_units_that_are_all_idle():
    layers = (torch.ones(8, 2), -torch.full((8,), 100.0)), (torch.ones(3, 8), torch.tensor([1.0, 3.0, 2.0]))
    winners, leads = decide(layers, torch.zeros(0, 2))
    assert (winners.shape, leads.shape) == ((0,), (0,))
    winners, leads = decide(layers, torch.rand(40, 2))
    assert winners.tolist() == [1] * 40
    torch.testing.assert_close(leads, torch.full((40,), 1 / 3))


def test_threads_change_nothing():
    layers, rows = network((9, 32, 64, 50)), torch.rand(10_000, 9, generator=torch.Generator().manual_seed(2))
    threads = torch.get_num_threads()
    try:
        found = []
        for number in (1, 2):
            torch.set_num_threads(number)
            found.append(decide(layers, rows))
    finally:
        torch.set_num_threads(threads)
    assert found[0][0].equal(found[1][0])
    assert found[0][1].equal(found[1][1])
