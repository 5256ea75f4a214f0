import pytest
import torch
from baselines import langsplatv2
from small_task import task


def test_top_4_sum_to_1():
    logits = torch.randn(30, 64, generator=torch.Generator().manual_seed(0))
    weights = langsplatv2.sparse_weights(logits)
    assert torch.equal((weights > 0).sum(1), torch.full((30,), 4))
    assert torch.allclose(weights.sum(1), torch.ones(30))
    best = logits.topk(4).indices
    assert torch.allclose(weights.gather(1, best), logits.gather(1, best).softmax(1), atol=1e-6)


def test_other_logits_get_no_gradient():
    logits = torch.randn(5, 10, generator=torch.Generator().manual_seed(0)).requires_grad_()
    langsplatv2.sparse_weights(logits, 4)[:, :].square().sum().backward()
    chosen = torch.zeros(5, 10, dtype=torch.bool).scatter(1, logits.topk(4).indices, True)
    assert float(logits.grad[~chosen].abs().max()) < 1e-6
    assert float(logits.grad[chosen].abs().max()) > 1e-3


def test_unknown_pixels_count_as_cosine_0():
    found, wanted = torch.tensor([[2.0, 0.0], [1.0, 1.0]]), torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    assert float(langsplatv2.cosine_loss(found, wanted, wanted.any(dim=1))) == pytest.approx(0.5)


def test_storage_counts_5_bytes_for_each_of_4():
    assert langsplatv2.storage_bytes(1_000, 64, 512, levels=3) == 60_000 + 3 * 4 * 64 * 512


def test_fit_lowers_the_loss():
    found = langsplatv2.fit(task(), langsplatv2.LangSplatV2Config(120, 5e-2, 1_000))
    assert found.history[-1]["loss"] < found.history[0]["loss"]
    assert found.tensors["weights"].shape == (12, 4)
    assert int((found.method.gaussians.features > 0).sum(1).max()) <= 4
