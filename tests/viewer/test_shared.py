"""What Python reads, sets and observes of a viewer, without a browser; with one: test_lab.py."""

import base64
import math

import cases_explorer
import cases_page
import numpy as np
import pytest
import torch
import traitlets
from messages import refused

from kfgs.gaussians import Gaussians
from kfgs.labels import Duplicate, EditList, InBox, Move, OfClass, Opacity, Recolor, Remove, Selection
from kfgs.viewer import Exploration, SplatMeaning, Viewer

NAMES = "question", "gamma", "distance", "hidden", "side", "selection", "edits", "picked", "tape", "camera"


@pytest.fixture
def viewer():
    return Viewer(cases_page.exploration(("table", "chair", "odd")))


def bits(mask):
    return base64.b64encode(np.packbits(np.asarray(mask), bitorder="little").tobytes()).decode()


def heard(viewer, **told):
    """What the browser sends when a person changed something."""
    viewer.hear(viewer.wire | told)


def test_what_is_set_before_a_browser_shows_it_waits_in_the_wire(viewer):
    viewer.ask(" Chair ")
    viewer.gamma = 0.5
    viewer.distance = 0.35
    viewer.hidden = ["no class", "table"]
    viewer.picked = 7
    wire = viewer.wire
    assert (wire["words"], wire["gamma"], wire["lambda"], wire["hidden"]) == ("chair", 0.5, 0.35, [-1, 0])
    assert (viewer.question, viewer.hidden) == ("chair", ("no class", "table"))
    assert wire["picked"] == {"side": "color", "index": 7}
    state = viewer.state  # follows
    assert (state.asked.words, state.gamma, state.distance) == ("chair", 0.5, 0.35)
    assert viewer.selection.mask.tolist() == state.selected("color").tolist()
    assert 0 < len(viewer.selection) < 450
    refused(lambda: setattr(viewer, "picked", type(viewer.picked)("left", 7, "", 0.0, (0, 0, 0))), "side:", "'left'")
    assert (viewer.picked.name, viewer.picked.index) == (state.describe("color", 7).name, 7)
    viewer.side = "semantic"
    assert viewer.selection.mask.tolist() == state.selected("semantic").tolist()
    viewer.gamma = None
    assert viewer.gamma == state.asked.selection.threshold
    viewer.question = None
    assert (viewer.gamma, len(viewer.selection), wire["words"]) == (None, 0, "chair")


def test_asked_again_a_question_replaces_a_selection_by_hand(viewer):
    viewer.ask("chair")
    asked = viewer.selection.mask
    viewer.selection = ~asked
    viewer.ask("chair")
    assert torch.equal(viewer.selection.mask, asked)
    assert {own["selected"] for own in viewer.wire["sides"].values()} == {None}


def test_like_the_selection_has_a_gamma_without_words(viewer):
    viewer.ask("table")
    seen = []
    viewer.observe(lambda change: seen.append(change["new"]), "selection")
    sides, mask = viewer.wire["sides"], np.arange(450) % 3 == 0
    heard(viewer, words=None, gamma=0.7, sides=sides | {"color": sides["color"] | {"selected": bits(mask)}})
    assert (viewer.question, viewer.gamma) == (None, None)
    assert seen[-1].mask.tolist() == viewer.selection.mask.tolist() == mask.tolist()


def test_a_selection_is_a_mask_a_rule_or_an_answer_of_either_cloud(viewer):
    state = viewer.state
    viewer.ask("table")
    mask = torch.arange(450) % 3 == 0
    viewer.selection = mask
    assert viewer.selection.mask.equal(mask)
    assert base64.b64decode(viewer.wire["sides"]["color"]["selected"]) == base64.b64decode(bits(mask))
    for chairs in ("chair", OfClass("chair")):
        viewer.selection = chairs
        assert viewer.selection.mask.tolist() == (state.labels("color") == 1).tolist()
    viewer.selection = Selection.of(state.cloud("semantic").labels == 2)  # of the semantic cloud, by its length
    assert (viewer.side, len(viewer.selection)) == ("semantic", 60)
    assert viewer.wire["sides"]["color"]["selected"] is None
    viewer.selection = None
    assert (len(viewer.selection), viewer.question) == (0, None)
    before = viewer.wire
    for wrong in (torch.ones(3, dtype=torch.bool), OfClass("lamp"), "lamp", torch.ones(450)):
        with pytest.raises((ValueError, TypeError)):
            viewer.selection = wrong
    assert viewer.wire == before
    assert len(viewer.selection) == 0


def test_a_person_is_heard_and_observers_are_told_once(viewer):
    seen = []
    viewer.observe(lambda change: seen.append((change["name"], change["new"])), list(NAMES))
    mask = np.arange(450) < 9
    sides = viewer.wire["sides"] | {"color": {"count": 450, "selected": bits(mask), "edits": []}}
    heard(viewer, sides=sides, hidden=[2], **{"lambda": float(np.float32(0.4))})
    assert [name for name, _ in seen] == ["hidden", "selection"]
    assert seen[1][1].mask.tolist() == mask.tolist()
    assert viewer.distance == 0.4  # and not what JavaScript rounds it to
    no_hand = {side: own | {"selected": None} for side, own in viewer.wire["sides"].items()}
    heard(viewer, words="chair", gamma=0.25, sides=no_hand)
    assert (viewer.question, viewer.gamma, viewer.state.asked.words) == ("chair", 0.25, "chair")
    assert viewer.selection.mask.tolist() == viewer.state.selected("color").tolist()
    seen.clear()
    heard(viewer)
    assert seen == []
    heard(viewer, picked={"side": "semantic", "index": 5})
    assert (viewer.picked.side, viewer.picked.name) == ("semantic", "table")
    heard(viewer, picked={"side": "color", "index": 999})  # a copy, which Python does not know
    assert viewer.picked is None


def test_observers_get_what_is_read(viewer):
    viewer.ask("chair")
    suggested, seen = viewer.gamma, []
    viewer.observe(lambda change: seen.append((change["name"], change["new"])), list(NAMES))
    settings = [
        ("gamma", 0.5), ("gamma", None), ("hidden", "table"), ("picked", 7), ("tape", torch.eye(3)[:2]),
        ("edits", [Opacity("chair", 0.5)]), ("selection", OfClass("table")), ("selection", None), ("camera", None),
    ]  # fmt: skip
    for name, value in settings:
        seen.clear()
        setattr(viewer, name, value)
        for other, new in seen:
            assert repr(new) == repr(getattr(viewer, other))
        assert len(dict(seen)) == len(seen)  # each once
        assert (name in dict(seen)) == (name != "camera")  # of which there is none before and after
    assert (viewer.gamma, viewer.question, len(viewer.selection)) == (None, None, 0)
    viewer.ask("chair")
    viewer.selection = torch.arange(450) < 5
    viewer.gamma = suggested  # as a slider echoes it
    assert len(viewer.selection) == 5


WRONG = [
    {"words": "lamp"}, {"words": 5}, {"words": "chair", "gamma": "high"}, {"lambda": -1.0}, {"lambda": "far"}, {"hidden": [3]},
    {"hidden": 7}, {"side": "left"}, {"sides": {}}, {"picked": {"side": "color", "index": -1}}, {"view": {"K": [1]}},
    {"tape": [[0, 1]]}, {"tape": [[0, 1, float("nan")]] * 2}, {"color": {"count": 9}}, {"color": {"selected": "?"}},
    {"color": {"edits": [{"op": "explode"}]}}, {"semantic": {"edits": [{"op": "remove", "where": "chair"}]}},
]  # fmt: skip


@pytest.mark.parametrize("told", WRONG)
def test_what_is_not_of_the_viewers_script_is_refused_as_a_whole(viewer, told):
    viewer.ask("chair")
    side = next((own for own in told if own in viewer.state.sides), None)
    if side:
        sides = viewer.wire["sides"]
        told = {"sides": sides | {side: sides[side] | told[side]}}
    if "view" not in told:  # what comes with it is not taken over, either
        told = {"gamma": 0.5, "lambda": 0.3, "tape": [[0, 0, 0], [1, 1, 1]], "hidden": [0]} | told
    before = viewer.wire, repr([getattr(viewer, name) for name in NAMES]), viewer.state.details()
    seen, shown = [], []
    viewer.observe(seen.append, list(NAMES))
    viewer.tell = lambda: shown.append(viewer.wire)
    refused(lambda: heard(viewer, **told), "wire:", "expected what the viewer's script sends")
    assert before == (viewer.wire, repr([getattr(viewer, name) for name in NAMES]), viewer.state.details())
    assert (seen, shown) == ([], [viewer.wire])  # the browser shows again what holds


def test_the_tape_has_two_ends_in_the_world():
    cloud = cases_page.exploration().cloud("color").replace(origin=(1000.0, 0, 0))
    viewer = Viewer(Exploration(SplatMeaning(cloud)))
    heard(viewer, tape=[[1, 2, 3]])
    assert viewer.tape is None
    heard(viewer, tape=[[1, 2, 3], [1, 2, 7]])
    assert viewer.tape == ((1001, 2, 3), (1001, 2, 7))
    assert math.dist(*viewer.tape) == 4
    viewer.tape = np.array([[1000, 0, 0], [1003, 4, 0]])
    assert viewer.wire["tape"] == [[0, 0, 0], [3, 4, 0]]
    refused(lambda: setattr(viewer, "tape", [[0, 0, 0]]), "tape:", "[2, 3]", "(1, 3)")
    viewer.tape = None
    assert viewer.wire["tape"] == []


def test_an_observer_may_set_another_value(viewer):
    viewer.observe(lambda change: viewer.set_trait("hidden", ("table",)), "question")
    heard(viewer, words="chair", gamma=0.0)
    assert (viewer.hidden, viewer.wire["hidden"]) == (("table",), [0])
    slider = type("Slider", (traitlets.HasTraits,), {"value": traitlets.Float(0.5)})()
    traitlets.link((viewer, "gamma"), (slider, "value"))
    slider.value = 0.75
    assert (viewer.gamma, viewer.wire["gamma"]) == (0.75, 0.75)
    heard(viewer, gamma=0.3)
    assert slider.value == 0.3


def same_cloud(a: Gaussians, b: Gaussians):
    for name in ("means", "opacities", "labels", "sh"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name))


def test_edits_that_are_set_are_numbered_as_in_the_browser(viewer):
    """By rules, which an earlier removal renumbers; in the browser no number changes, and removals come last."""
    state = viewer.state
    cloud = state.cloud("color").replace(labels=torch.from_numpy(state.labels("color")), names=state.meaning.names)
    edits = (
        EditList()
        .then(Remove("table"))
        .then(Recolor("chair", "#c04040"))
        .then(Duplicate("chair", (0.0, 0.0, 2.0)))
        .then(Move(InBox((-9, -9, 1), (9, 9, 9)), (0.0, 1.0, 0.0)))
        .then(Remove(InBox((-9, -9, -9), (9, 0, 9))))
        .then(Opacity("odd", 0.5))
    )
    viewer.edits = edits
    ops = [edit["op"] for edit in viewer.wire["sides"]["color"]["edits"]]
    assert ops == ["recolor", "duplicate", "move", "opacity", "remove"]
    same_cloud(viewer.edits.apply(cloud), edits.apply(cloud))
    removed = {i for i in viewer.wire["sides"]["color"]["edits"][-1]["where"]["indices"] if i < 450}
    viewer.selection = torch.ones(450, dtype=torch.bool)
    assert set(viewer.selection.indices.tolist()) == set(range(450)) - removed
    viewer.edits = viewer.edits.undo()
    assert ops[:-1] == [edit["op"] for edit in viewer.wire["sides"]["color"]["edits"]]
    wrong = Move("chair", rotation=("z", 90)), Remove("chair", fill=True), Opacity("lamp", 0.5)
    before = viewer.wire
    for edit in wrong:
        with pytest.raises(ValueError, match=r"edits\[0\]|class"):
            viewer.edits = EditList().then(edit)
        assert (viewer.wire, len(viewer.edits)) == (before, 4)


def test_the_camera_is_that_of_the_picture():
    state = cases_explorer.line(cameras=cases_explorer.cameras())
    viewer = Viewer(state)
    assert viewer.camera.name == "view_0"
    viewer.camera = "view_1"
    np.testing.assert_allclose(viewer.camera.viewmat, state.cameras[1].viewmat, atol=1e-6)
    told = viewer.wire["view"] | {"width": 640, "height": 400, "K": [500.0, 500.0, 320.0, 200.0], "name": ""}
    viewer.hear({"view": told})
    camera = viewer.camera
    assert (camera.width, camera.height, float(camera.K[0, 0]), float(camera.K[1, 2])) == (640, 400, 500.0, 200.0)
    refused(lambda: setattr(viewer, "camera", "view_9"), "camera", "view_0")
    assert viewer.camera.width == 640


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("question", "lamp", ["'lamp'"]),
        ("side", "left", ["side", "'left'"]),
        ("hidden", ["lamp"], ["'lamp'"]),
        ("picked", 450, ["picked", "449"]),
        ("edits", EditList().then(Remove("lamp")), ["lamp"]),
        ("edits", Remove("chair"), ["edits:", "[Remove('chair')]"]),
    ],
)
def test_what_cannot_be_set_is_refused_and_changes_nothing(viewer, name, value, words):
    before = viewer.wire, [getattr(viewer, own) for own in NAMES if own != "selection"]
    refused(lambda: setattr(viewer, name, value), *words, error=(ValueError, TypeError))
    assert before == (viewer.wire, [getattr(viewer, own) for own in NAMES if own != "selection"])


def test_a_splat_without_classes_can_be_selected_and_edited():
    cloud = cases_page.exploration().cloud("color")
    viewer = Viewer(Exploration(SplatMeaning(cloud)))
    refused(lambda: viewer.ask("chair"), "words:", "kfgs attach", "'chair'")
    viewer.selection = InBox((0, -9, -9), (9, 9, 9))
    viewer.edits = EditList().then(Remove(viewer.selection))
    kept = viewer.edits.apply(cloud)
    assert len(kept) == int((cloud.means[:, 0] < 0).sum())
