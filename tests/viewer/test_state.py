import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_explorer import LINE, cameras, cloud, grid, grid_clouds, line, splat_file
from messages import refused, tells

from kfgs.cameras import Distortion
from kfgs.labels import nearest_labels
from kfgs.viewer.meaning import SplatMeaning
from kfgs.viewer.state import Exploration


@pytest.mark.parametrize("distance", [0.5, 1.0, 1.5, 2**0.5, 2.0, 3.3, 100.0])
def test_the_colour_side_is_labelled_as_transfer_labels_does(distance):
    semantic, color = grid_clouds()
    made = grid()
    made.set_distance(distance)
    expected = nearest_labels(semantic.means, semantic.labels, color.means, distance)
    assert made.labels("color").tolist() == expected.labels.tolist()
    assert made.details()["color"]["none"] == expected.orphaned
    made.ask("chair")
    scores = made.meaning.ask("chair").selection.scores
    reached = expected.sources >= 0
    sources = expected.sources.clamp_min(0)
    mask = made.meaning.ask("chair").selection.mask
    assert made.selected("color").tolist() == (mask[sources] & reached).tolist()
    known = (semantic.labels == 1)[sources] & reached
    expected_scores = torch.where(known, scores[sources], torch.nan)
    np.testing.assert_array_equal(made.scores("color"), expected_scores.double().numpy())


def test_lambda_without_a_number_is_that_of_transfer_labels():
    semantic, color = grid_clouds()
    expected = nearest_labels(semantic.means, semantic.labels, color.means)
    made = grid()
    assert (made.distance, made.distance_how) == (expected.distance, expected.how)
    assert made.distance_range == (made.distance / 30, made.distance * 30)
    assert grid(distance=1000.0).distance_range[1] == 1000.0
    given = grid(distance=0.7)
    assert (given.distance, given.distance_how) == (0.7, "given")


def test_lambda_is_strict():
    made = line(1.0)
    assert made.labels("color").tolist() == [1, -1, 2, -1, -1]  # the second is exactly 1 from the chair
    made.set_distance(1.0001)
    assert made.labels("color").tolist() == [1, 1, 2, -1, -1]
    made.set_distance(3.5)
    assert made.labels("color").tolist() == [1, 1, 2, 2, -1]  # what has no class gives none, and hides none behind it
    made.set_distance(1e-6)
    assert made.labels("color").tolist() == [-1] * 5


def test_gamma_selects_on_both_sides():
    made = line()
    asked = made.ask("chair")
    assert (made.gamma, made.gamma_range) == (asked.selection.threshold, (0.0, 1.0))
    assert made.selected("semantic").tolist() == [True, False, False]
    assert made.selected("color").tolist() == [True, False, False, False, False]
    made.set_gamma(0.85)
    assert (made.gamma, made.gamma_how) == (0.85, "given")
    assert not made.selected("semantic").any()
    assert not made.selected("color").any()
    made.set_gamma(1 + 1e-8)  # a slider's rounding
    assert made.gamma == 1.0
    refused(lambda: made.ask("chiar"), "class:", "'chair'", "got 'chiar'")
    assert made.asked.words == "chair"  # that of before stays
    assert made.ask("") is None
    assert (made.asked, made.gamma, made.gamma_range) == (None, None, (0.0, 1.0))
    assert not made.selected("color").any()


def test_numbers_out_of_range():
    made = line()
    refused(lambda: made.set_gamma(0.5), "gamma:", "got none", "0.5")
    made.ask("chair")
    for gamma in (-0.1, 1.1, float("nan")):
        refused(lambda gamma=gamma: made.set_gamma(gamma), "gamma:", f"got {gamma}")
    assert made.gamma == 0.0
    for distance in (0.0, -1.0, float("inf"), float("nan")):
        refused(lambda distance=distance: made.set_distance(distance), "distance:", "(0, inf)", f"got {distance}")
    assert made.distance == 1.0


def test_clouds_that_cannot_be_explored():
    with pytest.raises(ValueError, match=tells("color:", "got none")):
        Exploration(SplatMeaning(splat_file(cloud(LINE, [0] * 4))), cloud(torch.zeros(0, 3)))
    bent = replace(cameras()[0], distortion=Distortion("kannala_brandt", (0.1, 0, 0, 0)))
    refused(lambda: line(cameras=[bent]), "cameras:", "got kannala_brandt", "('view_0')")
    hole = cloud(LINE).replace(means=torch.full((4, 3), torch.nan))
    refused(lambda: Exploration(SplatMeaning(splat_file(cloud(LINE, [0] * 4))), hole), "color.means:", "got NaN")
    labelled = hole.replace(labels=torch.zeros(4, dtype=torch.int64))
    refused(lambda: Exploration(SplatMeaning(splat_file(labelled))), "semantic.means:", "got NaN")


def test_facts_are_json_and_lines_say_them():
    made = line()
    made.ask("chair")
    facts = json.loads(json.dumps(made.details(), allow_nan=False))
    assert (facts["words"], facts["gamma"], facts["lambda"]) == ("chair", 0.0, 1.0)
    assert (facts["gamma_how"], facts["by"]) == ("all of the class", "the file's classes and scores")
    assert facts["semantic"]["classes"] == [["wall", 0], ["chair", 1], ["table", 1], ["office chair", 0]]
    assert [facts["color"][key] for key in ("total", "selected", "none")] == [5, 1, 3]
    assert made.lines()[2:] == [
        "colour: 1 of 5 Gaussians",
        "3 of 5 colour Gaussians are farther than lambda = 1 from any labelled one, so they have no class",
    ]
    made.ask(None)
    assert made.lines()[0] == "semantic: 3 Gaussians"
