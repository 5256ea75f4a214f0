import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder
from messages import refused
from oracles_labels import cosine, most_similar

from kfgs.labels import classify
from kfgs.labels.classify import pixel_codewords
from kfgs.quant import Codebook


def random_rows(n, d, seed):
    return torch.randn(n, d, generator=torch.Generator().manual_seed(seed))


def test_labels_and_similarities_agree_with_the_oracle():
    codewords, embeddings = random_rows(40, 12, 0), random_rows(7, 12, 1)
    result = classify(codewords, embeddings)
    assert result.labels.tolist() == most_similar(codewords, embeddings).tolist()
    expected = [max(cosine(a, b) for b in embeddings.double().numpy()) for a in codewords.double().numpy()]
    np.testing.assert_allclose(result.scores, expected, atol=1e-6)
    lengths = classify(codewords * torch.logspace(-3, 3, 40)[:, None], embeddings * torch.logspace(-1, 2, 7)[:, None])
    assert lengths.labels.equal(result.labels)


def test_zeros_ties_and_nothing():
    result = classify(torch.tensor([[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]]), torch.eye(2))
    assert result.labels.tolist() == [-1, 0, 0]  # an all-zero feature has no class; a tie goes to the lowest
    assert result.scores.tolist() == pytest.approx([0.0, -math.sqrt(0.5), math.sqrt(0.5)])
    assert classify(torch.empty(0, 3), torch.eye(3)).labels.shape == (0,)
    codebook = Codebook(torch.eye(4, 6) * 3)
    features = 5 * codebook.codewords[torch.tensor([[2, 0], [3, 1]])]
    features[1, 0] = 0
    assert pixel_codewords(features, codebook).tolist() == [[2, 0], [-1, 1]]  # without an autoencoder


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
    refused(lambda: classify(features, embeddings), *message)


# Pixels

D, d, K = 16, 4, 6


def decoder(bias=0.1, seed=0):
    """A decoder of three layers."""
    g = torch.Generator().manual_seed(seed)
    widths = d, 24, 40, D
    layers = tuple(
        (torch.randn(out, into, generator=g) * (2 / into) ** 0.5, bias * torch.randn(out, generator=g))
        for into, out in pairwise(widths)
    )
    return made_autoencoder(((torch.randn(d, D, generator=g), torch.zeros(d)),), layers, -1.0, 1.0)


def plainly(latents, codebook, autoencoder):
    """Every latent decoded, and the codeword most similar to it."""
    features = autoencoder.decode(latents)
    return codebook.quantize(features).masked_fill(torch.linalg.vector_norm(features, dim=-1) <= 1e-8, -1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_codewords_are_those_of_decoded_latents(dtype):
    g = torch.Generator().manual_seed(3)
    autoencoder = decoder().to(dtype)
    codebook = Codebook(autoencoder.decode(torch.rand(30, d, generator=g).to(dtype)))
    latents = torch.rand(60, 50, d, generator=g).to(dtype)
    covered = torch.rand(60, 50, generator=g) > 0.2
    found = pixel_codewords(latents, codebook, autoencoder, covered=covered)
    assert found.equal(plainly(latents, codebook, autoencoder).masked_fill(~covered, -1))
    assert len(found.unique()) > 15


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
    expected = (2 * latents @ centres.T - centres.square().sum(dim=1)).argmax(dim=1)  # least |x - c|^2
    assert pixel_codewords(latents, codebook, autoencoder, exact=False).equal(expected)
    assert len(expected.unique()) > 4
