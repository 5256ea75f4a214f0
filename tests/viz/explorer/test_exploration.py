import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_explorer import NAMES, cameras, cloud, field, grid_clouds, splat_file
from cases_explorer import classes as some_classes
from matplotlib import colormaps

from kfgs.cameras import Distortion
from kfgs.formats import read_splats
from kfgs.labels import answers, transfer_labels
from kfgs.splat import rgb_to_sh0
from kfgs.viz import FeatureColors, palette
from kfgs.viz.explorer import picked as picked_module
from kfgs.viz.explorer import saved
from kfgs.viz.explorer.exploration import Exploration
from kfgs.viz.explorer.meaning import FieldMeaning, SplatMeaning

GREY = [128, 128, 128]


def grid(score=None, **options):
    semantic, color = grid_clouds()
    return Exploration(SplatMeaning(splat_file(semantic, score)), color, **options)


def line(distance=1.0, **options):
    """Three semantic Gaussians on a line, a chair, a table and one of no class; five colour Gaussians beside it."""
    sh = rgb_to_sh0(torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 0, 0]]))[:, None]
    semantic = cloud([[0.0, 0, 5], [3, 0, 5], [6, 0, 5]], [1, 2, -1], features=torch.eye(3))
    color = cloud([[0.25, 0, 5], [1, 0, 5], [2.5, 0, 5], [6, 0, 5], [60, 0, 5]], sh=sh)
    made = SplatMeaning(splat_file(semantic, np.array([0.8, 0.6, 0.4], np.float32)))
    return Exploration(made, color, distance=distance, **options)


@pytest.mark.parametrize("distance", [0.5, 1.0, 1.5, 2**0.5, 2.0, 3.3, 100.0])
def test_the_colour_side_is_labelled_as_transfer_labels_does(distance):
    semantic, color = grid_clouds()
    made = grid()
    made.set_distance(distance)
    expected = transfer_labels(semantic, semantic.labels, color, distance)
    assert made.labels("color").tolist() == expected.labels.tolist()
    assert made.facts()["color"]["orphaned"] == expected.orphaned
    made.ask("chair")
    scores = made.meaning.ask("chair").selection.scores
    reached = expected.sources >= 0
    sources = expected.sources.clamp_min(0)
    mask = made.meaning.ask("chair").selection.mask
    assert made.selected("color").tolist() == (mask[sources] & reached).tolist()
    known = (semantic.labels == 1)[sources] & reached
    expected_scores = torch.where(known, scores[sources], torch.nan)
    np.testing.assert_array_equal(made.scores("color"), expected_scores.double().numpy())


def test_ties_are_many_and_the_distances_those_of_transfer_labels():
    semantic, color = grid_clouds()
    expected = transfer_labels(semantic, semantic.labels, color, 1000.0)
    far = torch.cdist(color.means.double(), semantic.means[semantic.labels >= 0].double())
    assert int(((far == far.amin(dim=1, keepdim=True)).sum(dim=1) > 1).sum()) > 100
    carried = grid()._carried
    assert carried.source.tolist() == expected.sources.tolist()
    np.testing.assert_array_equal(carried.far.astype(np.float32), expected.distances.numpy())


def test_lambda_without_a_number_is_that_of_transfer_labels():
    semantic, color = grid_clouds()
    expected = transfer_labels(semantic, semantic.labels, color)
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


@pytest.mark.parametrize("views", [(), tuple(cameras())], ids=["own", "views"])
def test_any_gamma_of_a_field_is_that_of_query(views):
    made, given = FieldMeaning(field(), some_classes(1, negatives=False), cameras=views), some_classes()
    state = Exploration(made)
    state.ask("wall")
    low, high = state.gamma_range
    for gamma in (low, low + 0.3 * (high - low), low + 0.9 * (high - low)):
        state.set_gamma(gamma)
        found = field().query(given.embeddings[0], gamma + 1e-5, cameras=views or None)
        state.gamma += 1e-5  # away from the least score itself, which rounding may put on either side
        assert state.selected("semantic").tolist() == found.mask.tolist()


def test_a_question_comes_and_goes():
    made = line()
    assert made.asked is None
    assert not made.selected("color").any()
    assert made.gamma_range == (0.0, 1.0)
    made.ask("chair")
    with pytest.raises(ValueError, match="did you mean 'chair'"):
        made.ask("chiar")
    assert made.asked.words == "chair"  # that of before stays
    assert made.ask("") is None
    assert (made.asked, made.gamma) == (None, None)
    made.ask("table")
    assert made.ask(None) is None
    assert not made.selected("semantic").any()


def test_colours_of_labels_and_scores():
    made = line()
    assert made.colors("semantic").tolist() == palette(np.array([1, 2, -1])).tolist()
    assert made.colors("color").tolist() == palette(np.array([1, -1, 2, -1, -1])).tolist()
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
    assert made.shows == ("labels", "rgb", "latents", "score")
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
    assert (plain.sides, plain.shows) == (("semantic",), ("labels", "score"))
    with pytest.raises(ValueError, match=r"show: expected one of labels, score \(no cloud has harmonics.*got 'rgb'"):
        plain.set_show("rgb")
    with pytest.raises(ValueError, match=r"no cloud has features.*got 'latents'"):
        plain.set_show("latents")
    with pytest.raises(ValueError, match="show: expected one of 'labels', 'rgb', 'score', 'latents', got 'depth'"):
        plain.set_show("depth")
    with pytest.raises(ValueError, match="side: expected one of 'semantic', got 'color'"):
        plain.labels("color")
    bare = Exploration(SplatMeaning(splat_file(cloud(torch.eye(3), [0, 1, 2], sh=torch.zeros(3, 1, 3)))), cloud(LINE))
    bare.set_show("rgb")
    assert bare.colors("color").tolist() == [[128, 128, 128]] * 4  # sh of 0 is a middle grey
    assert "latents" not in bare.shows


LINE = [[float(i), 0, 5] for i in range(4)]


def test_the_same_splat_on_both_sides():
    semantic = cloud(LINE, [0, 1, -1, 3], sh=torch.rand(4, 1, 3))
    made = Exploration(SplatMeaning(splat_file(semantic)), semantic)
    made.set_distance(0.5)
    assert made.labels("color").tolist() == [0, 1, -1, 3]
    made.ask("chair")
    assert made.selected("color").tolist() == [False, True, False, False]
    for show in made.shows:
        made.set_show(show)
        if show != "latents":
            assert made.colors("color").tolist() == made.colors("semantic").tolist()


def test_none_labelled_leaves_the_colour_side_grey():
    made = Exploration(SplatMeaning(splat_file(cloud(LINE, [-1] * 4, features=torch.eye(4)))), cloud(LINE))
    for show in made.shows:
        made.set_show(show)
        assert made.colors("color").tolist() == [GREY] * 4
    assert made.facts()["color"]["orphaned"] == 4
    assert made.pick("color", 1).source is None
    made.ask("chair")
    assert not made.selected("semantic").any()


def test_hidden_classes_are_not_drawn():
    made = line()
    assert made.drawn("color").all()
    made.set_hidden([1, -1])
    assert made.drawn("semantic").tolist() == [False, True, False]
    assert made.drawn("color").tolist() == [False, False, True, False, False]
    assert made.hidden == {1, -1}
    made.ask("chair")
    assert made.selected("semantic").tolist() == [True, False, False]  # hiding is not deselecting
    made.set_hidden([])
    assert made.drawn("semantic").all()


def test_numbers_out_of_range():
    made = line()
    with pytest.raises(ValueError, match=r"gamma: expected a question that it applies to, got none \(gamma 0.5\); ask"):
        made.set_gamma(0.5)
    made.ask("chair")
    for gamma in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"gamma: expected a number in \[.*\], got"):
            made.set_gamma(gamma)
    assert made.gamma == 0.0
    for distance in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match=r"distance: expected a number in \(0, inf\), got"):
            made.set_distance(distance)
    with pytest.raises(ValueError, match=r"labels: expected a number in \[-1, 3\], got 4"):
        made.set_hidden([1, 4])
    assert (made.distance, made.hidden) == (1.0, frozenset())
    with pytest.raises(ValueError, match=r"index: expected a number in \[0, 4\], got 5"):
        made.pick("color", 5)


def test_clouds_that_cannot_be_explored():
    with pytest.raises(ValueError, match="color: expected at least one Gaussian, got none; choose another file"):
        Exploration(SplatMeaning(splat_file(cloud(LINE, [0] * 4))), cloud(torch.zeros(0, 3)))
    bent = replace(cameras()[0], distortion=Distortion("kannala_brandt", (0.1, 0, 0, 0)))
    with pytest.raises(
        ValueError, match=r"cameras: expected views without distortion, got kannala_brandt \('view_0'\)"
    ):
        line(cameras=[bent])
    hole = cloud(LINE).replace(means=torch.full((4, 3), torch.nan))
    with pytest.raises(ValueError, match="color.means: expected finite positions, got NaN or infinity in row 0"):
        Exploration(SplatMeaning(splat_file(cloud(LINE, [0] * 4))), hole)
    labelled = hole.replace(labels=torch.zeros(4, dtype=torch.int64))
    with pytest.raises(ValueError, match="meaning.gaussians.means: expected finite positions, got NaN or infinity in"):
        Exploration(SplatMeaning(splat_file(labelled)))
    unlabelled = SplatMeaning(splat_file(cloud(LINE, [0] * 4)))
    unlabelled.gaussians = cloud(LINE)
    with pytest.raises(
        ValueError, match=r"meaning.gaussians.labels: expected labels \[N\], got None; use FieldMeaning"
    ):
        Exploration(unlabelled)


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


def test_facts_are_json_and_lines_say_them():
    made = line()
    made.ask("chair")
    facts = json.loads(json.dumps(made.facts(), allow_nan=False))
    assert facts["words"] == "chair"
    assert (facts["gamma"], facts["gamma_how"]) == (0.0, "all of the class")
    assert (facts["lambda"], facts["lambda_how"], facts["by"]) == (1.0, "given", "the file's classes and scores")
    assert facts["semantic"] == {
        "total": 3,
        "selected": 1,
        "classes": [["wall", 0], ["chair", 1], ["table", 1], ["office chair", 0]],
        "none": 1,
    }
    assert (facts["color"]["total"], facts["color"]["selected"], facts["color"]["orphaned"]) == (5, 1, 3)
    assert made.lines() == [
        "'chair': score > 0 (all of the class)",
        "semantic: 1 of 3 Gaussians",
        "colour: 1 of 5 Gaussians",
        "lambda 1 (given), 3 out of reach",
    ]
    made.ask(None)
    assert made.lines()[0] == "semantic: 3 Gaussians"


def test_a_selection_is_saved_and_read_again(tmp_path):
    semantic = field().gaussians
    color = semantic.replace(features=None, sh=torch.rand(80, 1, 3), means=semantic.means + 0.01)
    made = Exploration(FieldMeaning(field(), some_classes(), cameras=cameras()), color, cameras=cameras())
    made.ask("chair")
    made.set_hidden([1])
    paths = made.save_selection(tmp_path / "new" / "folder")
    names = ["selection.json", "selection_color.ply", "selection_color.ply.classes.json"]
    assert [path.name for path in paths] == [*names, *(name.replace("color", "semantic") for name in names[1:])]
    assert sorted((tmp_path / "new" / "folder").iterdir()) == paths
    for side in made.sides:
        read, mask = read_splats(tmp_path / "new" / "folder" / f"selection_{side}.ply"), made.selected(side)
        assert read.classes == NAMES
        assert read.gaussians.labels.tolist() == made.labels(side)[mask].tolist()
        torch.testing.assert_close(read.gaussians.means, made.cloud(side).means[mask])
        np.testing.assert_allclose(read.extra["score"], made.scores(side)[mask], rtol=1e-6)
    facts = json.loads(paths[0].read_text())
    assert {key: value for key, value in facts.items() if key != "parts"} == made.facts()
    expected = answers(made.cloud("color"), made.selection("color"), cameras())
    assert facts["parts"]["color"] == [part.to_json() for part in expected]
    assert facts["parts"]["color"][0]["best_view"]["camera"].startswith("view_")


def test_the_best_view_is_named_by_its_place_among_all(tmp_path, monkeypatch):
    monkeypatch.setattr(saved, "MOST_VIEWS", 1)
    views = cameras(3)
    made = line(cameras=[views[1], views[0]])
    made.ask("chair")
    whole = json.loads(made.save_selection(tmp_path)[0].read_text())["parts"]["semantic"][0]["best_view"]
    assert (whole["index"], whole["camera"]) == (0, "view_1")
    monkeypatch.setattr(saved, "MOST_VIEWS", 2)
    monkeypatch.setattr(saved, "evenly", lambda count, most: np.array([1]))
    other = json.loads(made.save_selection(tmp_path)[0].read_text())["parts"]["semantic"][0]["best_view"]
    assert (other["index"], other["camera"]) == (1, "view_0")


def test_nothing_selected_writes_nothing(tmp_path):
    made = line()
    with pytest.raises(ValueError, match=r"selection: expected .* got none \(no question is asked\); ask first"):
        made.save_selection(tmp_path / "out")
    made.ask("chair")
    made.set_gamma(0.9)
    with pytest.raises(ValueError, match=r"got none \(score > 0.9 for 'chair'\); ask first, or lower gamma"):
        made.save_selection(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="selection: expected a question, got none; ask for something first"):
        line().selection("color")


def test_saving_whole_or_not_at_all(tmp_path, monkeypatch):
    made, write = line(), saved.write_splats
    made.ask("chair")
    first = made.save_selection(tmp_path)
    before = {path: path.read_bytes() for path in first}

    def fail(path, splats):
        if "color" in path.name:
            raise OSError("disk full")
        return write(path, splats)

    made.ask("table")
    monkeypatch.setattr(saved, "write_splats", fail)
    with pytest.raises(OSError, match="disk full"):
        made.save_selection(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    with pytest.raises(OSError, match="disk full"):
        made.save_selection(tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_files_of_an_older_selection_do_not_stay(tmp_path):
    made = line()
    (tmp_path / "picture.png").write_bytes(b"mine")
    made.ask("chair")
    made.save_selection(tmp_path)
    made.set_distance(1e-6)  # now nothing of the colour side is selected
    paths = made.save_selection(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*(p.name for p in paths), "picture.png"])
    assert not any("color" in path.name for path in paths)
