from dataclasses import replace

import numpy as np
import oracles_answers
import oracles_uplift
import pytest
import torch
from cases_quant import made_autoencoder
from cases_splat import a_camera, gaussians_before

from kfgs.fields import Autoencoded, Codewords, Identity, SemanticField, fuse_views
from kfgs.quant import Codebook

DIM = 6


def codebook():
    """Four directions, not orthogonal, of unequal lengths."""
    rows = torch.eye(4, DIM) * torch.tensor([2.0, 3.0, 1.0, 1.5])[:, None]
    rows[1, 0], rows[3, 5] = 1.0, -1.0
    return Codebook(rows)


def autoencoder():
    """Written down, not fitted: latents are the first four channels, held to 0 and more."""
    into, out = torch.eye(4, DIM), torch.eye(DIM, 4)
    layers = ((out, torch.zeros(DIM)), (torch.eye(DIM), torch.zeros(DIM)))
    return made_autoencoder(encoder=((into, torch.zeros(4)),), decoder=layers, low=0.0, high=1.0)


def fuse(cloud, mode, cameras):
    book = Codewords(codebook()) if mode == "adc" else Autoencoded(codebook(), autoencoder())
    field = SemanticField(cloud, Identity(DIM) if mode == "decouple" else book)
    return fuse_views(field, cameras).fused


def views(n=3):
    base = a_camera(13, 10, focal=(14.0, 12.0), principal=(5.3, 5.6), dtype=torch.float32)
    moved = []
    for i in range(n):
        viewmat = base.viewmat.clone()
        viewmat[:2, 3] += torch.tensor([0.3 * i, -0.2 * i])
        moved.append(replace(base, viewmat=viewmat))
    return moved


def trained(mode, n=10):
    """Gaussians whose latents are those of codewords, with noise; the last two stand far outside of every view."""
    g = torch.Generator().manual_seed(0)
    cloud = gaussians_before(views()[0], n, seed=2, depth=(2.0, 6.0), spread=0.8, opacities=(0.5, 0.9))
    means = cloud.means.clone()
    means[-2:] += 1000
    features = codebook().unit[torch.arange(n) % 4]
    if mode == "adc+sc":
        features = autoencoder().encode(codebook().codewords)[torch.arange(n) % 4]
    return cloud.replace(means=means, features=features + 0.1 * torch.randn(features.shape, generator=g))


def blend_weights(cloud, cameras):
    numbers = [x.double().numpy() for x in (cloud.means, cloud.quats, cloud.scales, cloud.opacities)]
    return [
        oracles_uplift.blend_weights(*numbers, c.viewmat.double().numpy(), c.K.double().numpy(), c.width, c.height)
        for c in cameras
    ]


@pytest.mark.parametrize("mode", ["decouple", "adc", "adc+sc"])
def test_answers_are_those_of_the_slow_oracle(mode):
    cloud, book = trained(mode), None if mode == "decouple" else codebook()
    coder = autoencoder() if mode == "adc+sc" else None
    codewords = codebook().codewords.double().numpy()
    centres = None if coder is None else coder.encode(codebook().codewords).detach().double().numpy()

    def shown(rendered):
        return (
            oracles_answers.unit_map(rendered)
            if book is None
            else oracles_answers.codeword_map(rendered, codewords, centres)
        )

    expected, pixels = oracles_answers.fused(blend_weights(cloud, views()), cloud.features.double().numpy(), shown)
    found = fuse(cloud, mode, views())
    features = found.decode(found.features)
    # KEEP drops what is below 0.001 of the variation between features: at most sqrt(0.001) of each.
    np.testing.assert_allclose(features.numpy(), expected, atol=2e-5 if book is not None else 0.03)
    assert (pixels[:8] > 0.5).sum() >= 6
    assert (pixels[8:] == 0).all()


@pytest.mark.parametrize("mode", ["decouple", "adc", "adc+sc"])
def test_what_no_view_shows_answers_nothing(mode):
    found = fuse(trained(mode), mode, views())
    assert (found.features[-2:] == 0).all()


@pytest.mark.parametrize("mode", ["decouple", "adc"])
def test_what_learnt_nothing_answers_nothing(mode):
    """Its pixels show all-zero features, which are no codeword, not even the first."""
    cloud = trained(mode)
    cloud = cloud.replace(features=torch.zeros_like(cloud.features))
    features = torch.cat([torch.zeros(9, DIM), codebook().unit[:1]])  # the last, far away, has some
    found = fuse(cloud.replace(features=features), mode, views())
    assert (found.features == 0).all()


def test_large_views_are_rendered_small(monkeypatch):
    cloud, large = trained("adc"), [view.resized(40, 52) for view in views()]
    monkeypatch.setattr("kfgs.fields.fused.PIXELS", 130)
    torch.testing.assert_close(fuse(cloud, "adc", large).features, fuse(cloud, "adc", views()).features)
