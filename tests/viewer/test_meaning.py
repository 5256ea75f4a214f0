from dataclasses import replace

import numpy as np
import pytest
import torch
from cases_explorer import DIM, NAMES, cameras, classes, cloud, codebook, field, splat_file
from messages import refused, tells

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
def test_labels_classes_and_phrases_are_answered_as_the_field_does(mode, how):
    (source, views), answering = asked_and_answering(mode, how)
    given = classes()
    made, found = FieldMeaning(source, given, cameras=views, embed=embed), answering.classify(given)
    assert torch.equal(made.gaussians.labels, found.labels)
    assert torch.equal(made.scores, found.scores)
    assert len(set(found.labels.tolist())) == 5  # all four classes, and none
    assert (made.names, made.by, made.phrases) == (NAMES, BY[how], True)
    for index, name in enumerate(NAMES):
        asked = made.ask(name)
        assert len(asked.selection) > 0
        same_answer(asked, answering.query(name, given))
        others = given.embeddings[[i for i in range(4) if i != index]]
        same_answer(asked, answering.query(given.embeddings[index], given, negatives=others))
        assert (asked.words, asked.low, asked.high, asked.known) == (name, 0.0, 1.0, True)
        assert torch.equal(asked.valid, answering.known)
    asked = made.ask("a red thing")  # is told from the canonical words
    same_answer(asked, answering.query(embed("a red thing"), given, negatives=given.negatives))
    assert (asked.low, asked.high, asked.known) == (0.0, 1.0, False)


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


def test_words_that_cannot_be_answered():
    refused(lambda: FieldMeaning(field()), "classes:", "got none")  # the field remembers none
    made = FieldMeaning(field(), classes())
    refused(lambda: made.ask("chiar"), "class:", "got 'chiar'", "'chair'")
    refused(lambda: FieldMeaning(field(), classes(), embed=embed).ask("  "), "class:", "wall, chair, table", "got ''")
    short = FieldMeaning(field(), classes(), embed=lambda words: torch.ones(DIM - 1))
    refused(lambda: short.ask("sofa"), "embed:", "[16]", "'sofa'", "got (15,)")


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
    refused(lambda: made.ask("chairs"), "class:", "got 'chairs'", "'chair'")


def test_scores_of_a_splat_may_be_cosines_below_zero_or_missing():
    made = SplatMeaning(splat_file(cloud(LINE, LABELS), np.array([-0.2, np.nan, 0.5, 0.1, 0.7], np.float32)))
    asked = made.ask("chair")
    assert asked.selection.indices.tolist() == [0, 1]  # a score that is missing counts as the least
    assert asked.low < asked.high == pytest.approx(-0.2)
    assert asked.valid.tolist() == [True, True, False, False, False]
    table = made.ask("table").selection
    assert (len(table), made.by) == (0, "the file's classes and scores")
    above = splat_file(cloud(LINE, LABELS), np.array([0.8, 0.9, 0.5, 0.1, 0.7], np.float32))
    positive = SplatMeaning(above).ask("chair")
    assert (positive.low, positive.high) == (0.0, 1.0)
    assert positive.selection.scores.tolist() == pytest.approx([0.8, 0.9, 0, 0, 0])


def test_splats_without_labels_or_names():
    plain = SplatMeaning(splat_file(cloud(LINE)))
    assert (plain.names, plain.gaussians.labels.tolist()) == ((), [-1] * len(LINE))
    refused(lambda: plain.ask("chair"), "words:", "without for 'chair'", "`kfgs attach`")
    with pytest.raises(ValueError, match=tells("class:", "got 'zebra'; take one of these classes")):
        SplatMeaning(splat_file(cloud(LINE, LABELS))).ask("zebra")
    made = SplatMeaning(splat_file(cloud(LINE, LABELS)).replace(names=("wall",)))
    assert made.names == ("wall", "class 1", "class 2", "class 3")
    assert made.ask("class 3").selection.indices.tolist() == [2]
