import pytest
import torch
from baselines import langsplat
from baselines.langsplat import LangSplatConfig
from small_task import MIB, task


def test_decoder_has_the_published_number_of_weights():
    assert langsplat.Autoencoder(512).decoder_parameters == 241_440


def test_storage_is_the_published_one():
    assert langsplat.storage_bytes(572_200, 241_440) / MIB == pytest.approx(20.7, rel=0.01)


def test_autoencoder_loss_against_numbers():
    out, wanted = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    # MSE = 2 / 4; cosines of rows 1 and 0; of columns (1,0).(1,1) = 1/sqrt 2 and (0,1).(0,0) = 0
    rows = langsplat.autoencoder_loss(out, wanted, over_batch=False)
    columns = langsplat.autoencoder_loss(out, wanted, over_batch=True)
    assert float(rows) == pytest.approx(0.5 + 1e-3 * 0.5)
    assert float(columns) == pytest.approx(0.5 + 1e-3 * (1 - 0.5 * 2**-0.5))
    assert LangSplatConfig.published().cosine_over_batch


def test_latents_are_normalised_before_splatting():
    model = langsplat.Latents(50, LangSplatConfig(), torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.raw *= torch.linspace(0.1, 1e4, 50)[:, None]
        model.raw[7] = 0
        lengths = model.splatted().norm(dim=1)
    assert float(lengths[7]) == 0
    assert torch.allclose(lengths[torch.arange(50) != 7], torch.ones(49), atol=1e-5)


def test_loss_is_a_mean_over_masked_pixels_too():
    model = langsplat.Latents(2, LangSplatConfig(), torch.Generator())
    rendered, target = torch.zeros(2, 2, 3, requires_grad=True), torch.full((2, 2, 3), torch.nan)
    target[0, 0] = torch.tensor([0.5, -0.5, 1.0])
    loss = model.loss(rendered, target, 1)
    assert float(loss.detach()) == pytest.approx(2 / 12)
    loss.backward()
    assert torch.allclose(rendered.grad[0, 0], torch.tensor([-1.0, 1.0, -1.0]) / 12)
    assert int(rendered.grad.count_nonzero()) == 3


def test_fit_lowers_the_loss():
    config = LangSplatConfig(4, 32, 1e-2, 1_000, False, 120, 2e-2)
    found = langsplat.fit(task(), config)
    assert found.history[-1]["loss"] < 0.95 * found.history[0]["loss"]
    assert list(found.seconds) == ["autoencoder", "latents"]
    assert found.storage == langsplat.storage_bytes(12, found.method.decoder.decoder_parameters, levels=1)
