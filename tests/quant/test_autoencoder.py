from itertools import pairwise

import numpy as np
import oracles_quant as oracle
import pytest
import torch
from cases_quant import made_autoencoder
from messages import refused, tells

from kfgs.quant import Autoencoder, Codebook


def network(widths, seed):
    generator = torch.Generator().manual_seed(seed)
    return tuple(
        (torch.randn(b, a, generator=generator, dtype=torch.float64), torch.randn(b, generator=generator).double())
        for a, b in pairwise(widths)
    )


ENCODER, DECODER = network((6, 5, 3), 0), network((3, 4, 6), 1)


def example():
    return made_autoencoder(ENCODER, DECODER, -0.5, 0.75)


def rows(n, dim, seed=2):
    return torch.randn(n, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_encode_and_decode_against_loops():
    features, latents = rows(9, 6), rows(9, 3)
    found = example()
    unit = oracle.unit(oracle.mlp(ENCODER, oracle.unit(features.numpy())))
    expected = np.clip((unit + 0.5) / 1.25, 0, 1)
    assert (expected == 0).any()
    np.testing.assert_allclose(found.encode(features).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(found.decode(latents).numpy(), oracle.unit(oracle.mlp(DECODER, latents)), atol=1e-12)


def test_each_row_is_treated_alone_and_shapes_are_kept():
    found, features = example(), rows(24, 6).reshape(2, 3, 4, 6)
    latents = found.encode(features)
    assert latents.shape == (2, 3, 4, 3)
    torch.testing.assert_close(found.encode(features[1, 2, 3]), latents[1, 2, 3])
    torch.testing.assert_close(found.encode(40 * features), latents)


def test_decode_is_differentiable():
    assert torch.autograd.gradcheck(example().decode, rows(3, 3, seed=5).requires_grad_())


def test_save_then_load_is_the_same(tmp_path):
    found, features = example(), rows(5, 6)
    found.save(tmp_path / "ae.safetensors")
    for again in (Autoencoder.load(tmp_path / "ae.safetensors"), Autoencoder.from_state_dict(found.state_dict())):
        assert torch.equal(again.encode(features), found.encode(features))
        assert torch.equal(again.decode(again.encode(features)), found.decode(found.encode(features)))
        assert (again.dim, again.latent, again.decoder_parameters) == (6, 3, (3 * 4 + 4) + (4 * 6 + 6))
    assert found.to(torch.float32).encode(features.float()).dtype == torch.float32
    assert found.encode(features).dtype == torch.float64  # `to` gives a copy


def test_bad_input(tmp_path):
    found = example()
    refused(lambda: found.encode(torch.zeros(2, 3)), "features:", "[..., 6]", "got (2, 3)")
    refused(lambda: found.decode(torch.zeros(2, 6)), "latents:", "[..., 3]", "got (2, 6)")
    refused(lambda: made_autoencoder(ENCODER, network((3, 5), 0)), "decoder:", "from 3 to 6", "got (3, 5)")
    refused(lambda: made_autoencoder(ENCODER, DECODER, 0.5, 0.5), "range:", "low < high", "0.5")
    state = found.state_dict()
    with pytest.raises(ValueError, match=tells("tensors:", "'decoder.1.bias'")):
        Autoencoder.from_state_dict({name: value for name, value in state.items() if name != "decoder.1.bias"})
    with pytest.raises(ValueError, match=tells("tensors:", "got others")):
        Autoencoder.from_state_dict(state | {"encoder.1.weight": torch.zeros(3, 4)})
    refused(lambda: Autoencoder.from_state_dict({"range": torch.tensor([0.0, 1.0])}), "tensors:", "encoder.0.weight")
    Codebook(torch.eye(3)).save(tmp_path / "book.safetensors")
    refused(lambda: Autoencoder.load(tmp_path / "book.safetensors"), "book.safetensors:", "got codebook")
