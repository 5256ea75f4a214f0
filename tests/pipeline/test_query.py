"""Queries of a field by words: which negatives count, and words of another teacher."""

import dataclasses

import pytest
import torch

from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians
from kfgs.labels import LabelSet
from kfgs.pipeline import label_field, query_field, segment_scene
from kfgs.scenes import Scene

ROWS = torch.eye(5)
CLASSES = LabelSet(("wall", "chair", "stuff"), ROWS[:3], ROWS[3:], ("Stuff", "object"), {"teacher": {"name": "lseg"}})


def field(teacher="lseg"):
    """Six Gaussians: one like each row, and one that was never learnt."""
    features = torch.cat([ROWS, torch.zeros(1, 5)])
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(6, 1)
    gaussians = Gaussians(torch.rand(6, 3), quats, torch.full((6, 3), 0.1), torch.full((6,), 0.9), features)
    return SemanticField(gaussians, info={"teacher": {"name": teacher}})


def test_negatives_are_the_classes_the_canonical_words_or_none():
    chair = query_field(field(), CLASSES, "chair", negatives="classes")
    assert chair.indices.tolist() == [1]
    assert "any of 2 negatives" in chair.how
    assert chair.scores[3] == 0.5  # like neither: the canonical rows play no part
    canonical = query_field(field(), CLASSES, "chair", negatives="canonical")
    assert "any of 2 negatives" in canonical.how
    assert canonical.scores[3] < 0.01
    assert canonical.scores[0] == 0.5
    alone = query_field(field(), CLASSES, "chair", 0.9)
    assert alone.scores.tolist() == [0, 1, 0, 0, 0, 0]
    share = query_field(field(), CLASSES, "chair", 0.5, negatives="classes", score="softmax", logit_scale="clip")
    assert share.indices.tolist() == [1]
    for found in (chair, canonical, alone, share):
        assert found.scores[5] == 0  # never learnt


def test_a_class_is_not_told_from_its_own_name():
    stuff = query_field(field(), CLASSES, "stuff", negatives="canonical")
    assert "any of 1 negatives" in stuff.how
    assert stuff.scores[3] == 0.5  # the row of "Stuff" among the canonical words was left out


def test_missing_negatives_are_named():
    bare = LabelSet(("wall",), ROWS[:1])
    with pytest.raises(ValueError, match="negatives: expected other classes than 'wall', got none; use 'canonical'"):
        query_field(field(), bare, "wall", negatives="classes")
    with pytest.raises(ValueError, match="negatives: expected canonical words in the classes' table, got none; make"):
        query_field(field(), bare, "wall", negatives="canonical")
    with pytest.raises(ValueError, match="negatives: expected one of 'classes', 'canonical', 'none', got 'all'"):
        query_field(field(), bare, "wall", negatives="all")


def test_words_of_another_teacher_are_warned_of():
    for ask in (lambda: query_field(field("clip"), CLASSES, "wall", 0.5), lambda: label_field(field("clip"), CLASSES)):
        with pytest.warns(UserWarning, match="expected text of the field's teacher .name 'clip'.*another .'lseg'"):
            ask()
    unknown = dataclasses.replace(CLASSES, info={})
    assert len(query_field(field("clip"), unknown, "wall", 0.5)) == 1  # no warning, which would be an error here


def test_words_of_other_channels_are_refused_before_any_view_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(SemanticField, "render", lambda *_: pytest.fail("a view was drawn"))
    monkeypatch.setattr("kfgs.pipeline.apply.tqdm", lambda *_, **__: pytest.fail("the loop began"))
    other = LabelSet(("wall", "chair"), torch.eye(2, 7), info={"teacher": {"name": "clip"}})
    asked = (
        lambda: segment_scene(
            field(), Scene([], [], torch.zeros(0, 3), torch.zeros(0, 3), {"test": []}), other, tmp_path
        ),
        lambda: label_field(field(), other),
        lambda: query_field(field(), other, "wall"),
    )
    for ask in asked:
        with pytest.raises(
            ValueError,
            match=r"classes: expected embeddings \[C, 5\] \(from the field\), got \(2, 7\): text of another teacher\? "
            r"\(name 'clip' in place of 'lseg'\) Embed the words",
        ):
            ask()
