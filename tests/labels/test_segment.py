from itertools import pairwise

import numpy as np
import pytest
import torch
from cases_quant import made_autoencoder
from messages import tells
from oracles_labels import most_similar

from kfgs.labels import label_codewords, label_pixels, nearest_codeword, segment
from kfgs.quant import Autoencoder
from kfgs.quant.codebook import Codebook

D, d, K = 16, 4, 6


class Linear:
    """An autoencoder whose code is a projection; it counts what it decodes."""

    def __init__(self, seed=0):
        self.basis = torch.linalg.qr(torch.randn(D, d, generator=torch.Generator().manual_seed(seed)))[0]
        self.largest = 0

    def encode(self, features):
        return features @ self.basis

    def decode(self, latents):
        self.largest = max(self.largest, len(latents))
        return latents @ self.basis.T


@pytest.fixture
def setting():
    """Codewords in the span of the code, so that nothing is lost, and a noisy rendered map 5 x 7."""
    generator = torch.Generator().manual_seed(1)
    autoencoder = Linear()
    latents = torch.nn.functional.normalize(torch.randn(K, d, generator=generator), dim=-1)
    codebook = Codebook(latents @ autoencoder.basis.T)
    embeddings = torch.randn(3, D, generator=generator)
    index = torch.randint(0, K, (5, 7), generator=generator)
    rendered = latents[index] + 0.02 * torch.randn(5, 7, d, generator=generator)
    return autoencoder, codebook, embeddings, index, rendered


def test_exact_path_is_decode_quantise_look_up(setting):
    autoencoder, codebook, embeddings, index, rendered = setting
    table = label_codewords(codebook.codewords, embeddings)
    labels = label_pixels(rendered, codebook, table, autoencoder)
    words = most_similar((rendered @ autoencoder.basis.T).reshape(-1, D), codebook.codewords).reshape(5, 7)
    classes = most_similar(codebook.codewords, embeddings)
    assert labels.dtype == torch.int64
    np.testing.assert_array_equal(labels, classes[words])
    np.testing.assert_array_equal(words, index)


def test_latent_path_agrees_on_clean_latents_and_decodes_nothing(setting):
    autoencoder, codebook, embeddings, _, rendered = setting
    table = label_codewords(codebook.codewords, embeddings).labels
    fast = label_pixels(rendered, codebook, table, autoencoder, decode="latent")
    assert autoencoder.largest == 0
    assert fast.equal(label_pixels(rendered, codebook, table, autoencoder))


def test_chunks_bound_the_decoder_and_change_nothing(setting):
    autoencoder, codebook, embeddings, _, rendered = setting
    table = label_codewords(codebook.codewords, embeddings)
    small = label_pixels(rendered, codebook, table, autoencoder, chunk=4)
    assert autoencoder.largest == 4
    assert small.equal(label_pixels(rendered, codebook, table, autoencoder))
    assert label_pixels(rendered, codebook, table, autoencoder, decode="latent", chunk=3).equal(small)


def test_without_autoencoder_the_map_is_quantised_itself(setting):
    _, codebook, _, index, _ = setting
    features = codebook.codewords[index] * 3
    features[2, 3] = 0
    expected = index.clone()
    expected[2, 3] = -1
    assert label_pixels(features, codebook, torch.arange(K)).equal(expected)


def test_without_codebook_features_meet_the_embeddings(setting):
    autoencoder, _, embeddings, _, rendered = setting
    decoded = (rendered @ autoencoder.basis.T).reshape(-1, D)
    expected = most_similar(decoded, embeddings).reshape(5, 7)
    np.testing.assert_array_equal(label_pixels(rendered, None, None, autoencoder, embeddings=embeddings), expected)
    np.testing.assert_array_equal(label_pixels(decoded, None, None, embeddings=embeddings), expected.reshape(-1))


def test_uncovered_pixels_have_no_label(setting):
    autoencoder, codebook, _, index, rendered = setting
    covered = index % 2 == 0
    labels = label_pixels(rendered, codebook, torch.arange(K), autoencoder, covered=covered)
    assert labels.equal(torch.where(covered, index, -1))


def test_gaussians_are_labelled_like_pixels(setting):
    autoencoder, codebook, _, index, rendered = setting
    assert label_pixels(rendered.reshape(-1, d), codebook, torch.arange(K), autoencoder).equal(index.reshape(-1))
    assert label_pixels(torch.empty(0, d), codebook, torch.arange(K), autoencoder).shape == (0,)


def test_nearest_codeword_is_euclidean_and_ties_go_low():
    latents = torch.tensor([[0.0, 0.0], [1.0, 0.9], [0.5, 0.5]])
    centres = torch.tensor([[1.0, 1.0], [0.25, 0.0], [0.0, 0.0]])
    assert nearest_codeword(latents, centres).tolist() == [2, 0, 1]
    assert nearest_codeword(torch.tensor([[0.5, 0.0]]), torch.tensor([[1.0, 0.0], [0.0, 0.0]])).tolist() == [0]


def test_missing_pieces_are_named(setting):
    autoencoder, codebook, _, _, rendered = setting
    with pytest.raises(ValueError, match=tells("codeword_labels:", "[6]", "got None")):
        label_pixels(rendered, codebook, None, autoencoder)
    with pytest.raises(ValueError, match=tells("embeddings:", "[C, D]", "got None")):
        label_pixels(rendered, None, None, autoencoder)
    with pytest.raises(ValueError, match=tells("codeword_labels:", "[K]", "K = 6", "got (5,)")):
        label_pixels(rendered, codebook, torch.arange(5), autoencoder)
    with pytest.raises(ValueError, match=tells("decode:", "'exact', 'latent'", "got 'fast'")):
        label_pixels(rendered, codebook, torch.arange(K), autoencoder, decode="fast")
    with pytest.raises(ValueError, match=tells("covered:", "(5, 7)", "got (7, 5)")):
        label_pixels(rendered, codebook, torch.arange(K), autoencoder, covered=torch.ones(7, 5, dtype=torch.bool))


def decoder(bias=0.1, seed=0):
    """A decoder of layers, whose last one and the comparison with codewords are one layer on the CPU."""
    g = torch.Generator().manual_seed(seed)
    widths = d, 24, 40, D
    layers = tuple(
        (torch.randn(out, into, generator=g) * (2 / into) ** 0.5, bias * torch.randn(out, generator=g))
        for into, out in pairwise(widths)
    )
    return made_autoencoder(((torch.randn(d, D, generator=g), torch.zeros(d)),), layers, -1.0, 1.0)


def plainly(latents, codebook, table, autoencoder):
    """Every latent decoded, and the codeword most similar to it: the slow path."""
    features = autoencoder.decode(latents)
    return table[codebook.quantize(features)].masked_fill(torch.linalg.vector_norm(features, dim=-1) <= 1e-8, -1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("classes", [1, 3, 30])
def test_decoders_of_layers_give_the_labels_of_the_slow_path(classes, dtype):
    g = torch.Generator().manual_seed(classes)
    autoencoder = decoder().to(dtype)
    codebook = Codebook(autoencoder.decode(torch.rand(30, d, generator=g).to(dtype)))
    table = torch.randint(-1, classes, (30,), generator=g)
    latents = torch.rand(60, 50, d, generator=g).to(dtype)
    covered = torch.rand(60, 50, generator=g) > 0.2
    labels = label_pixels(latents, codebook, table, autoencoder, covered=covered)
    assert labels.equal(plainly(latents, codebook, table, autoencoder).masked_fill(~covered, -1))
    assert len(labels.unique()) > min(classes, 15)


def test_pixels_between_two_classes_are_decoded_in_full(monkeypatch):
    """Two codewords that differ by rounding, of two classes: no lead is sure, and the slow path decides."""
    g = torch.Generator().manual_seed(1)
    autoencoder, decoded = decoder(), []
    codewords = autoencoder.decode(torch.rand(6, d, generator=g))
    codebook = Codebook(torch.cat([codewords, codewords * (1 + 1e-7) + 3e-8]))
    latents = torch.rand(4000, d, generator=g)
    expected = plainly(latents, codebook, torch.arange(12), autoencoder)
    decode = Autoencoder.decode
    monkeypatch.setattr(Autoencoder, "decode", lambda *a, **k: decoded.append(len(a[1])) or decode(*a, **k))
    assert label_pixels(latents, codebook, torch.arange(12), autoencoder).equal(expected)
    assert sum(decoded) == 4000
    decoded.clear()
    assert label_pixels(latents, codebook, torch.arange(12) % 6, autoencoder).equal(expected % 6)
    assert sum(decoded) < 100  # twins of one class need no decision


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [0.01, 1.0, 1e4])
def test_nearest_latents_are_those_of_the_plain_comparison(monkeypatch, spread, dtype):
    """Near the codewords, between them, and far outside, where scores are large and nearly equal."""
    g, compared = torch.Generator().manual_seed(4), []
    autoencoder = decoder().to(dtype)
    codebook = Codebook(autoencoder.decode(torch.rand(40, d, generator=g).to(dtype)))
    centres = autoencoder.encode(codebook.codewords)
    table = torch.arange(40) % 7
    latents = centres[torch.randint(40, (5000,), generator=g)] + spread * torch.randn(5000, d, generator=g).to(dtype)
    latents[0], latents[1] = torch.nan, (centres[3] + centres[4]) / 2
    expected = table[nearest_codeword(latents, centres)]
    plain = segment.nearest_codeword
    monkeypatch.setattr(segment, "nearest_codeword", lambda x, c: compared.append(len(x)) or plain(x, c))
    assert label_pixels(latents, codebook, table, autoencoder, decode="latent").equal(expected)
    assert sum(compared) < 2500 if spread < 1e4 else sum(compared) <= 5000
    assert len(expected.unique()) > 4


def test_latents_that_decode_to_nothing_have_no_label():
    autoencoder = decoder(bias=0.0)
    codebook = Codebook(torch.eye(K, D))
    latents = torch.cat([torch.zeros(3, d), torch.rand(5, d, generator=torch.Generator().manual_seed(2))])
    labels = label_pixels(latents, codebook, torch.arange(K), autoencoder)
    assert labels[:3].tolist() == [-1] * 3
    assert labels.equal(plainly(latents, codebook, torch.arange(K), autoencoder))
