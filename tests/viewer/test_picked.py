import numpy as np
import pytest
from cases_explorer import cameras, grid, line

from kfgs.viewer import picked as picked_module


def test_a_picked_gaussian_says_what_is_known_of_it():
    made = line(cameras=cameras(1))
    picked = made.pick("color", 2)
    assert picked == made.picked
    assert (picked.side, picked.index, picked.name, picked.label) == ("color", 2, "table", 2)
    assert picked.score == pytest.approx(0.6)
    assert picked.position == (2.5, 0, 5)
    assert picked.opacity == pytest.approx(0.9)
    assert (picked.source, picked.distance) == (1, 0.5)
    assert picked.neighbours[:2] == [(1, 1.5, None), (0, 2.25, "chair")]
    assert made.pick("color", 0).views[0].name == "view_0"
    lines = picked.lines()
    assert lines[0] == "colour Gaussian 2: table, score 0.600"
    assert lines[1] == "at (2.500, 0.000, 5.000), opacity 0.90"
    assert lines[2] == "label from semantic Gaussian 1, 0.5 away"
    assert lines[3].startswith("near it: no class 1.5, chair 2.2")


def test_of_many_views_some_are_asked_who_sees_it(monkeypatch):
    monkeypatch.setattr(picked_module, "MOST_VIEWS", 2)
    views = cameras(9)
    made = line(cameras=views)
    assert sorted((s.index, s.name) for s in made.pick("semantic", 0).views) == [(0, "view_0"), (8, "view_8")]


def test_a_pick_follows_the_question_and_lambda():
    made = line()
    made.pick("color", 2)
    made.ask("chair")
    assert made.picked.score is None  # nothing is known of how far the table is a chair
    made.set_distance(0.1)
    assert (made.picked.label, made.picked.name, made.picked.source) == (-1, None, 1)
    assert made.picked.lines()[0] == "colour Gaussian 2: no class"
    assert made.picked.lines()[2] == "nearest labelled semantic Gaussian 1, 0.5 away: out of reach"
    made.pick("semantic", 0)
    assert made.picked.source is None
    assert made.picked.score == pytest.approx(0.8)
    made.drop_pick()
    assert made.picked is None


def test_a_pick_that_is_then_hidden_is_none_until_it_is_drawn_again():
    made = line()
    made.pick("semantic", 1)
    made.set_hidden([2])
    assert made.picked is None
    made.set_hidden([1])
    assert made.picked.index == 1


def test_a_pick_says_the_same_as_the_whole_side():
    made = grid(np.linspace(0, 1, 150, dtype=np.float32))
    for words in (None, "chair", "table"):
        made.ask(words)
        for side in made.sides:
            labels, scores = made.labels(side), made.scores(side)
            for index in range(0, 140, 7):
                picked = made.pick(side, index)
                assert picked.label == labels[index]
                assert picked.score == pytest.approx(scores[index]) or np.isnan(scores[index]) == (picked.score is None)
