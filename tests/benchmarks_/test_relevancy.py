import numpy as np
import oracles_protocols as dull
import pytest
import torch
from published.relevancy import (
    box_mean,
    lerf_relevancy,
    majority,
    pool_majority,
    pool_mean,
    stretch,
)

SIZES = [(40, 33), (9, 12), (31, 1), (1, 1)]


def test_relevancy_against_the_pairwise_softmax():
    rng = np.random.default_rng(0)
    positive, negatives = rng.uniform(-1, 1, (5, 4, 3)), rng.uniform(-1, 1, (5, 4, 6))
    found = lerf_relevancy(torch.from_numpy(positive), torch.from_numpy(negatives), 7.0)
    for i in np.ndindex(5, 4, 3):
        assert float(found[i]) == pytest.approx(dull.relevancy(positive[i], negatives[i[:2]], 7.0), abs=1e-12)


def test_box_offsets_by_hand():
    impulse = torch.zeros(100, 100)
    impulse[40, 50] = 900
    want = torch.zeros(100, 100)
    want[26:56, 36:66] = 1
    torch.testing.assert_close(box_mean(impulse), want)


@pytest.mark.parametrize("size", SIZES)
def test_filters_against_loops(size):
    rng = np.random.default_rng(1)
    image = rng.uniform(size=size)
    maps = torch.from_numpy(np.stack([image, 2 * image]))
    for found, want in ((box_mean(maps), dull.box_mean(image)), (pool_mean(maps), dull.pool_mean(image))):
        np.testing.assert_allclose(found[0], want, atol=1e-12)
        np.testing.assert_allclose(found[1], 2 * want, atol=1e-12)
    for share in (0.3, 0.5, 0.7):
        mask = rng.uniform(size=size) < share
        both = torch.from_numpy(np.stack([mask, ~mask]))
        for skip_last in (True, False):
            assert np.array_equal(majority(both, skip_last=skip_last)[0], dull.majority(mask, skip_last=skip_last))
            assert np.array_equal(majority(both, skip_last=skip_last)[1], dull.majority(~mask, skip_last=skip_last))
        assert np.array_equal(pool_majority(both)[0], dull.pool_majority(mask))


def test_majority_never_looks_at_the_last_row_and_column():
    assert majority(torch.ones(10, 10, dtype=torch.bool)).all()
    edge = torch.zeros(10, 10, dtype=torch.bool)
    edge[-1], edge[:, -1] = True, True
    assert not majority(edge).any()
    assert majority(edge, 3, skip_last=False).any()  # the corner's window: 3 of 4


def test_stretch_against_loops():
    values = np.random.default_rng(2).uniform(size=(3, 5, 4))
    found = stretch(torch.from_numpy(values))
    for i in range(3):
        np.testing.assert_allclose(found[i], dull.stretch(values[i]), atol=1e-12)
    assert stretch(torch.ones(4, 4)).eq(0).all()
