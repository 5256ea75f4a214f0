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


def test_fit_learns_the_indices():
    config = LEGaussiansConfig(codes=4, epochs=150, code_rate=1e-2, steps=150, feature_rate=2e-2, network_rate=1e-2)
    found = legaussians.fit(task(), config)
    assert found.history[-1]["loss"] < 0.9 * found.history[0]["loss"]
    assert found.dim == "8"
