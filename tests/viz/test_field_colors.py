"""One projection to colours for a field of any kind, fitted to what its codewords look like in the field."""

import numpy as np
import pytest
import torch
from cases_explorer import MODES, cameras, classes, field
from messages import tells

from kfgs._rows import unit_rows
from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians
from kfgs.quant import Autoencoder, Codebook, fit_linear_latents
from kfgs.splat import Rendering
from kfgs.viewer.meaning import FieldMeaning
from kfgs.viewer.state import Exploration
from kfgs.viz import FeatureColors, feature_colors

WORDS = torch.tensor([[2.0, 0, 0, 0, 0], [0, 3, 0, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 1]])
CODER = Autoencoder(
    encoder=((torch.eye(4, 5), torch.zeros(4)),), decoder=((torch.eye(5, 4), torch.zeros(5)),), low=0.0, high=1.0
)


def gaussians(features):
    n = len(features)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(torch.rand(n, 3), quats, torch.full((n, 3), 0.1), torch.full((n,), 0.9), features)


def test_stray_gaussians_shape_no_colours():
    latents = CODER.encode(WORDS)
    stray = torch.full((1, 4), 50.0)
    colors = feature_colors(SemanticField(gaussians(torch.cat([latents, stray])), Codebook(WORDS), CODER))
    np.testing.assert_array_equal(colors(latents), FeatureColors.fit(latents)(latents))
    assert len(np.unique(colors(latents), axis=0)) == 4
    plain = feature_colors(SemanticField(gaussians(torch.cat([WORDS, torch.full((1, 5), 50.0)])), Codebook(WORDS)))
    np.testing.assert_array_equal(plain(WORDS), FeatureColors.fit(WORDS)(WORDS))


def test_without_a_codebook_the_gaussians_themselves_say():
    features = torch.rand(9, 6, generator=torch.Generator().manual_seed(0))
    colors = feature_colors(SemanticField(gaussians(features)))
    np.testing.assert_array_equal(colors(features), FeatureColors.fit(features)(features))


def test_a_field_of_nothing_has_no_colours():
    with pytest.raises(ValueError, match=tells("features:", "got (0, 6)")):
        feature_colors(SemanticField(gaussians(torch.zeros(0, 6))))


def test_gaussians_that_were_never_learnt_shape_no_colours():
    features = torch.rand(9, 6, generator=torch.Generator().manual_seed(0)) + 1
    colors = feature_colors(SemanticField(gaussians(torch.cat([features, torch.zeros(90, 6)]))))
    np.testing.assert_array_equal(colors(features), FeatureColors.fit(features)(features))
    nothing = feature_colors(SemanticField(gaussians(torch.zeros(3, 6))))
    assert len(np.unique(nothing(torch.zeros(3, 6)))) == 1


def fused(n=600, spread=0.5):
    """Unit features of four things, with one direction common to all; blends of pixels made them shorter."""
    generator = torch.Generator().manual_seed(3)
    things = unit_rows(torch.eye(4, 24) + 2 * torch.eye(24)[20])  # cosines of 0.8 with each other
    labels = torch.arange(n) % 4
    features = unit_rows(things[labels] + 0.02 * torch.randn(n, 24, generator=generator))
    linear = fit_linear_latents(features, keep=0.9)
    lengths = 1 - spread * torch.rand(n, generator=generator)
    latents = linear.encode(features) * lengths[:, None]
    return SemanticField(gaussians(torch.cat([latents, torch.zeros(50, linear.latent)])), linear=linear), labels


def test_colours_of_linear_latents_come_from_what_varies_and_not_from_their_length():
    made, labels = fused()
    known = made.features[: len(labels)]
    colors = feature_colors(made)
    fitted = FeatureColors.fit(known)  # the 50 unknown ones count for nothing
    np.testing.assert_array_equal(colors(known), fitted(known))
    seen = colors(known).astype(float)
    centres = np.stack([seen[labels.numpy() == thing].mean(axis=0) for thing in range(4)])
    within = np.stack([seen[labels.numpy() == thing].std(axis=0).max() for thing in range(4)])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + 1e9 * np.eye(4)
    print(apart.min(), within)
    assert apart.min() > 3 * within.max()


def test_a_blend_of_latents_has_the_blend_of_their_colours():
    made, _ = fused(spread=0.0)
    colors, (one, other) = feature_colors(made), made.features[:2]
    inner = made.features[:600].mean(dim=0)  # no channel of its blends is clipped
    one, other = inner + 0.3 * (one - inner), inner + 0.3 * (other - inner)
    blend = colors(0.25 * one + 0.75 * other).astype(float)
    np.testing.assert_allclose(blend, 0.25 * colors(one) + 0.75 * colors(other), atol=1.01)  # three roundings to bytes


def test_the_colours_of_a_trained_field_with_answers_are_those_of_its_latents():
    made = field("adc+sc")
    answered = made.with_answers(cameras())
    np.testing.assert_array_equal(feature_colors(answered)(made.features), feature_colors(made)(made.features))


@pytest.mark.parametrize("mode", MODES)
def test_the_explorer_has_the_colours_of_rendered_views(mode):
    made = field(mode)
    state = Exploration(FieldMeaning(made, classes()))
    state.set_show("latents")
    learnt = made.features.any(dim=1).numpy()
    assert 0 < learnt.sum() < len(made)
    np.testing.assert_array_equal(state.colors("semantic")[learnt], feature_colors(made)(made.features)[learnt])


def test_arrays_are_accepted_and_other_things_named():
    rows = torch.rand(40, 6)
    colors, same = FeatureColors.fit(rows), FeatureColors.fit(rows.numpy())
    np.testing.assert_array_equal(same(rows.numpy()), colors(rows))
    with pytest.raises(TypeError, match=tells("features", "Rendering", ".map")):
        colors(Rendering(rows, rows, None))
    with pytest.raises(TypeError, match=tells("field", "Gaussians", "FeatureColors.fit")):
        feature_colors(gaussians(rows))
