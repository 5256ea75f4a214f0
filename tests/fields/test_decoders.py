"""Label views by votes, against the slow path: all scores rendered to a map, or features decoded pixel by pixel."""

from dataclasses import replace

import pytest
import torch
from cases_quant import made_autoencoder
from cases_splat import a_camera, gaussians_before

from kfgs.fields import Autoencoded, Identity, Linear, SemanticField
from kfgs.quant import Codebook
from kfgs.splat import rasterize

DIM, CLASSES = 16, 7


def camera():
    return a_camera(60, 44, focal=(50.0, 46.0), principal=(28.0, 20.0), dtype=torch.float32)


def texts(seed=1, count=CLASSES):
    return torch.randn(count, DIM, generator=torch.Generator().manual_seed(seed))


def fused(unknown=20, latents=6):
    """Random Gaussians with linear latents; nothing is known about the first ones."""
    cloud = gaussians_before(camera(), 200, seed=2, channels=latents, sigma=(0.02, 0.08))
    features = cloud.features.clone()
    features[:unknown] = 0
    basis = torch.linalg.qr(torch.randn(DIM, latents, generator=torch.Generator().manual_seed(3))).Q
    return SemanticField(cloud.replace(features=features), Linear(basis))


def uncompressed():
    return SemanticField(gaussians_before(camera(), 200, seed=2, channels=DIM, sigma=(0.02, 0.08)), Identity(DIM))


def quantised():
    """The paper's kind: latents that a decoder of layers turns into features near codewords."""
    g = torch.Generator().manual_seed(4)
    into = ((torch.randn(4, DIM, generator=g), torch.zeros(4)),)
    out = (torch.randn(20, 4, generator=g), torch.zeros(20)), (torch.randn(DIM, 20, generator=g), torch.zeros(DIM))
    autoencoder = made_autoencoder(into, out, -1.0, 1.0)
    cloud = gaussians_before(camera(), 200, seed=2, channels=4, sigma=(0.02, 0.08))
    return SemanticField(cloud, Autoencoded(Codebook(autoencoder.decode(torch.randn(9, 4, generator=g))), autoencoder))


def voted(field, rows):
    """The blended votes of each pixel [H, W, W'], and the classes they are of."""
    cosines, known = field.cosines(rows), field.known
    winners = cosines.argmax(dim=1)[known].unique()
    votes = torch.softmax(100 * cosines[:, winners], dim=1) * known[:, None]
    return rasterize(field.gaussians.replace(features=votes.contiguous()), camera()).map, winners


@pytest.mark.parametrize("make", [fused, uncompressed])
def test_the_paper_s_labels_are_those_of_the_decoded_pixels(make):
    field = make()
    rendering = field.render(camera())
    similarity = field.decode(rendering.map) @ torch.nn.functional.normalize(texts()).T
    best = similarity.sort(dim=-1, descending=True).values
    clear = best[..., 0] - best[..., 1] > 1e-5
    labels = field.paper.segment(camera(), texts())
    assert clear.float().mean() > 0.8
    assert labels[clear].equal(similarity.argmax(dim=-1)[clear])
    assert (labels == -1).equal(~field.decode(rendering.map).any(dim=-1))


def test_all_classes_in_order():
    field = fused()
    blended, winners = voted(field, texts())
    found = field.rank(camera(), texts(), top=CLASSES)
    scores, index = blended.sort(dim=-1, descending=True, stable=True)
    assert found.scores[..., : len(winners)].equal(scores.masked_fill((found.alphas <= 0)[..., None], 0))
    assert found.labels[..., : len(winners)].equal(winners[index].masked_fill(scores <= 0, -1))
    assert found.labels[..., 0].equal(field.segment(camera(), texts()))


def test_classes_beyond_those_with_votes_are_none():
    field = fused()
    few = texts()[:1].repeat(3, 1)  # three times the same: ties go to the first, the others get no vote
    found = field.rank(camera(), few, top=3)
    assert found.labels.shape == found.scores.shape == (44, 60, 3)
    assert (found.labels[..., 0] >= 0).any()
    assert (found.labels[..., 1:] == -1).all()
    assert (found.scores[..., 1:] == 0).all()
    nobody = replace(field, gaussians=field.gaussians.replace(features=torch.zeros(200, 6)))
    none = nobody.rank(camera(), few, top=2)
    assert (none.labels == -1).all()
    assert (none.scores == 0).all()
    assert none.alphas.equal(found.alphas)


@pytest.mark.parametrize("rule", ["fused", "paper"])
def test_best_classes_of_codewords(rule):
    field = quantised()
    field = field.paper if rule == "paper" else field
    found = field.rank(camera(), texts(), top=3)
    assert found.labels[..., 0].equal(field.segment(camera(), texts()))
    similarity = field.decoder.codebook.unit @ torch.nn.functional.normalize(texts()).T
    drawn = found.alphas > 0
    assert drawn.any()
    assert (found.labels[~drawn] == -1).all()
    rows = {tuple(row) for row in similarity.argsort(dim=1, descending=True)[:, :3].tolist()}
    assert {tuple(row) for row in found.labels[drawn].tolist()} <= rows
    if rule == "paper":
        index = field.decoder.codebook.quantize(field.decode(field.render(camera()).map))
        torch.testing.assert_close(
            found.scores[drawn], similarity.sort(dim=1, descending=True).values[index][drawn][:, :3]
        )


def test_kept_votes_are_those_of_the_text():
    field = fused()
    expected = {seed: fused().segment(camera(), texts(seed)) for seed in (1, 2)}
    for seed in (1, 2, 2, 1):
        assert field.segment(camera(), texts(seed)).equal(expected[seed])
    assert not expected[1].equal(expected[2])


def test_votes_follow_features_that_are_changed_in_place():
    field = fused()
    before = field.segment(camera(), texts())
    field.latents.neg_()
    changed = fused()
    changed = replace(changed, gaussians=changed.gaussians.replace(features=-changed.latents))
    after = field.segment(camera(), texts())
    assert after.equal(changed.segment(camera(), texts()))
    assert not after.equal(before)
