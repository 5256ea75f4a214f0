import json

import numpy as np
import pytest
import torch
from cases_clouds import random_cloud
from messages import refused, tells

from kfgs.cameras import Similarity
from kfgs.formats import write_splats
from kfgs.labels import Duplicate, EditList, Extract, InBox, Insert, Move, OfClass, Opacity, Recolor, Remove
from kfgs.labels.edit_list import OPS

ROTATION = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
PLACE = Similarity(0.5, ROTATION, torch.tensor([1.0, 2.0, 3.0]))


def scene(n=12, seed=0):
    scores = torch.linspace(0.2, 1, n)
    return random_cloud(n, seed=seed, labels=torch.arange(n) % 3, scores=scores, names=("wall", "chair", "plant"))


def every_edit(folder):
    write_splats(scene(3, 1).replace(names=("vase", "wall", "chair")), folder / "parts" / "vase.ply")
    return EditList(
        [
            Recolor(["plant", InBox((0, 0, 0), (0.1, 0.1, 0.1))], "#c04040"),
            Move("chair", (0, 0, 1), ("z", 30), 1.5, (0.5, 0.5, 0.5)),
            Duplicate(OfClass("chair", 0), (1, 0, 0), ((1.0, 0.0, 0.5), 20)),
            Opacity("wall", 0.25),
            Remove("chair"),
            Insert(folder / "parts" / "vase.ply", PLACE),
            Extract(["vase", "plant"]),
        ]
    )


def same(a, b):
    assert a.names == b.names
    assert a.to_numpy().keys() == b.to_numpy().keys()
    for name, value in a.to_numpy().items():
        np.testing.assert_allclose(b.to_numpy()[name], value, rtol=1e-6, err_msg=name)


def test_apply_is_one_edit_after_the_other(tmp_path):
    splats, edits = scene(), every_edit(tmp_path)
    expected = splats
    for edit in edits:
        expected = edit.apply(expected)
    same(edits.apply(splats), expected)
    same(EditList().apply(splats), splats)
    assert {edit.op for edit in edits} == set(OPS)


def test_undo_is_a_new_list():
    first, second = Remove("chair"), Opacity("wall", 0.5)
    edits = EditList().then(first).then(second)
    assert (edits.edits, edits.undo().edits) == ((first, second), (first,))
    assert EditList().undo() == EditList()


def test_saved_and_replayed(tmp_path):
    splats, edits = scene(), every_edit(tmp_path / "old")
    path = edits.save(tmp_path / "old" / "edits.json")
    content = json.loads(path.read_text())
    assert (content["format"], content["version"]) == ("kfgs.edits", 1)
    assert content["edits"][5]["source"] == "parts/vase.ply"  # beside the JSON, so that both can be carried away
    (tmp_path / "old").rename(tmp_path / "new")
    again = EditList.load(tmp_path / "new" / "edits.json")
    assert again.edits[5].source == tmp_path / "new" / "parts" / "vase.ply"
    assert [edit.op for edit in again] == [edit.op for edit in edits]
    assert again.edits[:5] == edits.edits[:5]
    same(again.apply(splats), every_edit(tmp_path).apply(splats))


def test_hand_written_json_may_be_short_and_names_a_missing_file(tmp_path):
    path = tmp_path / "edits.json"
    edits = [
        {"op": "recolor", "where": "plant", "rgb": "#c04040", "mode": "tint"},
        {"op": "move", "where": {"kind": "class", "name": "chair"}, "rotation": ["z", 90]},
    ]
    path.write_text(json.dumps({"format": "kfgs.edits", "version": 1, "edits": edits}))
    assert EditList.load(path) == EditList([Recolor("plant", "#c04040"), Move("chair", rotation=("z", 90))])
    path.write_text(json.dumps({"format": "kfgs.edits", "version": 1, "edits": [{"op": "insert", "source": "a.ply"}]}))
    refused(lambda: EditList.load(path), "edits[0].source:", "a.ply", "got none", error=FileNotFoundError)
    refused(lambda: EditList.load(tmp_path / "none.json"), "none.json:", "JSON", error=FileNotFoundError)


def test_files_elsewhere_need_a_word(tmp_path):
    write_splats(scene(3), tmp_path / "vase.ply")
    path = EditList([Insert(tmp_path / "vase.ply")]).save(tmp_path / "sub" / "edits.json")
    message = ("edits.json:", "edits[0].source:", "sub", "vase.ply'", "copy")
    refused(lambda: EditList.load(path), *message)
    assert EditList.load(path, anywhere=True).edits[0].source == (tmp_path / "vase.ply").resolve()
    (tmp_path / "sub" / "link.ply").symlink_to(tmp_path / "vase.ply")
    for trick in ("../vase.ply", "a/../../vase.ply", "link.ply"):
        content = {"format": "kfgs.edits", "version": 1, "edits": [{"op": "insert", "source": trick}]}
        path.write_text(json.dumps(content))
        refused(lambda: EditList.load(path), "edits[0].source:", "sub", "got '")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], ("kfgs.edits",)),
        ({"format": "kfgs.semantic_field", "version": 1}, ("kfgs.edits",)),
        ({"format": "kfgs.edits", "version": 2, "edits": []}, ("'version': 1",)),
        ({"format": "kfgs.edits", "version": 1}, ("edits:", "list", "got None")),
        ({"format": "kfgs.edits", "version": 1, "edits": {}}, ("edits:", "list", "got {}")),
    ],
)
def test_files_that_are_no_edits(tmp_path, content, message):
    path = tmp_path / "edits.json"
    path.write_text(json.dumps(content))
    refused(lambda: EditList.load(path), "edits.json:", *message)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (3, ("remove, extract, recolor", "'op'", "got 3")),
        ({"op": ["remove"]}, ("got {'op': ['remove']}",)),
        ({"op": "remove"}, ("'where'",)),
        ({"op": "remove", "where": "a", "gorw": 1}, ("'gorw'",)),
        ({"op": "remove", "where": {"kind": "no"}}, ("where:", "got {'kind': 'no'}")),
        ({"op": "opacity", "where": "a", "factor": "1"}, ("factor:", "got '1'")),
        ({"op": "opacity", "where": "a", "factor": 1e999}, ("factor:", "got inf")),
        ({"op": "move", "where": "a", "translation": [10**400, 0, 0]}, ("int too large",)),
        ({"op": "opacity", "where": "a", "factor": 2}, ("factor:", "[0, 1]", "got 2")),
        ({"op": "recolor", "where": "a", "rgb": [1, 2, 3]}, ("rgb:", "[0, 1]", "got [1, 2, 3]")),
        ({"op": "move", "where": "a", "rotation": 90}, ("rotation:", "got 90")),
        ({"op": "insert", "source": 3}, ("source:", "got 3")),
        ({"op": "insert", "source": "a.ply", "similarity": 1}, ("[4, 4]",)),
        ({"op": "insert", "source": "a.ply", "similarity": [[1, 0, 0]] * 3}, ("expected",)),
    ],
)
def test_edits_of_others_are_refused_with_the_place(tmp_path, edit, message):
    (tmp_path / "a.ply").touch()
    path = tmp_path / "edits.json"
    path.write_text(json.dumps({"format": "kfgs.edits", "version": 1, "edits": [edit]}))
    refused(lambda: EditList.load(path), "edits.json:", "edits[0]", *message)


def test_an_edit_that_fails_is_numbered():
    with pytest.raises(ValueError, match=tells("edits[1] (opacity):", "where:", "got none")):
        EditList([Remove("chair"), Opacity("chair", 0.5)]).apply(scene())
    with pytest.raises(ValueError, match=tells("edits[0] (remove):", "class:", "wall, chair, plant", "got 'chiar'")):
        EditList([Remove("chiar")]).apply(scene())
