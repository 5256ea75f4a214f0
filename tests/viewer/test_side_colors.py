import numpy as np
import pytest
import torch
from cases_explorer import LINE, cloud, line, splat_file
from matplotlib import colormaps
from messages import tells

from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration
from kfgs.viz import FeatureColors, palette

GREY = [128, 128, 128]


def test_colours_of_labels_and_scores():
    made = line()
    assert made.colors("semantic").tolist() == palette(np.array([1, 2, -1]), made.meaning.names).tolist()
    assert made.colors("color").tolist() == palette(np.array([1, -1, 2, -1, -1]), made.meaning.names).tolist()
    made.set_show("score")
    np.testing.assert_allclose(made.scores("semantic"), [0.8, 0.6, np.nan], rtol=1e-6)  # of the labels
    assert made.clim == (pytest.approx(0.6), pytest.approx(0.8))
    bright, dark = (list(colormaps["cividis"](end, bytes=True)[:3]) for end in (1.0, 0.0))
    assert made.colors("semantic").tolist() == [bright, dark, GREY]
    assert made.colors("color").tolist() == [bright, GREY, dark, GREY, GREY]
    made.ask("chair")
    assert made.clim == (0.0, 1.0)
    at = list(colormaps["cividis"](np.float64(np.float32(0.8)), bytes=True)[:3])
    assert made.colors("semantic").tolist() == [at, GREY, GREY]  # nothing is known of how far the table is a chair
    assert made.colors("color").tolist() == [at, GREY, GREY, GREY, GREY]


def test_colours_of_the_other_side_and_of_latents():
    made = line()
    assert made.show_choices == ("labels", "rgb", "latents", "score")
    made.set_show("rgb")
    assert made.colors("color").tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 0, 0]]
    assert made.colors("semantic").tolist() == [[255, 0, 0], [0, 0, 255], [255, 255, 0]]  # the nearest one's
    made.set_show("latents")
    expected = FeatureColors.fit(torch.eye(3))(torch.eye(3)).tolist()
    assert made.colors("semantic").tolist() == expected
    assert made.colors("color").tolist() == [expected[0], GREY, expected[1], GREY, GREY]


def test_latents_that_were_never_learnt_are_grey():
    features = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    made = Exploration(SplatMeaning(splat_file(cloud(torch.eye(4)[:, :3], [0, 1, 2, 3], features=features))))
    made.set_show("latents")
    assert made.colors("semantic")[0].tolist() == GREY
    assert made.colors("semantic")[1:].tolist() == FeatureColors.fit(features[1:])(features[1:]).tolist()
    nothing = splat_file(cloud(torch.eye(3), [0, 1, 2], features=torch.zeros(3, 2)))
    blank = Exploration(SplatMeaning(nothing))
    blank.set_show("latents")
    assert blank.colors("semantic").tolist() == [GREY] * 3


def test_what_no_cloud_has_cannot_be_shown():
    plain = Exploration(SplatMeaning(splat_file(cloud(torch.eye(3), [0, 1, 2]))))
    assert (plain.sides, plain.show_choices) == (("semantic",), ("labels", "score"))
    with pytest.raises(ValueError, match=tells("show:", "labels, score", "harmonics", "got 'rgb'")):
        plain.set_show("rgb")
    with pytest.raises(ValueError, match=tells("show:", "features", "got 'latents'")):
        plain.set_show("latents")
    with pytest.raises(ValueError, match=tells("show:", "'labels', 'rgb', 'score', 'latents'", "got 'depth'")):
        plain.set_show("depth")
    with pytest.raises(ValueError, match=tells("side:", "'semantic'", "got 'color'")):
        plain.labels("color")
    bare = Exploration(SplatMeaning(splat_file(cloud(torch.eye(3), [0, 1, 2], sh=torch.zeros(3, 1, 3)))), cloud(LINE))
    bare.set_show("rgb")
    assert bare.colors("color").tolist() == [[128, 128, 128]] * 4  # sh of 0 is a middle grey
    assert "latents" not in bare.show_choices


def test_none_labelled_leaves_the_colour_side_grey():
    made = Exploration(SplatMeaning(splat_file(cloud(LINE, [-1] * 4, features=torch.eye(4)))), cloud(LINE))
    for show in made.show_choices:
        made.set_show(show)
        assert made.colors("color").tolist() == [GREY] * 4
    assert made.details()["color"]["orphaned"] == 4
    assert made.pick("color", 1).source is None
    made.ask("chair")
    assert not made.selected("semantic").any()
