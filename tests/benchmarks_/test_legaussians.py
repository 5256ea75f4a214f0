from math import log

import pytest
import torch
from baselines import legaussians
from baselines.legaussians import LEGaussiansConfig
from small_task import MIB, task


def test_decoder_has_the_published_number_of_weights():
    assert legaussians.CodeDecoder(torch.zeros(128, 896)).parameters_stored == 67_072


def test_storage_is_the_published_one():
    assert round(legaussians.storage_bytes(571_000, 128, 896, 67_072) / MIB, 1) == 18.1


def test_quantiser_loss_against_numbers():
    rows, codes = torch.tensor([[2.0, 0.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0], [0.6, 0.8]])
    # cosines [[1, .6], [0, .8]]: chosen 0 and 1, shares 1/2 each; softmax columns sum to 1, so the load is 1/2
    found = legaussians.quantiser_loss(rows, codes)
    assert float(found) == pytest.approx(1 - 0.9 + 0.5)


def test_index_loss_against_numbers():
    logits = torch.zeros(1, 3, 4)
    index, doubt = torch.tensor([[0, 1, -1]]), torch.tensor([[0.0, 0.5, 0.0]])
    assert float(legaussians.index_loss(logits, index, doubt)) == pytest.approx((1 + 0.5) * log(4) / 3)


def test_smoothing_loss_against_numbers():
    predicted = torch.ones(2, 8, requires_grad=True)
    own, doubt = torch.zeros(2, 8, requires_grad=True), torch.tensor([1.0, 0.0], requires_grad=True)
    loss = legaussians.smoothing_loss(predicted, own, doubt)
    assert float(loss.detach()) == pytest.approx(1 + (1 + 0.1) / 2)
    loss.backward()
    assert doubt.grad is None
    assert torch.allclose(own.grad[0], 10 * own.grad[1])
    assert torch.allclose(predicted.grad, torch.full((2, 8), 2 / 16))  # of its own term alone


def test_query_mixes_codes_by_their_lengths():
    codes = torch.tensor([[2.0, 0.0], [0.0, 1.0]])
    decoder = legaussians.CodeDecoder(codes)
    latents, text = torch.randn(3, 8), torch.eye(2)
    share = decoder.logits(latents).softmax(1)
    assert torch.allclose(decoder.features(latents), share @ codes)
    assert torch.allclose(decoder.scores(latents, text), share @ codes, atol=1e-6)
    assert torch.allclose(decoder.logits(5 * latents), decoder.logits(latents), atol=1e-5)  # of the direction


def test_fit_learns_the_indices():
    config = LEGaussiansConfig(codes=4, epochs=150, code_rate=1e-2, steps=150, feature_rate=2e-2, network_rate=1e-2)
    found = legaussians.fit(task(), config)
    assert found.history[-1]["loss"] < 0.9 * found.history[0]["loss"]
    assert found.dim == "8"
