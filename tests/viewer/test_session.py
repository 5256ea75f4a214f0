"""What the viewer asks of Python: the same answers as the explorer's state, and files that hold what was selected."""

import cases_explorer
import numpy as np
import pytest
import torch
from messages import refused

from kfgs.formats import read_splats
from kfgs.labels import EditList, Selection, connected_parts
from kfgs.viewer.session import Session


def index(*numbers):
    return {"kind": "index", "indices": numbers}


def bits_of(mask):
    """A mask as the viewer sends it."""
    return np.packbits(mask.numpy(), bitorder="little").tobytes()


@pytest.fixture
def session(tmp_path):
    return Session(cases_explorer.room(), tmp_path / "out")


def test_connected_parts_of_a_selection(session):
    mask = torch.arange(60) % 2 == 0
    answer, attached = session.call("parts", {"side": "color"}, bits_of(mask))
    numbers = torch.from_numpy(np.frombuffer(attached, "<i2").copy())
    expected = connected_parts(session.state.cloud("color"), Selection.of(mask, ""), most=16)
    assert [part["count"] for part in answer["parts"]] == [part.count for part in expected]
    for number, part in enumerate(expected):
        assert (numbers == number).nonzero()[:, 0].equal(part.indices)
    assert (numbers[~mask] == -1).all()


def test_edits_can_be_replayed(session):
    state = session.state
    edits = [{"op": "opacity", "where": index(1, 2), "factor": 0.5}, {"op": "remove", "where": index(3, 4)}]
    session.call("save_edits", {"edits": {"color": edits, "semantic": []}})
    made, before = read_splats(session.out / "edited_001" / "color.ply"), state.cloud("color")
    assert len(made) == len(before) - 2
    torch.testing.assert_close(made.opacities[2], 0.5 * before.opacities[2])
    assert [edit.op for edit in EditList.load(session.out / "edited_001" / "color.json")] == ["opacity", "remove"]
    assert not (session.out / "edited_001" / "semantic.ply").exists()


def test_copies_are_saved_and_split_as_they_are_in_the_viewer(session):
    copied = [0, 1, 2, 3]
    edits = {"color": [
        {"op": "duplicate", "where": index(*copied), "translation": [100, 0, 0]},
        {"op": "opacity", "where": index(60, 61), "factor": 0.5},
        {"op": "remove", "where": index(0, 1)},
    ]}  # fmt: skip
    mask = torch.arange(64) >= 60
    args = {"words": "chair", "gamma": 0.4, "lambda": 0.5, "sides": ["color"], "edits": edits}
    session.call("save_selection", args, bits_of(mask))
    made = read_splats(session.out / "selection_001" / "selection_color.ply")
    cloud = session.state.cloud("color")
    torch.testing.assert_close(made.means, cloud.means[copied] + torch.tensor([100.0, 0, 0]))
    torch.testing.assert_close(made.opacities, cloud.opacities[copied] * torch.tensor([0.5, 0.5, 1, 1]))
    answer, attached = session.call("parts", {"side": "color", "edits": edits}, bits_of(torch.ones(64).bool()))
    numbers = np.frombuffer(attached, "<i2")
    assert len(numbers) == 64
    assert not set(numbers[:60]) & set(numbers[60:]) - {-1}
    assert np.array(answer["parts"][0]["corners"]).shape == (8, 3)


def test_what_is_like_a_selection(session):
    state = session.state
    labels = torch.from_numpy(state.labels("semantic"))
    label = int(labels[labels >= 0].mode().values)
    chosen = labels == label
    answer, attached = session.call("similar", {}, bits_of(chosen))
    scores = torch.from_numpy(np.frombuffer(attached, "<f4").copy())
    found = scores > answer["gamma"]
    assert answer["words"] == "like the selection"
    assert (found & chosen).sum() == pytest.approx(0.9 * int(chosen.sum()), abs=1)
    assert scores[chosen].mean() > scores[~chosen & ~scores.isnan()].mean()


@pytest.mark.parametrize(
    ("name", "args", "attached", "words"),
    [
        ("ask", {}, b"", ["args", "words"]),
        ("ask", {"words": 3}, b"", ["words"]),
        ("parts", {"side": "left"}, b"", ["side"]),
        ("save_selection", {"sides": ["color"]}, b"\0", ["attached"]),
        ("save_selection", {"sides": []}, b"", ["selection"]),
        ("save_edits", {"edits": {"color": [{"op": "remove", "where": index(10**9)}]}}, b"", ["indices"]),
        ("save_edits", {"edits": {"color": [{"op": "recolor", "where": index(1), "rgb": [300, 0, 0]}]}}, b"", ["rgb"]),
        ("save_edits", {"edits": {"color": [{"op": "insert", "source": "/etc/passwd"}]}}, b"", ["op"]),
        ("save_edits", {"edits": {"color": [{"op": "remove", "where": "chair"}]}}, b"", ["where"]),
        ("save_edits", {"edits": {}}, b"", ["edits"]),
        ("save_selection", {"sides": 5}, b"", ["args", "5"]),
        ("save_edits", {"edits": 5}, b"", ["args", "5"]),
        ("similar", {}, bytes(10), ["selection"]),
        ("delete", {}, b"", ["name"]),
    ],
)
def test_wrong_calls(session, name, args, attached, words):
    refused(lambda: session.call(name, args, attached), *words, error=(ValueError, TypeError))
    assert not session.out.exists()
