from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_explorer import (
    DIM,
    NAMES,
    cameras,
    classes,
    cloud,
    codebook,
    field,
    splat_file,
)
from messages import tells

from kfgs.fields import fuse_views
from kfgs.viewer.meaning import FieldMeaning, SplatMeaning

HOWS = [*((mode, how) for mode in ("decouple", "adc+sc") for how in ("own", "views", "answered")), ("fused", "fused")]
KINDS = pytest.mark.parametrize(("mode", "how"), HOWS, ids=[f"{mode}-{how}" for mode, how in HOWS])
BY = {
    "own": "each Gaussian's own latent (Sec. 3.4)",
    "views": "what 3 views show of each Gaussian",
    "answered": "what the training views show of each Gaussian",
    "fused": "what the training views show of each Gaussian",
}


def asked_and_answering(mode, how):
    """What the explorer is given, and the field whose `query` it must agree with.

    `own`: a trained field and no views. `views`: a trained field, and views to find its answers from. `answered`: a trained
    field that has its answers; other views must not change them. `fused`: a field that needs none.
    """
    made = field(mode)
    if how in ("own", "fused"):
        return (made, ()), made
    answered = fuse_views(made, cameras())
    return ((made, cameras()), answered) if how == "views" else ((answered, cameras(1)), answered)


def embed(words):
    """An encoder that knows how to place any words between two codewords."""
    return 0.3 * codebook().codewords[len(words) % 12] + codebook().codewords[4]


def same_answer(asked, found):
    """The very same Gaussians, scores, gamma and reason."""
    assert torch.equal(asked.selection.mask, found.mask)
    assert torch.equal(asked.selection.scores, found.scores)
    assert (asked.selection.threshold, asked.selection.how) == (found.threshold, found.how)


@KINDS
def test_labels_are_those_of_the_field(mode, how):
    (source, views), answering = asked_and_answering(mode, how)
    made = FieldMeaning(source, classes(), cameras=views)
    found = answering.classify(classes())
    assert torch.equal(made.gaussians.labels, found.labels)
    assert torch.equal(made.scores, found.scores)
    assert len(set(found.labels.tolist())) == 5  # all four classes, and none
    assert (made.names, made.by) == (NAMES, BY[how])


@KINDS
def test_a_class_is_answered_as_query_answers_its_name(mode, how):
    (source, views), answering = asked_and_answering(mode, how)
    made, given = FieldMeaning(source, classes(), cameras=views), classes()
    for index, name in enumerate(NAMES):
        asked, found = made.ask(name), answering.query(name, given)
        same_answer(asked, found)
        others = given.embeddings[[i for i in range(4) if i != index]]
        same_answer(asked, answering.query(given.embeddings[index], given, negatives=others))
        same_answer(asked, answering.query(given.embeddings[index], given))  # a class's own embedding is that class
        assert len(found) > 0
        assert (asked.words, asked.low, asked.high, asked.known) == (name, 0.0, 1.0, True)
        assert torch.equal(asked.valid, answering.known)


@KINDS
def test_a_phrase_is_told_from_the_canonical_words(mode, how):
    (source, views), answering = asked_and_answering(mode, how)
    given = classes()
    made = FieldMeaning(source, given, cameras=views, embed=embed)
    asked = made.ask("a red thing")
    same_answer(asked, answering.query(embed("a red thing"), given))
    same_answer(asked, answering.query(embed("a red thing"), given, negatives=given.negatives))
    assert (asked.low, asked.high, asked.known, made.phrases) == (0.0, 1.0, False, True)


@KINDS
def test_without_negatives_the_cosine_counts_and_gamma_comes_from_the_scores(mode, how):
    (source, views), answering = asked_and_answering(mode, how)
    given = classes(1, negatives=False)
    asked = FieldMeaning(source, given, cameras=views).ask("wall")
    same_answer(asked, answering.query("wall", given))
    own = asked.selection.scores[asked.valid]
    assert (asked.low, asked.high) == (float(own.min()), float(own.max()))
    assert asked.low < asked.selection.threshold < asked.high
    # what nothing is known of is never selected, however low gamma is
    lowest = answering.query("wall", given, -1.0)
    assert torch.equal((asked.selection.scores > -1.0) & asked.valid, lowest.mask)
    assert not bool(asked.valid[2 if how in ("views", "answered") else 0])


def test_a_field_without_answers_finds_them_from_its_own_cameras():
    made = replace(field(), cameras=tuple(cameras()))
    opened = FieldMeaning(made, classes())
    assert opened.by == BY["views"]
    same_answer(opened.ask("chair"), fuse_views(field(), cameras()).query("chair", classes()))


def test_a_field_that_remembers_no_classes_needs_some():
    with pytest.raises(ValueError, match=tells("classes:", "got none")):
        FieldMeaning(field())


def test_words_that_cannot_be_answered():
    made = FieldMeaning(field(), classes())
    with pytest.raises(ValueError, match=tells("class:", "got 'chiar'", "'chair'")):
        made.ask("chiar")
    with pytest.raises(ValueError, match=tells("class:", "wall, chair, table", "got ''")):
        FieldMeaning(field(), classes(), embed=embed).ask("  ")
    short = FieldMeaning(field(), classes(), embed=lambda words: torch.ones(DIM - 1))
    with pytest.raises(ValueError, match=tells("embed:", "[16]", "'sofa'", "got (15,)")):
        short.ask("sofa")


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
    with pytest.raises(ValueError, match=tells("class:", "got 'chairs'", "'chair'")):
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
    with pytest.raises(ValueError, match=tells("splats.labels:", "[N]", "got None", "`kfgs attach`")):
        SplatMeaning(splat_file(cloud(LINE)))
    with pytest.raises(ValueError, match=tells("class:", "got 'zebra'; take one of these classes")):
        SplatMeaning(splat_file(cloud(LINE, LABELS))).ask("zebra")
    made = SplatMeaning(splat_file(cloud(LINE, LABELS)).replace(names=("wall",)))
    assert made.names == ("wall", "class 1", "class 2", "class 3")
    assert made.ask("class 3").selection.indices.tolist() == [2]
