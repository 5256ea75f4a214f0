"""Search over many fields: exact answers about classes, answers by words, and what keeps the index right."""

import dataclasses
import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_search import COUNT, NAMES, save_scenes, scene, table
from messages import tells

from kfgs._files import digest_file
from kfgs.fields import SemanticField
from kfgs.fields.remembered import remember
from kfgs.labels import connected_parts
from kfgs.scale import SearchIndex, search_state
from kfgs.scale.search_file import NAME
from kfgs.scale.search_found import Changes


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Four scenes of one teacher and one of another."""
    folder = tmp_path_factory.mktemp("runs")
    return save_scenes(
        folder,
        a=scene([("wall", 0.0), ("chair", 0.0), ("chair", 3.0)], 1),
        b=scene([("wall", 0.0), ("table", 0.0)], 2),
        c=scene([("wall", 0.0), ("chair", 1.0)], 3),
        d=scene([("wall", 0.0), ("boat", 0.0)], 4, words=table(("wall", "chair"))),
        other=scene([("wall", 0.0), ("chair", 0.0)], 5, teacher="another"),
    )


@pytest.fixture(scope="module")
def index(runs):
    found, changes = SearchIndex.open(runs).update()
    assert changes.added == tuple(f"{name}/field" for name in ("a", "b", "c", "d", "other"))
    return found


def same_as_select(found, folder, target, *arguments, **options):
    """A scene's answer is what the field itself answers."""
    field = SemanticField.load(folder / found.path)
    selection = field.query(target, *arguments, **options)
    parts = connected_parts(field.gaussians, selection, field.cameras)
    assert found.exact
    assert found.gaussians == len(field)
    assert found.count == len(selection)
    assert [part.count for part in found.parts] == [part.count for part in parts]
    for mine, theirs in zip(found.parts, parts, strict=True):
        assert mine.score == pytest.approx(theirs.score, abs=1e-6)
        assert mine.center == pytest.approx(theirs.centroid.tolist(), abs=1e-5)
        assert (mine.low, mine.high) == tuple(pytest.approx(corner.tolist(), abs=1e-5) for corner in theirs.extent)
        assert mine.view == theirs.best_view.camera
        assert mine.share == pytest.approx(theirs.best_view.share, rel=1e-4)
    assert found.score == pytest.approx(max(part.score for part in parts), abs=1e-6)


def test_a_class_is_answered_exactly_as_the_fields_do(index, runs):
    found = index.search("chair")
    assert {scene.path for scene in found.scenes} - {"d/field"} == {"a/field", "c/field", "other/field"}
    assert (found.searched, found.unasked) == (5, {})
    for one in found.scenes:
        same_as_select(one, runs, "chair")
    assert {one.path: len(one.parts) for one in found.scenes if one.path != "d/field"} == {
        "a/field": 2,
        "c/field": 1,
        "other/field": 1,
    }
    assert next(one for one in found.scenes if one.path == "c/field").parts[0].view == "at the chair"
    scores = [one.score for one in found.scenes]
    assert scores == sorted(scores, reverse=True)
    assert index.search("CHAIR").scenes == found.scenes


def test_a_class_that_only_other_tables_know_is_asked_by_words(index, runs):
    (found,) = (one for one in index.search("boat").scenes if one.path == "d/field")  # its own table lacks it
    assert not found.exact
    field = SemanticField.load(runs / "d" / "field")
    assert found.count == len(field.query("boat", table())) == COUNT - 3
    (exact,) = (one for one in index.search("boat", exact=5).scenes if one.path == "d/field")
    same_as_select(exact, runs, "boat", table())


@pytest.mark.parametrize(
    "options", [{"threshold": 0.9}, {"score": "cosine"}, {"negatives": "canonical"}, {"score": "softmax"}]
)
def test_other_options_are_answered_by_words_and_exactly_if_asked(index, runs, options):
    words = {one.path: one for one in index.search("chair", **options).scenes}
    exact = {one.path: one for one in index.search("chair", exact=9, **options).scenes}
    assert not any(one.exact for one in words.values())
    for name in ("a/field", "c/field"):
        same_as_select(exact[name], runs, "chair", **options)
        assert words[name].count == exact[name].count
        assert [part.count for part in words[name].parts] == [part.count for part in exact[name].parts]
        assert words[name].parts[0].view == exact[name].parts[0].view
        assert words[name].parts[0].center == pytest.approx(exact[name].parts[0].center, abs=1e-4)
        assert words[name].parts[0].high == pytest.approx(exact[name].parts[0].high, abs=1e-4)


def test_an_embedding_finds_its_class_in_every_scene(index):
    row = table().embeddings[NAMES.index("table")]
    found = index.search(row)
    assert [one.path for one in found.scenes] == ["b/field"]
    assert found.scenes[0].count == COUNT - 3
    assert index.search(row.numpy()).scenes == found.scenes


def test_a_table_of_another_teacher_is_refused_where_it_does_not_fit(index):
    found = index.search("chair", table())
    assert found.unasked.keys() == {"other/field"}
    assert "another" in found.unasked["other/field"]
    assert found.searched == 4
    with pytest.raises(ValueError, match=tells("embedding:", "24", "(7,)")):
        index.search(torch.ones(7))


def test_an_example_finds_its_like_by_the_same_teacher(index, runs):
    found = index.like(runs / "a" / "field", COUNT + 3)  # a Gaussian of the first chair
    assert {one.path for one in found.scenes} == {"a/field", "c/field"}
    assert sum(one.count for one in found.scenes) == 2 * COUNT - 3 + COUNT - 3
    assert found.unasked == {"other/field": "another teacher"}
    exact = index.like(runs / "a" / "field", COUNT + 3, 0.8, exact=2)
    assert all(one.exact for one in exact.scenes)
    with pytest.raises(ValueError, match=tells("index:", "none shows")):
        index.like(runs / "a" / "field", 3 * COUNT - 1)
    with pytest.raises(ValueError, match=tells("index", 3 * COUNT)):
        index.like(runs / "a" / "field", 3 * COUNT)


def test_an_unknown_class_offers_near_names(index):
    with pytest.raises(ValueError, match=tells("class:", "'chiar'", "'chair'")):
        index.search("chiar")


def test_words_of_old_scenes_stay_when_scenes_come_and_go(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    before, _ = SearchIndex.open(tmp_path).update()
    save_scenes(tmp_path, b=scene([("table", 0.0), ("lamp", 0.0)], 2))
    assert not before.is_current()
    after, changes = before.update()
    assert changes.added == ("b/field",)
    old, new = before.contents.spaces[0].words, after.contents.spaces[0].words
    assert len(new) > len(old)
    assert (new[: len(old)] == old).all()
    rows = (one.contents.entries["a/field"].rows["atoms"]["word"] for one in (before, after))
    assert next(rows).tolist() == next(rows).tolist()
    shutil.rmtree(tmp_path / "a")
    last, changes = after.update()
    assert (changes.removed, last.fields) == (("a/field",), ("b/field",))
    assert (last.contents.spaces[0].words == new).all()
    assert {one.path for one in SearchIndex.open(tmp_path).search("lamp").scenes} == {"b/field"}


def test_a_changed_field_is_described_again_and_a_touched_one_is_not(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1), b=scene([("wall", 0.0)], 2))
    index, _ = SearchIndex.open(tmp_path).update()
    assert index.is_current()
    (tmp_path / "b" / "field" / "field.json").touch()
    assert not index.is_current()  # its time is noted
    index, changes = index.update()
    assert changes.added == ()  # by its digest
    assert index.is_current()
    save_scenes(tmp_path, b=scene([("wall", 0.0), ("chair", 0.0)], 2))
    assert not index.is_current()
    index, changes = index.update()
    assert changes.added == ("b/field",)
    assert {one.path for one in index.search("chair").scenes} == {"a/field", "b/field"}
    assert len(index) == 2


def test_a_damaged_field_is_left_out_until_it_changes(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1), b=scene([("chair", 0.0)], 2))
    numbers = tmp_path / "b" / "field" / "field.safetensors"
    whole = numbers.read_bytes()
    numbers.write_bytes(whole[:-4])
    said = []
    index, changes = SearchIndex.open(tmp_path).update(report=said.append)
    assert changes.failed.keys() == {"b/field"}
    assert "b/field" in said[0].replace("\\", "/")
    index = SearchIndex.open(tmp_path)
    assert index.is_current()  # it is not tried at every search
    assert index.search("chair").unasked.keys() == {"b/field"}
    save_scenes(tmp_path, b=scene([("chair", 0.0)], 2))
    assert not index.is_current()
    assert index.update()[0].search("chair").unasked == {}


def test_packed_fields_runs_and_nested_folders_are_found_stages_are_not(tmp_path):
    field = scene([("wall", 0.0), ("chair", 0.0)], 1)
    for place in ("deep/er/run/field", "run/field", "run/stages/x", ".hidden/field"):
        field.save(tmp_path / place)
    field.save(tmp_path / "one.kfgs.safetensors")
    index, _ = SearchIndex.open(tmp_path).update()
    assert index.fields == ("deep/er/run/field", "one.kfgs.safetensors", "run/field")
    assert len(index.search("chair").scenes) == 3
    with pytest.raises(NotADirectoryError, match=tells("folder:", "nowhere")):
        SearchIndex.open(tmp_path / "nowhere")


def test_fields_without_classes_views_or_fused_features_can_be_searched(tmp_path):
    bare = dataclasses.replace(scene([("wall", 0.0), ("chair", 0.0)], 1), words=None, cameras=())
    old = scene([("wall", 0.0), ("chair", 0.0)], 2)
    old = SemanticField(old.gaussians.replace(features=old.linear.decode(old.features)), words=table(), info=old.info)
    nothing = scene([("wall", 0.0)], 3)
    nothing = dataclasses.replace(nothing, gaussians=nothing.gaussians.replace(features=nothing.features * 0))
    save_scenes(tmp_path, bare=bare, old=old, nothing=nothing)
    index, changes = SearchIndex.open(tmp_path).update()
    assert changes.failed == {}
    found = {one.path: one for one in index.search("chair").scenes}
    assert found.keys() == {"bare/field", "old/field"}
    assert (found["bare/field"].exact, found["old/field"].exact) == (False, True)
    assert found["bare/field"].count == found["old/field"].count == COUNT - 3
    assert found["bare/field"].parts[0].view is None
    empty, _ = SearchIndex.open(tmp_path / "nothing").update()
    assert empty.search("wall").scenes == ()


def test_fifty_fields_are_searched_from_one_file(tmp_path):
    things = [("wall", 0.0), ("chair", 0.0)], [("wall", 0.0), ("lamp", 0.0)]
    for i in range(50):
        scene(things[i % 5 == 0], seed=i).save(tmp_path / f"scene_{i:02d}" / "field")
    index, _ = SearchIndex.open(tmp_path).update()
    assert len(index) == 50
    assert len(index.contents.spaces[0].words) < 12  # shared: three classes
    assert {one.path for one in index.search("lamp").scenes} == {f"scene_{i:02d}/field" for i in range(0, 50, 5)}
    assert (tmp_path / NAME).stat().st_size < 50 * 8_000


def test_a_run_may_be_called_as_a_part_of_a_run(tmp_path):
    field = scene([("wall", 0.0), ("chair", 0.0)], 1)
    for name in ("stages", "unfinished"):
        field.save(tmp_path / name / "field")
        field.save(tmp_path / "run" / name / "deep")  # in a run's own folders nothing is a result
    (tmp_path / "run" / "digests.json").write_text("{}")
    index, _ = SearchIndex.open(tmp_path).update()
    assert index.fields == ("stages/field", "unfinished/field")


def test_a_copied_archive_is_digested_once_and_a_moved_one_never(tmp_path, monkeypatch):
    save_scenes(tmp_path / "old", a=scene([("wall", 0.0), ("chair", 0.0)], 1), b=scene([("wall", 0.0)], 2))
    SearchIndex.open(tmp_path / "old").update()
    read = []
    monkeypatch.setattr(search_state, "digest_file", lambda file: read.append(file) or digest_file(file))
    (tmp_path / "old").rename(tmp_path / "moved")
    index = SearchIndex.open(tmp_path / "moved")
    assert index.is_current()
    assert [one.path for one in index.search("chair", exact=2).scenes] == ["a/field"]
    shutil.copytree(tmp_path / "moved", tmp_path / "copy", copy_function=shutil.copyfile)
    index = SearchIndex.open(tmp_path / "copy")
    assert not index.is_current()
    assert read == []
    index, changes = index.update()
    assert (changes, len(read)) == (Changes(), 4)  # two files each
    again = SearchIndex.open(tmp_path / "copy")
    assert again.is_current()
    assert again.update()[1] == Changes()
    assert len(read) == 4
    (tmp_path / "copy" / "a" / "field" / "field.json").touch()
    assert again.update()[1] == Changes()
    assert [file.name for file in read[4:]] == ["field.json"]


def test_scenes_in_any_order_give_the_same_answers(tmp_path):
    scenes = {
        "a": scene([("wall", 0.0), ("chair", 0.0)], 1),
        "b": scene([("table", 0.0), ("chair", 0.0)], 2),
        "c": scene([("lamp", 0.0), ("wall", 0.0), ("table", 0.0)], 3),
    }
    found = []
    for order in ("abc", "cba"):
        for name in order:
            save_scenes(tmp_path / order, **{name: scenes[name]})
            index, _ = SearchIndex.open(tmp_path / order).update()
        words = index.contents.spaces[0].words
        assert len(words) == 4
        found.append([[(one.path, one.count) for one in index.search(name, table()).scenes] for name in NAMES[:4]])
        assert all(one.outside < 0.05 for one in index.contents.entries.values())
    assert [sorted(one) for one in found[0]] == [sorted(one) for one in found[1]]
    assert sum(map(len, found[0])) == 7


def test_a_field_that_goes_while_it_is_indexed_is_left_out(tmp_path, monkeypatch):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1), b=scene([("chair", 0.0)], 2))
    load = SemanticField.load

    def lost(path):
        shutil.rmtree(tmp_path / "b", ignore_errors=True)
        return load(path)

    monkeypatch.setattr(SemanticField, "load", staticmethod(lost))
    index, changes = SearchIndex.open(tmp_path).update()
    assert index.fields == ("a/field",)
    assert changes.failed.keys() == {"b/field"}
    assert SearchIndex.open(tmp_path).update()[1].removed == ("b/field",)


@pytest.fixture
def shared(tmp_path):
    """A field that remembers the classes of its scene, and the file of their embeddings."""
    (tmp_path / "scene").mkdir()
    words = table()
    (tmp_path / "scene" / "classes.json").write_text(json.dumps(words.names))
    np.save(tmp_path / "scene" / "text.npy", words.embeddings.numpy())
    field = dataclasses.replace(scene([("wall", 0.0), ("chair", 0.0)], 1), words=None)
    notes = remember(tmp_path / "scene", tmp_path / "runs" / "field")
    dataclasses.replace(field, info=field.info | notes).save(tmp_path / "runs" / "field")
    return tmp_path / "scene" / "text.npy"


def test_classes_that_changed_are_not_answered_from_the_index(shared, tmp_path):
    """As `kfgs select`, which refuses them."""
    index, said = SearchIndex.open(tmp_path / "runs").update()[0], []
    assert index.search("chair").scenes[0].exact
    whole = shared.read_bytes()
    shared.touch()
    assert not index.is_current()
    index, changes = index.update(report=said.append)
    assert (changes, said, index.is_current()) == (Changes(), [], True)
    np.save(shared, np.load(shared)[::-1].copy())  # as large as before
    with pytest.raises(ValueError, match=tells("as it was when the field was fitted")):
        SemanticField.load(tmp_path / "runs" / "field").query("chair")
    assert not index.is_current()
    index, changes = index.update(report=said.append)
    assert len(changes.added) == 1
    assert "classes are left out" in said[0]
    assert "as it was when the field was fitted" in said[0]
    with pytest.raises(ValueError, match=tells("class: expected one that a field knows", "'chair'")):
        index.search("chair")
    shared.unlink()
    assert not index.is_current()
    index, _ = index.update()
    assert index.is_current()
    shared.write_bytes(whole)
    assert not index.is_current()
    assert index.update()[0].search("chair").scenes[0].exact


def test_a_field_that_is_cut_short_later_is_not_answered_from_the_index(tmp_path):
    save_scenes(tmp_path, a=scene([("wall", 0.0), ("chair", 0.0)], 1))
    index, _ = SearchIndex.open(tmp_path).update()
    numbers = tmp_path / "a" / "field" / "field.safetensors"
    whole = numbers.read_bytes()
    numbers.write_bytes(whole[:-4])
    assert not index.is_current()
    index, changes = index.update()
    assert changes.failed.keys() == index.search("chair").unasked.keys() == {"a/field"}
    numbers.write_bytes(whole)
    assert not index.is_current()
    assert len(index.update()[0].search("chair").scenes) == 1


def test_a_field_that_cannot_be_asked_itself_keeps_the_answer_by_words(tmp_path):
    save_scenes(tmp_path, **{name: scene([("wall", 0.0), ("chair", 0.0)], i) for i, name in enumerate("ab")})
    index, _ = SearchIndex.open(tmp_path).update()
    (tmp_path / "a" / "field" / "field.safetensors").write_bytes(b"")
    found = index.search("chair", threshold=0.6, exact=2)
    assert {one.path: one.exact for one in found.scenes} == {"a/field": False, "b/field": True}
    assert found.unasked.keys() == {"a/field"}
    assert "itself: " in found.unasked["a/field"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_a_name_that_is_no_text_is_left_out_by_name_and_the_index_stays_readable(tmp_path):
    field = scene([("wall", 0.0), ("chair", 0.0)], 1)
    save_scenes(tmp_path, ok=field)
    shutil.copytree(tmp_path / "ok", os.fsdecode(bytes(tmp_path) + b"/caf\xe9"))
    changes = SearchIndex.open(tmp_path).update()[1]
    assert changes.added == ("ok/field",)
    again = SearchIndex.open(tmp_path)
    assert again.is_current()
    assert [one.path for one in again.search("chair").scenes] == ["ok/field"]
    assert list(again.search("chair").unasked) == [r"caf\udce9/field"]
    assert "rename the folder" in again.search("chair").unasked[r"caf\udce9/field"]
    deep = os.fsdecode(bytes(tmp_path) + b"/caf\xe9")  # a folder that is searched may have any name
    (Path(deep) / "field" / "field.safetensors").write_bytes(b"")
    assert SearchIndex.open(deep).update()[1].failed.keys() == {"field"}
    assert SearchIndex.open(deep).is_current()
