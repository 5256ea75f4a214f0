import json
from dataclasses import fields

import numpy as np
import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.cameras import Similarity
from kfgs.formats import write_splats
from kfgs.labels import (
    Component,
    Duplicate,
    EditList,
    Extract,
    InBox,
    Insert,
    Move,
    OfClass,
    Opacity,
    Recolor,
    Remove,
    Turn,
)
from kfgs.labels.edits.edit_list import OPS

ROTATION = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
PLACE = Similarity(0.5, ROTATION, torch.tensor([1.0, 2.0, 3.0]))


def scene(n=12, seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: torch.from_numpy(rng.uniform(0.1, 0.9, shape)).float()  # noqa: E731
    gaussians = Gaussians(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), sh=draw(n, 4, 3), labels=torch.arange(n) % 3)
    return gaussians.replace(scores=rng.uniform(size=n), names=("wall", "chair", "plant"))


def every_edit(folder):
    write_splats(scene(3, 1).replace(names=("vase", "wall", "chair")), folder / "parts" / "vase.ply")
    return EditList(
        [
            Recolor(OfClass("plant") - InBox((0, 0, 0), (0.1, 0.1, 0.1)), "#c04040", "hue"),
            Move("chair", (0, 0, 1), Turn("z", 30), 1.5, (0.5, 0.5, 0.5)),
            Duplicate(Component(OfClass("chair"), 10.0), (1, 0, 0), (1.0, 0.0, 0.5, 0.0)),
            Opacity("wall", 0.25),
            Remove("chair", grow=0.01),
            Insert(folder / "parts" / "vase.ply", PLACE),
            Extract(OfClass("vase") | OfClass("plant")),
            Remove(OfClass(2), allow_empty=True),
        ]
    )


def same(a, b):
    assert a.names == b.names
    for name, value in vars(a).items():
        if value is not None:
            torch.testing.assert_close(getattr(b, name), value)
    for name, column in a.extra.items():
        np.testing.assert_array_equal(column, b.extra[name])


def test_apply_is_one_edit_after_the_other(tmp_path):
    splats, edits = scene(), every_edit(tmp_path)
    expected = splats
    for edit in edits:
        expected = edit.apply(expected)
    same(edits.apply(splats), expected)
    same(EditList().apply(splats), splats)
    assert {edit.op for edit in edits} == set(OPS)


def test_nothing_of_the_input_is_changed(tmp_path):
    splats, pristine = scene(), scene()
    edits = every_edit(tmp_path)
    for count in range(len(edits) + 1):
        EditList(edits.edits[:count]).apply(splats)
    same(splats, pristine)


def test_undo_and_redo_are_new_lists():
    first, second, third = Remove("chair"), Opacity("wall", 0.5), Recolor("plant", "red")
    edits = EditList().then(first).then(second)
    back = edits.undo()
    assert (edits.edits, back.edits, back.undone) == ((first, second), (first,), (second,))
    assert back.redo() == edits
    assert edits.undo().undo().redo().redo() == edits
    assert edits.undo().undo().undone == (second, first)
    assert back.then(third) == EditList([first, third])
    splats = scene()
    same(back.apply(splats), EditList([first]).apply(splats))
    with pytest.raises(ValueError, match=tells("edits:", "empty")):
        EditList().undo()
    with pytest.raises(ValueError, match=tells("undone:", "got none")):
        back.then(third).redo()


def test_saved_and_replayed(tmp_path):
    splats, edits = scene(), every_edit(tmp_path).undo()
    path = edits.save(tmp_path / "edits.json")
    content = json.loads(path.read_text())
    assert (content["format"], content["version"]) == ("kfgs.edits", 1)
    assert content["edits"][5]["source"] == "parts/vase.ply"  # beside the JSON, so that both can be carried away
    again = EditList.load(path)
    assert again == edits
    assert again.undone == edits.undone
    same(again.redo().apply(splats), edits.redo().apply(splats))


def test_a_relative_path_comes_back_as_the_same_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_splats(scene(3), "sub.ply")
    edits = EditList([Insert("sub.ply"), Insert(tmp_path / "sub.ply", PLACE)])
    for path in ("edits.json", tmp_path / "other.json"):
        assert EditList.load(edits.save(path)) == edits
    elsewhere = edits.save(tmp_path / "folder" / "edits.json")
    assert EditList.load(elsewhere, anywhere=True) == edits


def test_the_folder_can_be_carried_away(tmp_path):
    edits = every_edit(tmp_path / "old")
    edits.save(tmp_path / "old" / "edits.json")
    (tmp_path / "old").rename(tmp_path / "new")
    again = EditList.load(tmp_path / "new" / "edits.json")
    assert again.edits[5].source == tmp_path / "new" / "parts" / "vase.ply"
    assert len(again.apply(scene())) > 0


def test_hand_written_json_may_be_short(tmp_path):
    path = tmp_path / "edits.json"
    edits = [
        {"op": "recolor", "where": "plant", "rgb": "#c04040"},
        {"op": "move", "where": {"kind": "class", "name": "chair"}, "rotation": {"axis": "z", "degrees": 90}},
    ]
    path.write_text(json.dumps({"format": "kfgs.edits", "version": 1, "edits": edits}))
    assert EditList.load(path) == EditList([Recolor("plant", "#c04040"), Move("chair", rotation=("z", 90))])


def test_files_elsewhere_need_a_word(tmp_path):
    write_splats(scene(3), tmp_path / "vase.ply")
    path = EditList([Insert(tmp_path / "vase.ply")]).save(tmp_path / "sub" / "edits.json")
    message = ("edits.json:", "edits[0].source:", "sub", "vase.ply'", "copy")
    with pytest.raises(ValueError, match=tells(*message)):
        EditList.load(path)
    assert EditList.load(path, anywhere=True).edits[0].source == (tmp_path / "vase.ply").resolve()
    (tmp_path / "sub" / "link.ply").symlink_to(tmp_path / "vase.ply")
    for trick in ("../vase.ply", "a/../../vase.ply", "link.ply", "..\\vase.ply", "C:\\vase.ply", "\\\\host\\vase.ply"):
        content = {"format": "kfgs.edits", "version": 1, "edits": [{"op": "insert", "source": trick}]}
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=tells("edits[0].source:", "sub", "got '")):
            EditList.load(path)


def test_a_missing_file_is_named(tmp_path):
    path = tmp_path / "edits.json"
    content = {"format": "kfgs.edits", "version": 1, "edits": [{"op": "insert", "source": "vase.ply"}]}
    path.write_text(json.dumps(content))
    with pytest.raises(FileNotFoundError, match=tells("edits[0].source:", "vase.ply", "got none")):
        EditList.load(path)
    content["edits"][0]["source"] = "a" * 5000  # longer than any file system takes
    path.write_text(json.dumps(content))
    for anywhere in (False, True):
        with pytest.raises(FileNotFoundError, match=tells("edits[0].source:", "aaa", "got none")):
            EditList.load(path, anywhere=anywhere)
    with pytest.raises(FileNotFoundError, match=tells("none.json:", "JSON")):
        EditList.load(tmp_path / "none.json")


def test_a_cloud_in_memory_cannot_be_saved(tmp_path):
    with pytest.raises(ValueError, match=tells("edits[0].source:", "SplatFile")):
        EditList([Insert(scene(2))]).save(tmp_path / "edits.json")
    assert not (tmp_path / "edits.json").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], ("kfgs.edits",)),
        ({"format": "kfgs.semantic_field", "version": 1}, ("kfgs.edits",)),
        (
            {"format": "kfgs.edits", "version": 2, "edits": []},
            ("version 1", "kfgs.edits", "got 2"),
        ),
        ({"format": "kfgs.edits", "version": True, "edits": []}, ("version 1", "kfgs.edits", "got True")),
        ({"format": "kfgs.edits", "version": 1.0, "edits": []}, ("version 1", "kfgs.edits", "got 1.0")),
        ({"format": "kfgs.edits", "version": 1}, ("edits:", "list", "got []")),
        ({"format": "kfgs.edits", "version": 1, "edits": {}}, ("edits:", "list", "got {}")),
        ({"format": "kfgs.edits", "version": 1, "edits": [], "run": "x"}, ("'edits' and 'undone'", "got 'run'")),
    ],
)
def test_files_that_are_no_edits(tmp_path, content, message):
    path = tmp_path / "edits.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=tells("edits.json:", *message)):
        EditList.load(path)


PLAIN = {"scale": 1, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0]}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (3, ("edits[0]:", "remove, extract, recolor", "'op'", "got 3")),
        ({"op": "explode"}, ("edits[0]:", "got {'op': 'explode'}")),
        ({"op": ["remove"]}, ("edits[0]:", "got {'op': ['remove']}")),
        ({"op": "remove"}, ("edits[0]:", "'where'", "'remove'", "got none")),
        (
            {"op": "remove", "where": "a", "gorw": 1},
            ("edits[0]:", "'remove'", "got 'gorw'"),
        ),
        ({"op": "remove", "where": 3}, ("edits[0].where:", "got 3")),
        ({"op": "remove", "where": {"kind": "no"}}, ("edits[0].where:", "got {'kind': 'no'}")),
        ({"op": "remove", "where": "a", "grow": "1"}, ("edits[0].grow:", "got '1'")),
        ({"op": "remove", "where": "a", "grow": 1e999}, ("edits[0].grow:", "got inf")),
        ({"op": "opacity", "where": "a", "factor": 2}, ("edits[0].factor:", "[0, 1]", "got 2.0")),
        ({"op": "recolor", "where": "a", "rgb": [1, 2, 3]}, ("edits[0].rgb:", "[0, 1]", "got [1, 2, 3]")),
        ({"op": "recolor", "where": "a", "rgb": None}, ("edits[0].rgb:", "got None")),
        ({"op": "move", "where": "a", "rotation": {"axis": "z"}}, ("edits[0].rotation:", "degrees", "got axis")),
        (
            {"op": "move", "where": "a", "rotation": {"axis": 1, "degrees": 1}},
            ("edits[0].rotation.axis:", "expected 3", "got 1"),
        ),
        ({"op": "move", "where": "a", "rotation": 90}, ("edits[0].rotation:", "expected 4", "got 90")),
        ({"op": "move", "where": "a", "pivot": None}, ("edits[0].pivot:", "expected 3", "got None")),
        ({"op": "insert", "source": 3}, ("edits[0].source:", "got 3")),
        ({"op": "insert", "source": "\ud800"}, ("surrogates",)),
        (
            {"op": "insert", "source": "."},
            ("edits[0].source:", "folder"),
        ),
        ({"op": "insert", "source": "a\0b"}, ("edits[0].source:", "got 'a\\x00b'")),
        ({"op": "insert", "source": "a.ply", "similarity": 1}, ("edits[0].similarity:", "got 1")),
        ({"op": "insert", "source": "a.ply", "similarity": PLAIN | {"scale": -1}}, ("similarity.scale:", "got -1.0")),
        (
            {"op": "insert", "source": "a.ply", "similarity": PLAIN | {"scale": "1"}},
            ("similarity.scale:", "got '1'"),
        ),
        (
            {"op": "insert", "source": "a.ply", "similarity": PLAIN | {"rotation": [[1, 0, 0]] * 3}},
            ("edits[0].similarity.rotation:",),
        ),
    ],
)
def test_edits_of_others_are_refused_with_the_place(tmp_path, edit, message):
    (tmp_path / "a.ply").touch()
    path = tmp_path / "edits.json"
    path.write_text(json.dumps({"format": "kfgs.edits", "version": 1, "edits": [edit]}))
    with pytest.raises(ValueError, match=tells("edits.json:", *message)):
        EditList.load(path)


def test_json_that_nests_without_end(tmp_path):
    path = tmp_path / "edits.json"
    path.write_text("[" * 200_000)
    with pytest.raises(ValueError, match=tells("edits.json:", "JSON", "nest more than")):
        EditList.load(path)


def test_an_edit_that_fails_is_numbered():
    with pytest.raises(ValueError, match=tells("edits[1] (opacity):", "where:", "got none")):
        EditList([Remove("chair"), Opacity("chair", 0.5)]).apply(scene())
    with pytest.raises(ValueError, match=tells("edits[0] (remove):", "class:", "wall, chair, plant", "got 'chiar'")):
        EditList([Remove("chiar")]).apply(scene())


def test_lists_of_something_else():
    with pytest.raises(TypeError, match=tells("edits:", "got Remove")):
        EditList(Remove("chair"))
    with pytest.raises(TypeError, match=tells("edits[1]:", "got 'chair'", "Remove, Extract")):
        EditList([Remove("chair"), "chair"])


def test_every_edit_is_frozen_and_documented():
    for op in OPS.values():
        assert op.__doc__
        assert op.__dataclass_params__.frozen
        assert fields(op)
