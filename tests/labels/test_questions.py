import dataclasses

import pytest
import torch
from cases_clouds import balls
from messages import refused, tells

from kfgs import Camera
from kfgs.fields import Identity, SemanticField
from kfgs.labels.label_set import LabelSet, class_rows, make_question

NAMES = ("chair", "table", "lamp")
ROWS = torch.eye(3, 6)
CANONICAL = torch.eye(6)[3:5]
FULL = LabelSet(NAMES, ROWS, CANONICAL, ("object", "stuff"))
BARE = LabelSet(NAMES, ROWS)
PHRASE = torch.tensor([1.0, 0, 0, 0, 0, 1])


def told_from(target, classes, negatives="auto"):
    return make_question(target, classes, negatives, 6, {})[1:].tolist() or None


@pytest.mark.parametrize("classes", [FULL, BARE], ids=["canonical", "bare"])
@pytest.mark.parametrize("target", ["Table", ROWS[1], 3 * ROWS[1] + 1e-6], ids=["name", "row", "rounded"])
def test_a_class_is_told_from_the_other_classes(target, classes):
    assert told_from(target, classes) == ROWS[[0, 2]].tolist()


def test_the_only_class_is_told_from_the_canonical_words():
    one = LabelSet(("Stuff",), ROWS[:1], CANONICAL, ("object", "stuff"))
    assert told_from(ROWS[0], one) == CANONICAL.tolist()
    assert told_from("stuff", one) == CANONICAL[:1].tolist()  # but not from itself
    assert told_from("chair", LabelSet(("chair",), ROWS[:1])) is None


def test_anything_else_is_told_from_the_canonical_words_or_from_nothing():
    assert told_from(PHRASE, FULL) == CANONICAL.tolist()
    assert told_from(CANONICAL[1], FULL) == CANONICAL[:1].tolist()
    assert told_from(PHRASE, BARE) is None
    assert told_from(PHRASE, None) is None
    assert told_from(PHRASE, BARE, "classes") == ROWS.tolist()


# Asked of a field

FIVE = torch.eye(5)
CLASSES = LabelSet(("wall", "chair", "stuff"), FIVE[:3], FIVE[3:], ("Stuff", "object"), {"teacher": {"name": "lseg"}})
CAMERA = Camera(torch.eye(4), torch.tensor([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), 8, 8)


def field(teacher="lseg"):
    """Six Gaussians: one like each row, and one that was never learnt."""
    gaussians = balls(torch.rand(6, 3), features=torch.cat([FIVE, torch.zeros(1, 5)]))
    return SemanticField(gaussians, Identity(5), info={"teacher": {"name": teacher}})


def test_negatives_are_the_classes_the_canonical_words_or_none():
    chair = field().query("chair", CLASSES, negatives="classes")
    assert chair.indices.tolist() == [1]
    assert "any of 2 negatives" in chair.how
    assert chair.scores[3] == 0.5  # like neither: the canonical rows play no part
    canonical = field().query("chair", CLASSES, negatives="canonical")
    assert "any of 2 negatives" in canonical.how
    assert canonical.scores[3] < 0.01
    assert canonical.scores[0] == 0.5
    alone = field().query("chair", CLASSES, 0.9, negatives="none")
    assert alone.scores.tolist() == [0, 1, 0, 0, 0, 0]
    rows = field().query("chair", CLASSES, negatives=FIVE[4:])
    assert "any of 1 negatives" in rows.how
    assert rows.scores[4] < 0.01
    for found in (chair, canonical, alone, rows):
        assert found.scores[5] == 0  # never learnt


def test_names_and_embeddings_of_classes_give_the_same_labels():
    by_name, by_row = field().classify(CLASSES), field().classify(FIVE[:3])
    assert by_name.labels.tolist() == by_row.labels.tolist() == [0, 1, 2, 0, 0, -1]  # rows 3 and 4 are like no class
    assert by_name.scores.tolist() == by_row.scores.tolist() == [1, 1, 1, 0, 0, 0]
    assert field().label(CLASSES).labels.tolist() == [0, 1, 2, 0, 0, -1]


def test_missing_negatives_are_named():
    bare = LabelSet(("wall",), FIVE[:1])
    refused(lambda: field().query("wall", bare, negatives="classes"), "negatives:", "'wall'", "got none", "'none'")
    with pytest.raises(ValueError, match=tells("negatives:", "got none", "`kfgs features --words`")):
        field().query("wall", bare, negatives="canonical")
    with pytest.raises(ValueError, match=tells("negatives:", "'auto', 'classes', 'canonical', 'none'", "got 'all'")):
        field().query("wall", bare, negatives="all")


def test_a_name_needs_classes_and_classes_are_a_label_set_or_rows():
    refused(lambda: field().query("wall", FIVE), "classes:", "LabelSet", "'wall'", "got Tensor")
    refused(lambda: field().query("wall"), "classes:", "LabelSet", "got NoneType")
    refused(lambda: class_rows(["wall"], 5, {}), "classes:", "LabelSet", "got list", "load_label_set", error=TypeError)
    refused(lambda: field().query("sofa", CLASSES), "class:", "got 'sofa'")


def test_words_of_another_teacher_are_warned_of():
    clip = field("clip")
    for ask in (
        lambda: clip.query("wall", CLASSES, 0.5),
        lambda: clip.query(FIVE[0], CLASSES, 0.5),
        lambda: clip.classify(CLASSES),
        lambda: clip.label(CLASSES),
        lambda: clip.segment(CAMERA, CLASSES),
    ):
        with pytest.warns(UserWarning, match=tells("classes:", "'clip'", "'lseg'")):
            ask()
    unknown = dataclasses.replace(CLASSES, info={})
    assert len(clip.query("wall", unknown, 0.5)) == 1  # no warning, which would be an error here


def test_words_of_other_channels_are_refused_before_any_view_is_drawn(monkeypatch):
    monkeypatch.setattr(SemanticField, "render", lambda *_: pytest.fail("a view was drawn"))
    monkeypatch.setattr("kfgs.fields.semantic_field.rasterize", lambda *_, **__: pytest.fail("a view was drawn"))
    other = LabelSet(("wall", "chair"), torch.eye(2, 7), info={"teacher": {"name": "clip"}})
    for ask in (
        lambda: field().segment(CAMERA, other),
        lambda: field().label(other),
        lambda: field().classify(other),
        lambda: field().query("wall", other),
    ):
        refused(ask, "classes:", "[C, 5]", "got (2, 7)", "'clip'", "'lseg'")
    shown = dataclasses.replace(other, info={"examples": {"wall": 1, "chair": 1}})
    with pytest.raises(
        ValueError, match=tells("classes:", "[C, 5]", "got (2, 7)", "examples", "kfgs features FIELD --examples")
    ):
        field().label(shown)
