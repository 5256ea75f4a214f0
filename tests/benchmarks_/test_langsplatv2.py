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


def test_fit_lowers_the_loss():
    found = langsplatv2.fit(task(), langsplatv2.LangSplatV2Config(120, 5e-2, 1_000))
    assert found.history[-1]["loss"] < found.history[0]["loss"]
    assert found.tensors["weights"].shape == (12, 4)
    assert int((found.method.gaussians.features > 0).sum(1).max()) <= 4
