"""Packed fields: how exactly they come back, how small they are, and what is refused."""

import pytest
import torch
import zstandard
from messages import tells

from kfgs.fields import SemanticField, pack_field, unpack_field
from kfgs.fields import packed as packed_module
from kfgs.formats.smallest_three import rotation_error
from kfgs.gaussians import Gaussians
from kfgs.quant import LinearLatents


def field(n=500, d=6, dim=40, seed=0):
    g = torch.Generator().manual_seed(seed)
    latents = torch.nn.functional.normalize(torch.randn(n, d, generator=g), dim=1)
    gaussians = Gaussians(
        means=torch.randn(n, 3, generator=g) * torch.tensor([5.0, 1, 0.1]),
        quats=torch.randn(n, 4, generator=g),
        scales=torch.exp(torch.randn(n, 3, generator=g) - 3),
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        features=latents,
    )
    basis = torch.linalg.qr(torch.randn(dim, d, generator=g).double()).Q.float()
    return SemanticField(gaussians, linear=LinearLatents(basis))


def test_everything_comes_back_within_its_step():
    made = field()
    back = unpack_field(pack_field(made))
    cloud, other = made.gaussians, back.gaussians
    span = cloud.means.amax(0) - cloud.means.amin(0)
    assert ((cloud.means - other.means).abs() <= 0.51 * span / 65_535 + 1e-6).all()
    logs = cloud.scales.log()
    assert ((logs - other.scales.log()).abs() <= 0.51 * (logs.amax(0) - logs.amin(0)) / 255 + 1e-5).all()
    assert (cloud.opacities - other.opacities).abs().max() <= 0.51 / 255
    unit = torch.nn.functional.normalize(cloud.quats, dim=1)
    turned = 2 * torch.acos((unit * other.quats).sum(1).abs().clamp(max=1))
    assert float(turned.max()) <= rotation_error(255) + 1e-3
    assert (made.features - back.features).abs().max() <= 0.51 * packed_module.STEP
    whole = torch.arange(len(made))
    cosine = torch.nn.functional.cosine_similarity(made.own_features(whole), back.own_features(whole), dim=1)
    assert cosine.min() > 0.998


def test_large_latents_take_a_larger_step_and_none_overflows():
    made = field()
    large = SemanticField(made.gaussians.replace(features=made.features * 100), linear=made.linear)
    back = unpack_field(pack_field(large))
    assert (large.features - back.features).abs().max() <= 0.51 * large.features.abs().max() / 127


def test_a_packed_field_is_small_and_packs_to_itself():
    made = field(20_000, d=20, dim=512)
    data = pack_field(made)
    assert len(data) < 20_000 * (6 + 3 + 4 + 1 + 20) + 2 * 20 * 512 + 2_000
    once, twice = unpack_field(data), unpack_field(pack_field(unpack_field(data)))
    torch.testing.assert_close(once.features, twice.features, atol=1e-6, rtol=0)
    torch.testing.assert_close(once.gaussians.means, twice.gaussians.means, atol=2e-4, rtol=0)


def test_what_cannot_be_packed_or_unpacked_is_named(monkeypatch):
    with pytest.raises(ValueError, match=tells("field:", "got 'just decouple'")):
        pack_field(SemanticField(field().gaussians))
    with pytest.raises(ValueError, match=tells("field:", "got none")):
        pack_field(SemanticField(field().gaussians.select(torch.arange(0)), linear=field().linear))
    for data in (b"", b"nonsense", zstandard.compress(b"nonsense"), pack_field(field())[:-50]):
        with pytest.raises(ValueError, match=tells("data:", "packed", "read")):
            unpack_field(data)
    monkeypatch.setattr(packed_module, "LIMIT", 1_000)
    with pytest.raises(ValueError, match=tells("data:", "1000")):
        unpack_field(pack_field(field()))
