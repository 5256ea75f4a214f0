import oracles_quant as oracle
import pytest
import torch

from kfgs.quant import AutoencoderConfig, Codebook, fit_autoencoder
from kfgs.quant.autoencoder import _blends, quick_on_a_cpu

SHORT = AutoencoderConfig.paper(encoder=(64, 32), decoder=(32, 128), steps=800, learning_rate=2e-3)


def latents_of(book, fit):
    return fit.encode(book.codewords)


def realistic_codebook(groups=12, each=4, dim=96, seed=0):
    """Groups of codewords with cosines of about 0.95 inside a group and lengths about 11, as a fitted codebook has."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.nn.functional.normalize(torch.randn(groups, dim, generator=generator), dim=1)
    spread = 0.23 * torch.randn(groups, each, dim, generator=generator) / dim**0.5
    return Codebook(11 * (centres[:, None] + spread).reshape(-1, dim))


def test_denormal_numbers_are_afterwards_what_they_were_before():
    denormal = torch.tensor(1e-310, dtype=torch.float64)
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor has no such mode")
    try:
        for flushed in (True, False):
            torch.set_flush_denormal(flushed)
            with quick_on_a_cpu():
                assert float(denormal * 1) == 0
            assert (float(denormal * 1) == 0) is flushed
    finally:
        torch.set_flush_denormal(False)


@pytest.fixture(scope="module")
def fitted():
    book = realistic_codebook()
    similarity = book.unit @ book.unit.T
    assert 0.93 < float(similarity.fill_diagonal_(-1).amax()) < 0.99  # below the pruning threshold, near it
    return book, fit_autoencoder(book, SHORT)


def test_every_codeword_is_recovered_from_latents_that_fill_the_unit_range(fitted):
    book, fit = fitted
    latents = latents_of(book, fit)
    assert latents.shape == (48, 9)
    assert (latents.min().item(), latents.max().item()) == pytest.approx((0, 1), abs=1e-6)
    assert torch.pdist(latents).min() > 0.02
    assert oracle.quantize(fit.decode(latents).numpy(), book.codewords.numpy()).tolist() == list(range(48))
    assert fit.report.recovered == 1.0


def test_loss_is_eq_10_with_unit_targets_of_the_network_that_training_saw_last(fitted):
    """It goes on where the history ends: nothing jumps when statistics are frozen."""
    book, fit = fitted
    unit = oracle.unit(book.codewords.double().numpy())
    decoded = fit.decode(latents_of(book, fit)).double().numpy()
    errors = [float(((decoded[i] - unit[i]) ** 2).sum() ** 0.5) for i in range(48)]
    assert fit.report.loss == pytest.approx(sum(errors) / 48, rel=1e-5)
    assert fit.report.loss == pytest.approx(fit.report.history[-1]["loss"], rel=0.2)
    assert fit.report.loss < 0.1 < fit.report.history[0]["loss"]


def test_the_paper_s_network_has_831744_decoder_weights():
    book = Codebook(torch.randn(5, 512, generator=torch.Generator().manual_seed(0)))
    fit = fit_autoencoder(book, AutoencoderConfig.paper(steps=1))
    assert fit.decoder_parameters == 831_744
    assert [layer.out_features for layer in fit.encoder] == [256, 128, 64, 32, 9]
    assert [layer.out_features for layer in fit.decoder] == [32, 64, 128, 256, 1024, 512]
    config = AutoencoderConfig.paper()
    assert (config.decay, config.blends) == (False, 0)
    assert (config.latent, config.steps, config.learning_rate, config.weight_decay) == (9, 5000, 1e-4, 5e-6)


@pytest.mark.parametrize(("K", "dim", "latent"), [(1, 7, 3), (2, 5, 1), (2, 4, 9), (3, 2, 2)])
def test_small_codebooks(K, dim, latent):
    angles = torch.arange(K) * 2.0
    rows = torch.zeros(K, dim)
    rows[:, 0], rows[:, 1] = angles.cos(), angles.sin()
    config = AutoencoderConfig.paper(latent=latent, encoder=(8,), decoder=(16,), steps=200, learning_rate=5e-3)
    book = Codebook(rows)
    fit = fit_autoencoder(book, config)
    assert fit.report.recovered == 1.0
    assert latents_of(book, fit).shape == (K, latent)
    assert torch.isfinite(latents_of(book, fit)).all()


def test_same_generator_state_same_bits_and_the_global_one_is_left_alone():
    book, config = realistic_codebook(3, 2, 16), AutoencoderConfig.paper(encoder=(8,), decoder=(8,), steps=110)
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    records = []
    fits = [
        fit_autoencoder(book, config, generator=torch.Generator().manual_seed(seed), progress=records.append)
        for seed in (1, 1, 2)
    ]
    assert torch.equal(torch.rand(1), expected)
    assert torch.equal(latents_of(book, fits[0]), latents_of(book, fits[1]))
    assert not torch.equal(latents_of(book, fits[0]), latents_of(book, fits[2]))
    assert [row["step"] for row in fits[0].report.history] == [100, 110]
    assert records == [row for fit in fits for row in fit.report.history]


def test_blended_latents_decode_to_blended_features():
    """The default learns what the field renders; the paper's training leaves it to chance."""
    book = realistic_codebook(8, 2)
    options = dict(encoder=(64, 32), decoder=(32, 128), steps=300, learning_rate=2e-3)
    plain, blended = (
        fit_autoencoder(book, AutoencoderConfig.paper(**options)),
        fit_autoencoder(book, AutoencoderConfig(**options)),
    )
    weights = _blends(500, book.size, torch.Generator().manual_seed(9), book.unit)  # others than in training
    wanted = weights @ book.unit

    def error(fit):
        return (1 - torch.cosine_similarity(fit.decode(weights @ latents_of(book, fit)), wanted)).mean()

    assert error(blended) < 0.5 * error(plain)
    assert blended.report.recovered >= 0.9
