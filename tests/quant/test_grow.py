import pytest
import torch

from kfgs._rows import unit_rows
from kfgs.quant.codebook import nearest_rows
from kfgs.quant.grow import grow


def mixture(counts, dim=32, noise=0.05, seed=0):
    """Unit features around orthogonal axes, `counts[c]` of class c, in random order; noise is the residual's length."""
    generator = torch.Generator().manual_seed(seed)
    label = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    label = label[torch.randperm(len(label), generator=generator)]
    rows = torch.eye(dim)[label] + noise * torch.randn(len(label), dim, generator=generator) / dim**0.5
    return unit_rows(rows), label


def run(unit, maximum=64):
    return grow(unit, maximum, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_as_many_codewords_as_there_are_classes_whatever_the_noise(noise):
    unit, label = mixture([400, 300, 500, 350, 450], noise=noise)
    centres, nearest, _ = run(unit)
    assert len(centres) == 5
    name = nearest_rows(torch.eye(32)[:5], centres).codeword
    assert torch.equal(nearest.codeword, name[label])


def test_rare_content_gets_its_codeword():
    unit, label = mixture([4000, 4000, 60], noise=0.3)
    _, nearest, _ = run(unit)
    assert sorted(torch.bincount(nearest.codeword).tolist()) == [60, 4000, 4000]
    assert len(nearest.codeword[label == 2].unique()) == 1


def test_outliers_do_not_lead():
    """Ten features unlike all others, which farthest-point sampling would admit first, get no codeword of their own."""
    unit, _ = mixture([2000, 2000], noise=0.1)
    generator = torch.Generator().manual_seed(1)
    outliers = unit_rows(torch.randn(10, 32, generator=generator))
    centres, _, _ = run(torch.cat([unit, outliers]), maximum=16)  # a cell needs 4010 / 16 / 16 = 16 features
    assert len(centres) == 2
    assert nearest_rows(torch.eye(32)[:2], centres).similarity.min() > 0.999


def test_never_more_than_the_maximum():
    centres, _, rounds = run(mixture([100] * 10)[0], maximum=7)
    assert len(centres) == 7
    assert rounds[-1][:2] == (7, 0)


def test_noise_alone_and_equal_features_are_one_cell():
    generator = torch.Generator().manual_seed(2)
    noise = unit_rows(torch.eye(64)[0] + 0.5 * torch.randn(500, 64, generator=generator) / 8)
    for unit in (noise, torch.eye(8)[:1].expand(50, 8), torch.eye(8)[:1]):
        assert len(run(unit)[0]) == 1
