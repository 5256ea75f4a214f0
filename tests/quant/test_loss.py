import oracles_quant as oracle
import pytest
import torch
from messages import tells

from kfgs.quant import class_balanced_loss


def example(seed=0, n=30, K=6, dim=5):
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(n, dim, generator=generator, dtype=torch.float64)
    codewords = 3 * torch.randn(K, dim, generator=generator, dtype=torch.float64)
    index = torch.randint(0, K - 1, (n,), generator=generator)  # the last codeword has no features
    return features, codewords, index


def test_closed_form_of_two_unequal_classes():
    features = torch.tensor([[2.0, 0.0], [0.0, 5.0], [1.0, 0.0], [0.0, -1.0]])
    codewords = torch.tensor([[1.0, 0.0], [0.0, 4.0], [7.0, 7.0]])
    balanced = class_balanced_loss(features, codewords, torch.tensor([0, 0, 0, 1]))
    # class 0: (0 + 1 + 0) / 3; class 1: 2; class 2 is absent, so T = 2
    assert balanced.loss.item() == pytest.approx((1 / 3 + 2) / 2)
    assert balanced.counts.tolist() == [3, 1, 0]


@pytest.mark.parametrize("seed", range(3))
def test_loss_against_loops(seed):
    features, codewords, index = example(seed)
    expected = oracle.balanced_loss(features.numpy(), codewords.numpy(), index.numpy())
    assert class_balanced_loss(features, codewords, index).loss.item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_gradient_against_autograd(seed):
    features, codewords, index = example(seed)
    leaf = codewords.clone().requires_grad_()
    distance = 1 - torch.nn.functional.cosine_similarity(features, leaf[index], dim=1)
    classes = index.unique()
    torch.stack([distance[index == tau].mean() for tau in classes]).mean().backward()
    torch.testing.assert_close(class_balanced_loss(features, codewords, index).gradient, leaf.grad)


def test_repeating_a_class_changes_nothing():
    features, codewords, index = example()
    more = torch.cat([features, features[index == 2]]), torch.cat([index, index[index == 2]])
    once, twice = class_balanced_loss(features, codewords, index), class_balanced_loss(more[0], codewords, more[1])
    torch.testing.assert_close(twice.loss, once.loss)
    torch.testing.assert_close(twice.gradient, once.gradient)


def test_the_gradient_is_orthogonal_to_each_codeword():
    features, codewords, index = example()
    inner = (class_balanced_loss(features, codewords, index).gradient * codewords).sum(dim=1)
    torch.testing.assert_close(inner, torch.zeros(6, dtype=torch.float64))


def test_no_features_no_loss():
    balanced = class_balanced_loss(torch.zeros(0, 3), torch.ones(2, 3), torch.zeros(0, dtype=torch.int64))
    assert balanced.loss.item() == 0
    assert balanced.gradient.eq(0).all()


def test_bad_shapes():
    with pytest.raises(ValueError, match=tells("codewords:", "[K, D]", "D = 3", "got (2, 4)")):
        class_balanced_loss(torch.ones(5, 3), torch.ones(2, 4), torch.zeros(5, dtype=torch.int64))
    with pytest.raises(ValueError, match=tells("index:", "[n]", "n = 5", "got (4,)")):
        class_balanced_loss(torch.ones(5, 3), torch.ones(2, 3), torch.zeros(4, dtype=torch.int64))
