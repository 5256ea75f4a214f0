"""What is said beside a score, of methods whose training is known and of those whose is not."""

from types import SimpleNamespace

import cases_methods as cases
import torch

from kfgs.evaluation import FieldMethod, LabelSet, Report
from kfgs.pipeline.beside import notes_beside
from kfgs.pipeline.results import _all_notes


def question(*views, name="kfgs-pooled/1"):
    return SimpleNamespace(scored=views, truth=None, protocol=SimpleNamespace(name=name))


def field(method="fused", **info):
    made = object.__new__(FieldMethod)  # which takes only a SemanticField
    vars(made).update(field=SimpleNamespace(method=method, info=info, cameras=()), name="field", own_labels=True)
    return made


VIEWS = (cases.view("in/a", 30, 40), cases.view("b", 60, 80))


def test_training_views_sizes_and_teacher():
    known = field("decouple", views=["in/a.png", "c.png"], teacher={"name": "lseg"})
    assert notes_beside(question(*VIEWS), "own", known, None) == [
        "1 of 2 scored views were trained on",
        "scored pictures: 2 of 2 sizes, 30x40 to 60x80 (height x width)",
        "teacher: lseg",
    ]
    assert notes_beside(question(), None, known, None) == ["teacher: lseg"]  # points
    other = cases.Numbers("a", own={"a": torch.zeros(1, 2)})
    assert notes_beside(question(VIEWS[0]), "nearest", other, None) == ["scored pictures: 1 of 30x40 (height x width)"]


def test_cameras_of_a_field_stand_in_for_the_names_of_its_views():
    bare = field("decouple")
    bare.field.cameras = (SimpleNamespace(name="b.jpg"),)
    assert notes_beside(question(*VIEWS), "own", bare, None)[0] == "1 of 2 scored views were trained on"


def test_votes_are_said_only_where_they_count():
    for rule, method, name, said in (
        ("own", "fused", "kfgs-pooled/1", True),
        ("nearest", "fused", "kfgs-pooled/1", False),
        ("own", "decouple", "kfgs-pooled/1", False),
        (None, "fused", "kfgs-surface/1", False),
    ):
        notes = notes_beside(question(name=name), rule, field(method), None)
        assert any("by votes of the Gaussians" in note for note in notes) == said


def test_the_level_of_a_method_with_several_is_said():
    for levels, level, said in ((3, 1, True), (1, 0, False), (3, "chosen", False)):
        method, asked = cases.Numbers("a", own={"a": torch.zeros(levels, 2)}), question()
        asked.protocol.level = level
        notes = notes_beside(asked, None, method, None)
        assert notes == (["level 1 of 0 to 2 is scored; level=N takes another"] if said else [])


class Network:
    name = "clip\nfake"

    def encode_text(self, texts):
        return torch.eye(len(texts))


def test_the_teacher_of_the_texts_stands_in_for_that_of_the_result():
    table = LabelSet(["a"], torch.eye(3)[:1], info={"teacher": {"name": "siglip"}})
    other = cases.Numbers("a", own={"a": torch.zeros(1, 2)})
    assert notes_beside(question(), None, other, table) == ["teacher: siglip"]
    assert notes_beside(question(), None, other, Network().encode_text) == ["teacher: clip\\nfake"]
    assert notes_beside(question(), None, field("x", teacher={"name": "lseg"}), table) == ["teacher: lseg"]


def test_notes_of_one_of_several_reports_say_of_which():
    reports = {
        "one": Report("p/1", {"s": 1.0}, notes=("scored", "trained")),
        "two": Report("p/1", {"s": 0.5}, notes=("scored", "trained less")),
    }
    assert _all_notes(reports) == ["scored", "one: trained", "two: trained less"]
