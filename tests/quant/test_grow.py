import pytest
import torch

from kfgs._rows import unit_rows
from kfgs.quant.grow import grow
from kfgs.quant.kmeans import nearest_cells


def mixture(counts, dim=32, noise=0.05, seed=0):
    """Unit features around orthogonal axes, `counts[c]` of class c, in random order; noise is the residual's length."""
    generator = torch.Generator().manual_seed(seed)
    label = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    label = label[torch.randperm(len(label), generator=generator)]
    rows = torch.eye(dim)[label] + noise * torch.randn(len(label), dim, generator=generator) / dim**0.5
    return unit_rows(rows), label


def run(unit, maximum=64, seed=0, **options):
    return grow(unit, maximum, generator=torch.Generator().manual_seed(seed), **options)


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_as_many_codewords_as_there_are_classes_whatever_the_noise(noise):
    unit, label = mixture([400, 300, 500, 350, 450], noise=noise)
    grown = run(unit)
    assert len(grown.cells.centres) == 5
    assert not grown.full
    name = nearest_cells(torch.eye(32)[:5], grown.cells.centres).index
    assert torch.equal(grown.cells.index, name[label])


def test_rare_content_gets_its_codeword():
    unit, label = mixture([4000, 4000, 60], noise=0.3)
    grown = run(unit)
    assert sorted(torch.bincount(grown.cells.index).tolist()) == [60, 4000, 4000]
    assert len(grown.cells.index[label == 2].unique()) == 1


def test_outliers_do_not_lead():
    """Ten features unlike all others, which farthest-point sampling would admit first, get no codeword of their own."""
    unit, _ = mixture([2000, 2000], noise=0.1)
    generator = torch.Generator().manual_seed(1)
    outliers = unit_rows(torch.randn(10, 32, generator=generator))
    grown = run(torch.cat([unit, outliers]), maximum=16)  # a cell needs 4010 / 16 / 16 = 16 features
    assert len(grown.cells.centres) == 2
    assert nearest_cells(torch.eye(32)[:2], grown.cells.centres).similarity.min() > 0.999


def test_never_more_than_the_maximum_and_full_says_that_more_would_pay():
    unit, _ = mixture([100] * 10)
    grown = run(unit, maximum=7)
    assert (len(grown.cells.centres), grown.full) == (7, True)
    assert grown.rounds[-1][:2] == (7, 0)
    assert not run(unit, maximum=10).full


def test_alpha_stops_growth_once_the_features_reach_it():
    unit, _ = mixture([300] * 8, noise=0.05)
    assert len(run(unit, alpha=0.9).cells.centres) == 8
    assert len(run(unit, alpha=0.1).cells.centres) == 1  # the mean of 8 axes is 0.35 similar to each


def test_noise_alone_and_equal_features_are_one_cell():
    generator = torch.Generator().manual_seed(2)
    noise = unit_rows(torch.eye(64)[0] + 0.5 * torch.randn(500, 64, generator=generator) / 8)
    assert len(run(noise).cells.centres) == 1
    assert len(run(torch.eye(8)[:1].expand(50, 8)).cells.centres) == 1
    assert len(run(torch.eye(8)[:1]).cells.centres) == 1
