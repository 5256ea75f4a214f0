"""One projection to colours for a field of any kind, fitted to what its codewords look like in the field."""

import numpy as np
import pytest
import torch
from cases_explorer import classes, field

from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians
from kfgs.pipeline import feature_colors
from kfgs.quant import Autoencoder, Codebook
from kfgs.viz import FeatureColors
from kfgs.viz.explorer.exploration import Exploration
from kfgs.viz.explorer.meaning import FieldMeaning

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
    with pytest.raises(ValueError, match=r"features: expected at least one row of finite numbers, got \(0, 6\)"):
        feature_colors(SemanticField(gaussians(torch.zeros(0, 6))))


def test_gaussians_that_were_never_learnt_shape_no_colours():
    features = torch.rand(9, 6, generator=torch.Generator().manual_seed(0)) + 1
    colors = feature_colors(SemanticField(gaussians(torch.cat([features, torch.zeros(90, 6)]))))
    np.testing.assert_array_equal(colors(features), FeatureColors.fit(features)(features))
    nothing = feature_colors(SemanticField(gaussians(torch.zeros(3, 6))))
    assert len(np.unique(nothing(torch.zeros(3, 6)))) == 1


@pytest.mark.parametrize("mode", ["decouple", "adc", "adc+sc"])
def test_the_explorer_has_the_colours_of_rendered_views(mode):
    made = field(mode)
    state = Exploration(FieldMeaning(made, classes()))
    state.set_show("latents")
    learnt = made.features.any(dim=1).numpy()
    assert 0 < learnt.sum() < len(made)
    np.testing.assert_array_equal(state.colors("semantic")[learnt], feature_colors(made)(made.features)[learnt])
