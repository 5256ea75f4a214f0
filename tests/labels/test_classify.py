import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder
from messages import tells
from oracles_labels import cosine, most_similar

from kfgs.labels import classify
from kfgs.labels.classify import nearest_codeword, pixel_codewords
from kfgs.quant import Autoencoder, Codebook


def random_rows(n, d, seed):
    return torch.randn(n, d, generator=torch.Generator().manual_seed(seed))


def test_labels_and_similarities_agree_with_the_oracle():
    codewords, embeddings = random_rows(40, 12, 0), random_rows(7, 12, 1)
    result = classify(codewords, embeddings)
    assert result.labels.tolist() == most_similar(codewords, embeddings).tolist()
    expected = [max(cosine(a, b) for b in embeddings.double().numpy()) for a in codewords.double().numpy()]
    np.testing.assert_allclose(result.scores, expected, atol=1e-6)


def test_length_of_features_and_embeddings_does_not_matter():
    features, embeddings = random_rows(50, 8, 2), random_rows(5, 8, 3)
    scaled = classify(
        features * torch.logspace(-3, 3, 50)[:, None], embeddings * torch.tensor([[1], [9], [0.1], [50], [3.0]])
    )
    assert scaled.labels.equal(classify(features, embeddings).labels)


def test_all_zero_feature_has_no_class_and_score_zero():
    result = classify(torch.tensor([[0.0, 0.0], [-1.0, -1.0]]), torch.eye(2))
    assert result.labels.tolist() == [-1, 0]
    assert result.scores.tolist() == pytest.approx([0.0, -math.sqrt(0.5)])


def test_tie_goes_to_the_lowest_class():
    assert classify(torch.tensor([[1.0, 1.0]]), torch.tensor([[0.0, 2.0], [2.0, 0.0], [0.0, 1.0]])).labels.tolist() == [
        0
    ]


def test_no_features_give_no_labels():
    result = classify(torch.empty(0, 3), torch.eye(3))
    assert (result.labels.shape, result.scores.shape) == ((0,), (0,))


@pytest.mark.parametrize(
    ("features", "embeddings", "message"),
    [
        (torch.ones(4, 3), torch.eye(2), ("embeddings:", "[C, D]", "D = 3", "got (2, 2)")),
        (torch.ones(4, 3), torch.empty(0, 3), ("embeddings:", "class", "got (0, 3)")),
        (torch.ones(4, 2), torch.tensor([[1.0, 0.0], [0.0, 0.0]]), ("embeddings:", "row 1", "drop")),
        (torch.tensor([[1.0, 1.0], [math.nan, 0.0]]), torch.eye(2), ("features:", "row 1", "got NaN")),
        (torch.ones(1, 2), torch.tensor([[math.inf, 0.0]]), ("embeddings:", "got NaN")),
    ],
)
def test_wrong_input_is_named(features, embeddings, message):
    with pytest.raises(ValueError, match=tells(*message)):
        classify(features, embeddings)


# Pixels

D, d, K = 16, 4, 6


def decoder(bias=0.1, seed=0):
    """A decoder of layers, whose last one and the comparison with codewords are one layer on the CPU."""
    g = torch.Generator().manual_seed(seed)
    widths = d, 24, 40, D
    layers = tuple(
        (torch.randn(out, into, generator=g) * (2 / into) ** 0.5, bias * torch.randn(out, generator=g))
        for into, out in pairwise(widths)
    )
    return made_autoencoder(((torch.randn(d, D, generator=g), torch.zeros(d)),), layers, -1.0, 1.0)


@pytest.fixture
def setting():
    """Codewords that the decoder makes of far latents, and a noisy rendered map 5 x 7."""
    generator = torch.Generator().manual_seed(1)
    autoencoder = decoder()
    centres = torch.eye(K, d + 2)[:, :d] + 0.2 * torch.rand(K, d, generator=generator)
    codebook = Codebook(autoencoder.decode(centres))
    index = torch.randint(0, K, (5, 7), generator=generator)
    rendered = centres[index] + 0.001 * torch.randn(5, 7, d, generator=generator)
    return autoencoder, codebook, index, rendered


def test_exact_path_is_decode_and_quantise(setting):
    autoencoder, codebook, index, rendered = setting
    found = pixel_codewords(rendered, codebook, autoencoder)
    assert found.dtype == torch.int64
    words = most_similar(autoencoder.decode(rendered).reshape(-1, D), codebook.codewords).reshape(5, 7)
    np.testing.assert_array_equal(found, words)
    np.testing.assert_array_equal(words, index)


def test_without_autoencoder_the_map_is_quantised_itself(setting):
    _, codebook, index, _ = setting
    features = codebook.codewords[index] * 3
    features[2, 3] = 0
    expected = index.clone()
    expected[2, 3] = -1
    assert pixel_codewords(features, codebook).equal(expected)


def test_uncovered_pixels_have_no_label(setting):
    autoencoder, codebook, index, rendered = setting
    covered = index % 2 == 0
    labels = pixel_codewords(rendered, codebook, autoencoder, covered=covered)
    assert labels.equal(torch.where(covered, index, -1))


def test_nearest_codeword_is_euclidean_and_ties_go_low():
    latents = torch.tensor([[0.0, 0.0], [1.0, 0.9], [0.5, 0.5]])
    centres = torch.tensor([[1.0, 1.0], [0.25, 0.0], [0.0, 0.0]])
    assert nearest_codeword(latents, centres).tolist() == [2, 0, 1]
    assert nearest_codeword(torch.tensor([[0.5, 0.0]]), torch.tensor([[1.0, 0.0], [0.0, 0.0]])).tolist() == [0]


def plainly(latents, codebook, autoencoder):
    """Every latent decoded, and the codeword most similar to it: the slow path."""
    features = autoencoder.decode(latents)
    return codebook.quantize(features).masked_fill(torch.linalg.vector_norm(features, dim=-1) <= 1e-8, -1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_decoders_of_layers_give_the_codewords_of_the_slow_path(dtype):
    g = torch.Generator().manual_seed(3)
    autoencoder = decoder().to(dtype)
    codebook = Codebook(autoencoder.decode(torch.rand(30, d, generator=g).to(dtype)))
    latents = torch.rand(60, 50, d, generator=g).to(dtype)
    covered = torch.rand(60, 50, generator=g) > 0.2
    found = pixel_codewords(latents, codebook, autoencoder, covered=covered)
    assert found.equal(plainly(latents, codebook, autoencoder).masked_fill(~covered, -1))
    assert len(found.unique()) > 15


def test_pixels_between_two_codewords_are_decoded_in_full(monkeypatch):
    """Two codewords that differ by rounding: no lead is sure, and the slow path decides."""
    g = torch.Generator().manual_seed(1)
    autoencoder, decoded = decoder(), []
    codewords = autoencoder.decode(torch.rand(6, d, generator=g))
    codebook = Codebook(torch.cat([codewords, codewords * (1 + 1e-7) + 3e-8]))
    latents = torch.rand(4000, d, generator=g)
    expected = plainly(latents, codebook, autoencoder)
    decode = Autoencoder.decode
    monkeypatch.setattr(Autoencoder, "decode", lambda *a, **k: decoded.append(len(a[1])) or decode(*a, **k))
    assert pixel_codewords(latents, codebook, autoencoder).equal(expected)
    assert sum(decoded) == 4000
    decoded.clear()
    assert pixel_codewords(latents, Codebook(codewords), autoencoder).equal(expected % 6)
    assert sum(decoded) < 100


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [0.01, 1.0, 1e4])
def test_nearest_latents_are_those_of_the_plain_comparison(spread, dtype):
    """Near the codewords, between them, and far outside, where scores are large and nearly equal."""
    g = torch.Generator().manual_seed(4)
    autoencoder = decoder().to(dtype)
    codebook = Codebook(autoencoder.decode(torch.rand(40, d, generator=g).to(dtype)))
    centres = autoencoder.encode(codebook.codewords)
    latents = centres[torch.randint(40, (5000,), generator=g)] + spread * torch.randn(5000, d, generator=g).to(dtype)
    latents[0], latents[1] = torch.nan, (centres[3] + centres[4]) / 2
    expected = nearest_codeword(latents, centres)
    assert pixel_codewords(latents, codebook, autoencoder, exact=False).equal(expected)
    assert len(expected.unique()) > 4


def test_latents_that_decode_to_nothing_have_no_label():
    autoencoder = decoder(bias=0.0)
    codebook = Codebook(torch.eye(K, D))
    latents = torch.cat([torch.zeros(3, d), torch.rand(5, d, generator=torch.Generator().manual_seed(2))])
    labels = pixel_codewords(latents, codebook, autoencoder)
    assert labels[:3].tolist() == [-1] * 3
    assert labels.equal(plainly(latents, codebook, autoencoder))
