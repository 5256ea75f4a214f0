import json
import shutil

import numpy as np
import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.fields import SemanticField, recall_scene, remember
from kfgs.fields.remembered import recall_classes
from kfgs.labels import LabelSet

NAMES = ["wall", "chair"]
ROWS = np.eye(2, 4, dtype=np.float32)


def tree(root, kind="npy"):
    """A scene in one folder, and a field of it in another one that is deeper."""
    scene, place = root / "scenes" / "room", root / "runs" / "today" / "field"
    scene.mkdir(parents=True)
    if kind != "table":
        (scene / "classes.json").write_text(json.dumps(NAMES))
    if kind == "npy":
        np.save(scene / "text.npy", ROWS)
    else:
        LabelSet(tuple(NAMES), torch.from_numpy(ROWS)).save(scene / "text.safetensors")
    gaussians = Gaussians(
        torch.zeros(2, 3), torch.eye(4)[:1].repeat(2, 1), torch.ones(2, 3), torch.full((2,), 0.5), torch.eye(2, 4)
    )
    SemanticField(gaussians, info=remember(scene, place)).save(place)
    return scene, place


@pytest.mark.parametrize("kind", ["npy", "names beside a table", "table"])
def test_a_field_remembers_its_classes(tmp_path, kind):
    _, place = tree(tmp_path, kind)
    loaded = SemanticField.load(place)
    assert loaded.label_set().names == tuple(NAMES)
    assert torch.equal(loaded.label_set().embeddings, torch.from_numpy(ROWS))
    assert loaded.classify().labels.tolist() == [0, 1]
    assert loaded.label().labels.tolist() == [0, 1]
    assert loaded.query("chair").indices.tolist() == [1]


def test_paths_are_relative_to_the_field(tmp_path):
    scene, place = tree(tmp_path)
    noted = remember(scene, place)
    assert noted["scene"] == "../../../scenes/room"
    assert [one["path"] for one in noted["classes"]] == [
        "../../../scenes/room/classes.json",
        "../../../scenes/room/text.npy",
    ]
    assert json.loads(json.dumps(noted)) == noted


def test_classes_of_another_teacher_or_damaged_ones_are_not_remembered(tmp_path):
    scene, place = tree(tmp_path)
    assert "classes" in remember(scene, place, channels=ROWS.shape[1])
    assert "classes" not in remember(scene, place, channels=ROWS.shape[1] + 1)
    (scene / "text.npy").write_bytes(b"damaged")
    assert "classes" not in remember(scene, place, channels=ROWS.shape[1])


def test_the_whole_tree_may_move(tmp_path):
    tree(tmp_path / "before")
    shutil.move(tmp_path / "before", tmp_path / "after")
    loaded = SemanticField.load(tmp_path / "after" / "runs" / "today" / "field")
    assert loaded.label_set().names == tuple(NAMES)
    assert recall_scene(loaded.info, loaded.folder) == tmp_path / "after" / "scenes" / "room"


def test_a_field_may_be_reached_by_a_link_or_a_relative_path(tmp_path, monkeypatch):
    scene, place = tree(tmp_path)
    (tmp_path / "latest").symlink_to(place, target_is_directory=True)
    monkeypatch.chdir(tmp_path / "runs")
    for path in (tmp_path / "latest", "../latest", "today/field"):
        loaded = SemanticField.load(path)
        assert loaded.label_set().names == tuple(NAMES)
        assert recall_scene(loaded.info, loaded.folder) == scene


def test_a_changed_file_is_refused(tmp_path):
    scene, place = tree(tmp_path)
    (scene / "classes.json").write_text(json.dumps(NAMES[::-1]))
    with pytest.raises(ValueError, match=tells("classes:", "room/classes.json", "fitted")):
        SemanticField.load(place).classify()


def test_a_missing_file_and_a_missing_scene_are_named(tmp_path):
    scene, place = tree(tmp_path)
    (scene / "text.npy").unlink()
    loaded = SemanticField.load(place)
    with pytest.raises(FileNotFoundError, match=tells("room/text.npy:", "classes")):
        loaded.label_set()
    assert recall_scene(loaded.info, loaded.folder) == scene
    shutil.rmtree(scene)
    with pytest.raises(FileNotFoundError, match=tells("room:", "folder", "pass the scene")):
        recall_scene(loaded.info, loaded.folder)


def test_an_embedding_that_is_told_from_nothing_remembered_needs_no_files(tmp_path):
    scene, place = tree(tmp_path)
    shutil.rmtree(scene)
    loaded = SemanticField.load(place)
    row = torch.eye(4)[0]
    assert loaded.query(row, threshold=0.5, negatives="none").indices.tolist() == [0]
    assert loaded.query(row, negatives=torch.eye(4)[1:2]).indices.tolist() == [0]
    assert loaded.query(row, threshold=0.5).indices.tolist() == [0]  # a cosine: nothing is known to compare it with
    with pytest.raises(FileNotFoundError, match=tells("classes.json:", "pass the classes")):
        loaded.query(row, negatives="classes")


def test_what_is_not_remembered_is_asked_for():
    for info, folder in (({}, None), ({"scene": "../scene", "classes": [{"path": "x", "sha256": ""}]}, None)):
        with pytest.raises(ValueError, match=tells("classes:", "got neither")):
            recall_classes(info, folder)
        with pytest.raises(ValueError, match=tells("scene:", "remembers")):
            recall_scene(info, folder)


def test_a_scene_without_classes_is_remembered_without_them(tmp_path):
    (tmp_path / "classes.json").write_text("[]")  # names alone are no label set
    assert remember(tmp_path, tmp_path / "field") == {"scene": ".."}
