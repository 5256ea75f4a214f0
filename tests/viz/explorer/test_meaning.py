from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_explorer import DIM, MODES, NAMES, cameras, classes, cloud, codebook, field, splat_file

from kfgs.fields import SemanticField
from kfgs.viz.explorer import evidence, meaning
from kfgs.viz.explorer.exploration import Exploration
from kfgs.viz.explorer.meaning import FieldMeaning, SplatMeaning

VIEWS = [(), tuple(cameras())]


def embed(words):
    """An encoder that knows how to place any words between two codewords."""
    return 0.3 * codebook().codewords[len(words) % 12] + codebook().codewords[4]


def same_answer(asked, found):
    assert torch.equal(asked.selection.mask, found.mask)
    torch.testing.assert_close(asked.selection.scores, found.scores, rtol=0, atol=2e-6)
    assert asked.selection.threshold == pytest.approx(found.threshold, abs=1e-4)
    assert asked.selection.how == found.how


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("views", VIEWS, ids=["own", "views"])
def test_labels_are_those_of_the_field(mode, views):
    made = FieldMeaning(field(mode), classes(), cameras=views)
    if views:
        labels, scores, _ = field(mode).classify_by_views(classes().embeddings, views, decode="latent")
    else:
        labels, scores = field(mode).classify(classes().embeddings)
    assert torch.equal(made.gaussians.labels, labels)
    torch.testing.assert_close(made.scores, scores, rtol=0, atol=2e-6)
    assert len(set(labels.tolist())) == 5  # all four classes, and none
    assert made.names == NAMES
    assert made.by == ("votes of 3 views" if views else "each Gaussian's own latent (Sec. 3.4)")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("views", VIEWS, ids=["own", "views"])
def test_a_class_is_told_from_the_others_as_query_does(mode, views):
    made, given = FieldMeaning(field(mode), classes(), cameras=views), classes()
    for index, name in enumerate(NAMES):
        others = given.embeddings[[i for i in range(4) if i != index]]
        found = field(mode).query(given.embeddings[index], negatives=others, cameras=views or None)
        asked = made.ask(name)
        same_answer(asked, found)
        assert len(found) > 0
        assert (asked.words, asked.low, asked.high, asked.known) == (name, 0.0, 1.0, True)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("views", VIEWS, ids=["own", "views"])
def test_a_phrase_is_told_from_the_canonical_words(mode, views):
    given = classes()
    made = FieldMeaning(field(mode), given, cameras=views, embed=embed)
    asked = made.ask("a red thing")
    same_answer(asked, field(mode).query(embed("a red thing"), negatives=given.negatives, cameras=views or None))
    assert (asked.known, made.phrases) == (False, True)
    # a canonical word is not told from itself
    own = field(mode).query(embed("Stuff"), negatives=given.negatives[:1], cameras=views or None)
    same_answer(made.ask("Stuff"), own)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("views", VIEWS, ids=["own", "views"])
def test_without_negatives_the_cosine_counts_and_gamma_comes_from_the_scores(mode, views):
    made = FieldMeaning(field(mode), classes(1, negatives=False), cameras=views)
    found = field(mode).query(classes().embeddings[0], cameras=views or None)
    asked = made.ask("wall")
    same_answer(asked, found)
    own = asked.selection.scores[asked.valid]
    assert asked.low == pytest.approx(float(own.min()))
    assert asked.high == pytest.approx(float(own.max()))
    assert asked.low < asked.selection.threshold < asked.high
    # what nothing is known of is never selected, however low gamma is
    lowest = field(mode).query(classes().embeddings[0], -1.0, cameras=views or None)
    assert torch.equal((asked.selection.scores > -1.0) & asked.valid, lowest.mask)
    assert not bool(asked.valid[2 if views else 0])


@pytest.mark.parametrize("mode", MODES)
def test_one_pass_over_the_views_answers_every_class(mode, monkeypatch):
    count, render = [], SemanticField.render
    monkeypatch.setattr(SemanticField, "render", lambda *args, **kw: count.append(1) or render(*args, **kw))
    made = FieldMeaning(field(mode), classes(), cameras=cameras(), embed=embed)
    for name in NAMES:
        made.ask(name)
    assert len(count) == 3
    first = made.ask("a red thing")
    assert len(count) == (6 if mode == "decouple" else 3)  # without codebook a phrase takes a pass of its own
    assert made.ask(" a red thing") is first
    assert len(count) == (6 if mode == "decouple" else 3)


def test_many_views_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(meaning, "MOST_VIEWS", 3)
    views = cameras(9)
    some = FieldMeaning(field(), classes(), cameras=[views[0], views[4], views[8]])
    made = FieldMeaning(field(), classes(), cameras=views)
    assert made.by == "votes of 3 views"
    assert torch.equal(made.scores, some.scores)


def test_codewords_a_few_at_a_time_change_nothing(monkeypatch):
    whole = evidence.SeenCodewords.of(field(), cameras())
    monkeypatch.setattr(evidence, "SIGNAL", 1)  # eight at a time
    parts = evidence.SeenCodewords.of(field(), cameras())
    assert int((whole.sums.sum(dim=0) > 0).sum()) > 8
    assert torch.equal(whole.sums, parts.sums)
    assert torch.equal(whole.weights, parts.weights)


def test_words_are_found_whatever_their_case_and_kept():
    made = FieldMeaning(field(), classes())
    assert made.ask("CHAIR ").words == "chair"
    assert made.ask("chair") is made.ask("Chair")


def test_words_that_cannot_be_answered():
    made = FieldMeaning(field(), classes())
    with pytest.raises(ValueError, match=r"got 'chiar'; did you mean 'chair'.*other words need the teacher's text enc"):
        made.ask("chiar")
    with pytest.raises(ValueError, match="class: expected one of wall, chair, table, office chair, got ''"):
        FieldMeaning(field(), classes(), embed=embed).ask("  ")
    short = FieldMeaning(field(), classes(), embed=lambda words: torch.ones(DIM - 1))
    with pytest.raises(ValueError, match=r"embed: expected \[16\] \(from the field\) for 'sofa', got \(15,\)"):
        short.ask("sofa")


def test_classes_of_another_teacher():
    wide = replace(classes(negatives=False), embeddings=torch.ones(4, DIM + 1))
    with pytest.raises(
        ValueError, match=r"classes: expected embeddings \[C, 16\] \(from the field\), got \(4, 17\): text"
    ):
        FieldMeaning(field(), wide)
    ours = SemanticField(*[getattr(field("decouple"), part) for part in ("gaussians", "codebook", "autoencoder")])
    ours.info["teacher"] = {"name": "lseg"}
    with pytest.warns(UserWarning, match="field's teacher"):
        FieldMeaning(ours, replace(classes(), info={"teacher": {"name": "clip"}}))


def test_scores_that_are_all_the_same_still_have_a_range():
    same = field("decouple")
    alike = SemanticField(same.gaussians.replace(features=torch.ones(80, DIM)))
    asked = FieldMeaning(alike, classes(1, negatives=False)).ask("wall")
    assert asked.low < asked.high
    assert asked.low <= asked.selection.threshold <= asked.high


LABELS = [1, 1, 3, -1, 0]
LINE = [[float(i), 0, 0] for i in range(5)]


def test_a_splat_is_asked_by_class():
    made = SplatMeaning(splat_file(cloud(LINE, LABELS)))
    asked = made.ask("Chair")
    assert asked.words == "chair"
    assert asked.selection.indices.tolist() == [0, 1]
    assert asked.selection.scores.tolist() == [1, 1, 0, 0, 0]
    assert (asked.low, asked.high, asked.selection.threshold) == (0.0, 1.0, 0.0)
    assert made.scores.tolist() == [1] * 5
    assert (made.by, made.phrases) == ("the file's classes", False)
    assert len(made.ask("table").selection) == 0  # a class of which there is none
    with pytest.raises(ValueError, match="got 'chairs'; did you mean 'chair'"):
        made.ask("chairs")


def test_scores_of_a_splat():
    made = SplatMeaning(splat_file(cloud(LINE, LABELS), np.array([0.8, 0.9, 0.5, 0.1, 0.7], np.float32)))
    asked = made.ask("chair")
    assert asked.selection.scores.tolist() == pytest.approx([0.8, 0.9, 0, 0, 0])
    assert (asked.low, asked.high) == (0.0, 1.0)
    assert made.by == "the file's classes and scores"


def test_cosines_below_zero_and_missing_scores_still_select_the_whole_class():
    made = SplatMeaning(splat_file(cloud(LINE, LABELS), np.array([-0.2, np.nan, 0.5, 0.1, 0.7], np.float32)))
    asked = made.ask("chair")
    assert asked.selection.indices.tolist() == [0, 1]  # a score that is missing counts as the least
    assert asked.low < asked.high == pytest.approx(-0.2)
    assert asked.valid.tolist() == [True, True, False, False, False]


def test_splats_without_labels_or_names():
    with pytest.raises(ValueError, match=r"splats.gaussians.labels: expected labels \[N\] to ask for, got None; label"):
        SplatMeaning(splat_file(cloud(LINE)))
    made = SplatMeaning(splat_file(cloud(LINE, LABELS)).replace(classes=("wall",)))
    assert made.names == ("wall", "class 1", "class 2", "class 3")
    assert made.ask("class 3").selection.indices.tolist() == [2]


def test_classes_of_one_name_are_one():
    made = SplatMeaning(splat_file(cloud(LINE, LABELS)).replace(classes=("wall", "chair", "rug", "chair")))
    assert made.ask("chair").selection.indices.tolist() == [0, 1, 2]


@pytest.mark.parametrize("score", [0.0, 1.0, 100.0, 300.0, 65536.0, 1e30, -5e6])
def test_all_of_a_class_answer_where_their_scores_are_equal(score):
    """float32 has no number between 300 and 300 - 1e-5."""
    made = SplatMeaning(splat_file(cloud(torch.rand(50, 3), [1] * 30 + [0] * 20), np.full(50, score, np.float32)))
    asked = made.ask("chair")
    assert asked.selection.mask.tolist() == [True] * 30 + [False] * 20
    assert asked.low == asked.selection.threshold < asked.high
    state = Exploration(made)
    state.ask("chair")
    state.set_show("score")
    assert state.selected("semantic").sum() == 30
    assert len(state.colors("semantic")) == 50
    state.set_gamma(state.gamma_range[1])
    assert not state.selected("semantic").any()
