from dataclasses import replace
from functools import cache

import numpy as np
import oracles_quant
import oracles_uplift
import pytest
import torch
from cases_clouds import balls
from cases_quant import first_channels
from cases_splat import a_camera, gaussians_before
from messages import refused, tells

from kfgs import Camera
from kfgs.fields import Autoencoded, Codewords, Identity, Linear, SemanticField, fuse_views
from kfgs.fields.uplift import join_fields
from kfgs.metrics import MIB
from kfgs.quant import Autoencoder, Codebook, LinearLatents

DIM, CLASSES = 16, 3
TRAINED = ["decouple", "adc", "adc+sc"]
MODES = [*TRAINED, "fused"]
RULES = ["fused", "paper"]


@cache
def codebook():
    """Four orthogonal directions; the last two share the third class's."""
    codewords = torch.zeros(4, DIM)
    codewords[0, 0], codewords[1, 1], codewords[2, 2], codewords[3, 3] = 2.0, 3.0, 1.0, 1.5
    return Codebook(codewords)


@cache
def embeddings():
    rows = torch.zeros(CLASSES, DIM)
    rows[0, 0], rows[1, 1] = 1.0, 1.0
    rows[2, 2] = rows[2, 3] = 1.0
    return rows


@cache
def autoencoder() -> Autoencoder:
    """Codeword i's latent is the i-th unit vector of four, and decodes to its direction."""
    return first_channels(4, DIM)


@cache
def linear():
    """The four directions of the codewords, mixed: no latent is one of them."""
    mixed = torch.linalg.qr(torch.randn(4, 4, generator=torch.Generator().manual_seed(0))).Q
    return LinearLatents(torch.eye(DIM, 4) @ mixed)


def decoder(mode):
    if mode == "decouple":
        return Identity(DIM)
    if mode == "fused":
        return Linear(linear().basis)
    return Codewords(codebook()) if mode == "adc" else Autoencoded(codebook(), autoencoder())


def by(rule, made):
    return made.paper if rule == "paper" else made


def field(mode="adc+sc", n=4):
    """Opaque balls side by side, the i-th at codeword i (mod 4) exactly."""
    features = codebook().codewords[torch.arange(n) % 4]
    if mode == "adc+sc":
        with torch.no_grad():
            features = autoencoder().encode(features)
    if mode == "fused":
        features = linear().encode(features)
    means = [[i - (n - 1) / 2, 0.0, 5.0] for i in range(n)]
    gaussians = balls(means, scale=0.2, opacity=0.95, features=features)
    return SemanticField(gaussians, decoder(mode), info={"mode": mode, "seconds": 1.5})


def camera():
    return Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 8], [0, 0, 1]]), 40, 16)


# Ball i projects to column 40 (i - 1.5) / 5 + 20 = 8 + 8 i, row 8.
CENTRES = [8, 16, 24, 32]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mode", MODES)
def test_segment_sees_each_ball_in_its_class(mode, rule):
    labels = by(rule, field(mode)).segment(camera(), embeddings())
    assert labels.shape == (16, 40)
    assert labels[8, CENTRES].tolist() == [0, 1, 2, 2]
    assert labels[0].tolist() == [-1] * 40  # nothing was drawn there


def test_views_of_a_fused_field_blend_votes():
    """Pixel by pixel: sum over Gaussians of w = T alpha times the softmax of 100 cosines, over the classes that some Gaussian
    prefers. The last class is nobody's favourite, and the last Gaussian knows nothing."""
    view = a_camera(16, 12, focal=(15.0, 13.0), principal=(7.3, 6.1))
    cloud = gaussians_before(view, 12, seed=3, channels=4, sigma=(0.05, 0.2))
    cloud = cloud.replace(features=torch.cat([cloud.features[:-1], torch.zeros(1, 4).double()]))
    made = SemanticField(cloud, Linear(linear().to(torch.float64).basis))
    g = torch.Generator().manual_seed(1)
    classes = torch.cat([torch.randn(5, DIM, generator=g), -made.decode(cloud.features[:-1]).sum(0)[None].float()])
    parts = [x.numpy() for x in (cloud.means, cloud.quats, cloud.scales, cloud.opacities)]
    weights = oracles_uplift.blend_weights(*parts, view.viewmat.numpy(), view.K.numpy(), view.width, view.height)
    features, rows = cloud.features.numpy() @ linear().basis.T.double().numpy(), classes.double().numpy()
    cosines = np.array([[oracles_quant.cosine(f, row) for row in rows] for f in features])
    preferred = sorted({int(cosines[i].argmax()) for i in range(11)})
    assert len(preferred) >= 3
    votes = np.zeros((12, len(rows)))
    for i in range(11):
        shares = np.exp(100 * cosines[i, preferred])
        votes[i, preferred] = shares / shares.sum()
    blended = weights @ votes
    expected = np.where(blended.max(axis=2) > 0, blended.argmax(axis=2), -1)
    margin = np.sort(blended, axis=2)
    clear = (margin[..., -1] - margin[..., -2] > 1e-4) | (margin[..., -1] == 0)
    assert clear.mean() > 0.95
    assert len(set(expected[clear].ravel().tolist())) >= 3
    found = made.segment(view, classes.double()).numpy()
    assert (found == expected)[clear].all()


def test_a_class_that_is_second_everywhere_wins_no_pixel():
    """The front ball votes 0.52 for class 0 and 0.48 for class 2, the one behind it the same for classes 1 and 2. Class 2 has
    the most votes in the sum."""
    features = torch.tensor([[1.0, 0, 0.999], [0, 1, 0.999]])
    one = balls([[0.0, 0, 4], [0, 0, 5]], scale=0.3, opacities=torch.tensor([0.5, 0.9]), features=features)
    labels = SemanticField(one, Linear(torch.eye(3))).segment(camera(), torch.eye(3))
    assert labels[8, 20] == 0
    assert not (labels == 2).any()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mode", MODES)
def test_classify_and_its_scores(mode, rule):
    made = by(rule, field(mode, n=6))
    labels, scores = made.classify(embeddings())
    assert labels.tolist() == [0, 1, 2, 2, 0, 1]
    torch.testing.assert_close(scores, torch.tensor([1.0, 1.0, 0.5**0.5, 0.5**0.5, 1.0, 1.0]))
    assert made.label(embeddings()).labels.tolist() == [0, 1, 2, 2, 0, 1]
    root = 0.5**0.5
    expected = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, root], [0, 0, root], [1, 0, 0], [0, 1, 0]])
    torch.testing.assert_close(made.cosines(7 * embeddings()), expected)  # rows of any length


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("mode", MODES)
def test_gaussians_without_features_belong_to_no_class(mode, rule):
    made = field(mode)
    features = made.latents.clone()
    features[1] = 0
    made = by(rule, replace(made, gaussians=made.gaussians.replace(features=features)))
    labels, scores = made.classify(embeddings())
    assert (labels.tolist(), scores[1]) == ([0, -1, 2, 2], 0)
    assert made.known.tolist() == [True, False, True, True]
    assert made.cosines(embeddings())[1].tolist() == [0, 0, 0]
    assert made.query(embeddings()[1], threshold=-1.0).mask.tolist() == [True, False, True, True]


@pytest.mark.parametrize("mode", MODES)
def test_query_with_and_without_threshold(mode):
    found = field(mode, n=8).query(embeddings()[2], threshold=0.5)
    assert found.mask.tolist() == [False, False, True, True] * 2
    assert found.threshold == 0.5
    assert field(mode, n=8).query(embeddings()[2]).mask.tolist() == [False, False, True, True] * 2


@pytest.mark.parametrize("mode", TRAINED)
def test_a_query_of_fused_answers(mode):
    made = field(mode)
    fused = fuse_views(made, [camera()])
    by_views = fused.query(embeddings()[0], threshold=0.5)
    assert by_views.mask.tolist() == [True, False, False, False]
    assert by_views.scores[0] > 0.99  # its own pixels all point at codeword 0; only those of its neighbour do not
    assert by_views.scores[2:].abs().max() < 0.01
    hidden = made.gaussians
    hidden = hidden.replace(means=torch.cat([-hidden.means[:1], hidden.means[1:]]))  # behind the camera
    unseen = fuse_views(SemanticField(hidden, made.decoder), [camera()])
    assert unseen.query(embeddings()[0], threshold=-1.0).mask.tolist() == [False, True, True, True]
    assert unseen.known.tolist() == [False, True, True, True]
    assert unseen.classify(embeddings()).labels.tolist() == [-1, 1, 2, 2]
    assert unseen.paper.classify(embeddings()).labels.tolist() == [0, 1, 2, 2]  # its own latent says so
    refused(lambda: fuse_views(made, []), "cameras:", "got none")


@pytest.mark.parametrize("mode", MODES)
def test_query_with_negatives(mode):
    made = field(mode)
    for asked in (made, fuse_views(made, [camera()])):
        against = asked.query(embeddings()[2], negatives=embeddings()[:2])
        assert against.mask.tolist() == [False, False, True, True]
        assert against.threshold == 0.5
        assert torch.equal(asked.query(embeddings()[2], embeddings()).scores, against.scores)  # the other classes
    refused(lambda: made.query(embeddings()[0], negatives=torch.ones(2, 5)), "negatives:", "[M, 16]", "got (2, 5)")


@pytest.mark.parametrize("mode", MODES)
def test_feature_map_points_at_the_codewords(mode):
    features = field(mode).feature_map(camera())
    assert features.shape == (16, 40, DIM)
    assert codebook().quantize(features[8, CENTRES]).tolist() == [0, 1, 2, 3]
    assert field(mode).decode(torch.zeros(2, 3, field(mode).decoder.latent)).shape == (2, 3, DIM)


def test_storage_as_table_1_counts_it():
    # Per Gaussian 14 + d float32; codebook 4 x 16; decoder 4-16-16 with biases.
    assert field("decouple", n=10).storage() == 4 * 10 * (14 + DIM)
    assert field("adc", n=10).storage() == 4 * (10 * (14 + DIM) + 4 * DIM)
    decoder = (4 * 16 + 16) + (16 * 16 + 16)
    assert field("adc+sc", n=10).storage() == 4 * (10 * (14 + 4) + 4 * DIM + decoder)
    assert field("fused", n=10).storage() == 4 * (10 * (14 + 4) + DIM * 4)  # the basis
    assert fuse_views(field("adc+sc", n=10), [camera()]).storage() == field("adc+sc", n=10).storage()


def test_summary_names_counts_size_and_teacher():
    text = field("adc+sc", n=10).summary()
    assert "SemanticField(decouple+ADC+SC: 10 Gaussians, 4 channels for 16)" in text
    assert f"{field('adc+sc', n=10).storage() / MIB:.2f} MiB" in text
    assert "seconds: 1.5" in text
    assert "teacher" not in text
    known = replace(field("adc+sc", n=10), info={"teacher": {"name": "lseg", "weights": "3f2a"}})
    assert "\n  teacher: lseg" in known.summary()
    assert "(fused: 10 Gaussians, 4 channels for 16)" in field("fused", n=10).summary()


def test_parts_must_belong_together():
    refused(lambda: SemanticField(field().gaussians.replace(features=None), decoder("adc")), "gaussians:", "got None")
    refused(lambda: SemanticField(field().gaussians, decoder("adc")), "gaussians.features:", "[N, 16]", "got (4, 4)")
    refused(lambda: Autoencoded(Codebook(torch.eye(5)), autoencoder()), "autoencoder:", "expected 5", "got 16")
    refused(lambda: SemanticField(field("adc").gaussians, decoder("fused")), "gaussians.features:", "got (4, 16)")
    with pytest.raises(ValueError, match=tells("fused:", "the same Gaussians")):
        SemanticField(field("adc").gaussians, decoder("adc"), fused=field("fused", n=5))


def test_some_gaussians_of_a_field():
    whole = fuse_views(field("adc", n=6), [camera()])
    part = whole.select(torch.tensor([3, 1]))
    assert torch.equal(part.latents, whole.latents[[3, 1]])
    assert torch.equal(part.fused.latents, whole.fused.latents[[3, 1]])


@pytest.mark.parametrize("mode", MODES)
def test_wrong_embeddings(mode):
    made = field(mode)
    refused(lambda: made.classify(torch.ones(2, 5)), "embeddings:", "[C, 16]", "got (2, 5)")
    refused(lambda: made.segment(camera(), torch.ones(2, 5)), "embeddings:", "[C, 16]", "got (2, 5)")
    refused(lambda: made.query(torch.ones(5)), "embedding:", "[16]", "got (5,)")


@pytest.mark.parametrize("mode", MODES)
def test_another_dtype_gives_the_same_answers(mode):
    one = replace(field(mode, n=8), cameras=(a_camera(),))
    other = one.to(torch.float64)
    assert {other.gaussians.means.dtype, other.latents.dtype, other.cameras[0].K.dtype} == {torch.float64}
    assert one.gaussians.means.dtype == torch.float32  # the field itself stays
    camera = a_camera(24, 18)
    for a, b in [(one.paper, other.paper), *([(one, other)] if mode == "fused" else [])]:
        assert b.classify(embeddings()).labels.equal(a.classify(embeddings()).labels)
        assert b.segment(camera.to(torch.float64), embeddings()).equal(a.segment(camera, embeddings()))
    assert other.to(torch.float32).latents.equal(one.latents)


def test_fields_with_other_latents_are_not_joined():
    cloud = gaussians_before(a_camera(8, 8), 2, seed=0).replace(features=torch.ones(2, 3), sh=None)
    fields = [SemanticField(cloud, Linear(basis)) for basis in (torch.eye(3), torch.eye(3).flip(0))]
    refused(lambda: join_fields(fields), "fields:", "same latents", "sample_latents")
