"""`kfgs evaluate`: every own protocol end to end, its JSON, and what is said when something does not fit."""

import inspect
import json
import re
import shutil

import numpy as np
import pytest
from evaluated_room import REMOVED, save_splats
from messages import tells
from PIL import Image
from small_room import fit_run, make_room

from kfgs import SemanticField, load_scene
from kfgs.cli import main
from kfgs.evaluation import PROTOCOLS, FieldMethod, KfgsPooled, LabelTruth, Report, View, load_label_map
from kfgs.labels import load_label_set
from kfgs.pipeline import evaluate, open_question
from kfgs.pipeline.question import LABELLED


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("evaluate") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def splats(room, tmp_path_factory):
    return save_splats(room, tmp_path_factory.mktemp("splats"))


@pytest.fixture(scope="module")
def fused(room, splats, tmp_path_factory):
    """A field whose own rule (votes) is not the nearest text."""
    out = tmp_path_factory.mktemp("fused") / "field"
    assert main(["uplift", str(room), str(splats / "before.ply"), "--out", str(out)]) == 0
    return out


def scored(capsys, *words):
    """What the command printed."""
    assert main(["evaluate", *map(str, words)]) == 0, capsys.readouterr().err
    return capsys.readouterr().out.strip()


def test_a_run_remembers_its_scene_and_its_score_is_the_protocols(run, room, tmp_path, capsys):
    capsys.readouterr()
    said = scored(capsys, run, "--out", tmp_path / "s.json").splitlines()[0]
    field, scene = SemanticField.load(run / "field"), load_scene(room)
    views = [View(scene.stem(i), scene.cameras[i]) for i in scene.views("test")]
    words = load_label_set(room / "classes.json", room / "text.npy")
    truth = LabelTruth(words.names, {v.stem: load_label_map(room / "labels" / f"{v.stem}.png") for v in views})
    expected = KfgsPooled().score(FieldMethod(field), truth, views, lambda names: words.embeddings)
    assert said == str(expected)
    kept = json.loads((tmp_path / "s.json").read_text())
    assert kept["scores"] == dict(expected.scores)
    assert (kept["protocol"], kept["version"], kept["options"]) == ("kfgs-pooled/1", 1, {"level": 0, "labels": "own"})
    assert set(kept["digests"]) == {"views", "truth", "texts", "field"}
    assert kept["machine"]
    assert kept["inputs"]["field"] == str(run)
    assert str(Report.from_json(kept)) == said


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("{run}/field --scene {room}", "mIoU"),
        ("{run} --protocol kfgs-surface", "agreement"),
        ("{splats}/before.ply --scene {room} --protocol kfgs-color", "PSNR"),
        (
            "{splats}/removed.ply --scene {room} --protocol kfgs-removal --set before={splats}/before.ply --set removed=plant",
            "gone",
        ),
        (
            "{splats}/painted.ply --scene {room} --protocol kfgs-recolor --set before={splats}/before.ply --set painted=plant "
            "--set rgb=#e61a1a",
            "psnr outside",
        ),
        ("{run} --protocol feature3dgs-teacher --set texts=classes --set split=none", "mIoU"),
        ("{splats}/before.ply --with-file {splats}/features.npy --scene {room}", "mIoU"),
        ("{splats}/before.ply --with-file {splats}/features.npy --scene {room} --protocol kfgs-surface", "agreement"),
        ("{room}/features --scene {room}", "mIoU"),
    ],
)
def test_every_own_protocol_end_to_end(words, shown, run, room, splats, tmp_path, capsys):
    capsys.readouterr()
    words = words.format(run=run, room=room, splats=splats).split()
    said = scored(capsys, *words, "--out", tmp_path / "s.json")
    assert shown in said
    kept = json.loads((tmp_path / "s.json").read_text())
    assert {"views", "truth", "field"} - set(kept["digests"]) <= {"views"}
    assert kept["scores"][next(iter(kept["scores"]))] is not None
    long = scored(capsys, *words, "--long")
    assert kept["about"] in long
    assert long.count("\n") > 5


def test_perfect_features_score_well_and_an_edit_is_measured(room, splats):
    words = load_label_set(room / "classes.json", room / "text.npy")
    both = {"with_file": splats / "features.npy", "encode": words}
    assert evaluate(splats / "before.ply", room, "kfgs-surface", **both).value > 0.99
    assert evaluate(splats / "before.ply", room, **both).value > 0.6
    edit = {"before": splats / "before.ply", "removed": REMOVED}
    gone = evaluate(splats / "removed.ply", room, "kfgs-removal", options=edit)
    kept = evaluate(splats / "before.ply", room, "kfgs-removal", options=edit)
    assert gone["gone points"] > 0.9 > 0.1 > kept["gone points"]
    assert gone.digests["truth"] == kept.digests["truth"]
    assert gone.digests["field"] != kept.digests["field"]


def test_digests_say_what_differs(room, splats, tmp_path):
    other = shutil.copytree(room, tmp_path / "other")
    one, two = open_question(room).digests, open_question(other).digests
    assert one == two
    assert open_question(room, split="train").digests["views"] != one["views"]
    first, second, *_ = [f"{load_scene(room).stem(i)}.png" for i in load_scene(room).views("test")]
    shutil.copy(room / "labels" / first, other / "labels" / second)
    changed = open_question(other).digests
    assert changed["views"] == one["views"]
    assert changed["truth"] != one["truth"]


def test_a_splat_before_the_edit_that_is_missing_is_named(room):
    with pytest.raises(FileNotFoundError, match=tells("none.ply", "no such file", "before the edit")):
        open_question(room, "kfgs-removal", options={"before": "none.ply", "removed": REMOVED})


def test_a_question_has_its_own_options(room, splats):
    with pytest.raises(TypeError, match=tells("scene", "split, labels", "open_question")):
        evaluate(splats / "before.ply", open_question(room), split="train", labels="nearest")


def test_label_pictures_of_test_views_are_scored_unless_a_split_is_named(room):
    assert len(open_question(room).views) == 3
    assert len(open_question(room, split="train").views) == 6
    assert len(open_question(room, split="all").views) == 9


def test_labels_of_scenesplat_are_read_with_the_protocols_classes(room, tmp_path):
    np.save(tmp_path / "coord.npy", np.zeros((2, 3)))
    for name, label in (("segment20", 15), ("segment200", 199)):
        np.save(tmp_path / f"{name}.npy", np.array([-1, label]))
    for benchmark, last in (("scannet20", "shower curtain"), ("scannet200", "mattress")):
        question = open_question(room, "scenesplat-fmiou", truth=tmp_path, options={"benchmark": benchmark})
        assert question.truth.names[int(question.truth.labels[1])] == last


def test_the_name_of_a_lerf_scene_reaches_the_protocol(run, room, tmp_path, capsys):
    scene = shutil.copytree(room, tmp_path / "teatime")
    loaded = load_scene(scene)
    camera, stem = loaded.cameras[0], loaded.stem(0)
    egg = {"category": "egg", "segmentation": [[1, 1], [9, 1], [9, 8]], "bbox": [1, 1, 5, 4]}
    info = {"name": f"{stem}.png", "width": camera.width, "height": camera.height}
    (scene / "label").mkdir()
    (scene / "label" / f"{stem}.json").write_text(json.dumps({"info": info, "objects": [egg]}))
    for split in (None, "all"):
        truth = open_question(scene, "lerf-ovs-3d", truth=scene / "label", split=split).truth
        assert (truth.scene, truth.texts, list(truth.frames)) == ("teatime", ("egg",), [stem])
    desk = tmp_path / "desk"
    desk.mkdir()
    plant = {**egg, "category": REMOVED}
    (desk / f"{stem}.json").write_text(json.dumps({"info": info, "objects": [plant]}))
    capsys.readouterr()
    said = scored(capsys, run, "--protocol", "lerf-ovs-3d", "--truth", desk, "--out", tmp_path / "s.json")
    note = "argmax over the annotated texts (1): no published list of the scene is known"
    assert said.splitlines()[1] == f"note: {note}"
    assert json.loads((tmp_path / "s.json").read_text())["notes"][0] == note
    assert note in scored(capsys, run, "--protocol", "lerf-ovs-3d", "--truth", desk, "--long")


def test_truth_elsewhere(run, room, tmp_path, capsys):
    labels = shutil.copytree(room / "labels", tmp_path / "truth" / "labels")
    shutil.copy(room / "classes.json", tmp_path / "truth")
    capsys.readouterr()
    first = scored(capsys, run)
    assert scored(capsys, run, "--truth", labels) == scored(capsys, run, "--truth", tmp_path / "truth") == first


VOTES = "the class of a pixel is the field's own, by votes"


def test_the_rule_for_labels_is_that_of_the_protocol_unless_asked_and_is_said(fused, room, tmp_path, capsys):
    field, scene = SemanticField.load(fused), load_scene(room)
    words = load_label_set(room / "classes.json", room / "text.npy")
    views = [View(scene.stem(i), scene.cameras[i]) for i in scene.views("test")]
    truth = LabelTruth(words.names, {v.stem: load_label_map(room / "labels" / f"{v.stem}.png") for v in views})
    expected = {
        rule: KfgsPooled().score(FieldMethod(field, own_labels=rule == "own"), truth, views, lambda _: words.embeddings)
        for rule in ("own", "nearest")
    }
    assert expected["own"].scores != expected["nearest"].scores
    capsys.readouterr()
    for given, rule in (((), "own"), (("--labels", "own"), "own"), (("--labels", "nearest"), "nearest")):
        said = scored(capsys, fused, *given, "--out", tmp_path / f"{rule}.json")
        kept = json.loads((tmp_path / f"{rule}.json").read_text())
        assert kept["scores"] == dict(expected[rule].scores)
        assert kept["options"]["labels"] == rule
        assert any(note.startswith(VOTES) for note in kept["notes"]) == (rule == "own") == (f"note: {VOTES}" in said)
        assert ("labels=nearest" in said.splitlines()[0]) == (rule == "nearest")
        assert kept["inputs"]["labels"] == (given[1] if given else None)
    assert main(["compare", str(tmp_path / "own.json"), str(tmp_path / "nearest.json")]) == 1
    assert "differ in option labels (own and nearest)" in capsys.readouterr().err
    asked = {"encode": words, "options": {"texts": words.names, "split": None}}
    published = evaluate(fused, room, "feature3dgs-teacher", **asked)
    own = evaluate(fused, room, "feature3dgs-teacher", labels="own", **asked)
    assert (published.options["labels"], published.changed) == ("nearest", ("texts", "split"))
    assert (own.options["labels"], own.changed) == ("own", ("texts", "split", "labels"))
    assert published.scores != own.scores
    assert not any(note.startswith(VOTES) for note in published.notes)
    method = FieldMethod(field, own_labels=False)
    assert evaluate(method, room, encode=words).options["labels"] == "nearest"  # it keeps its rule, unless one is asked
    assert evaluate(method, room, encode=words, labels="own").scores == expected["own"].scores


def test_protocols_that_take_a_class_per_pixel_are_known():
    assert set(LABELLED) == {name for name, one in PROTOCOLS.items() if "label_view(" in inspect.getsource(one)}


@pytest.mark.parametrize(("split", "trained"), [("test", None), ("train", "6 of 6"), ("all", "6 of 9")])
def test_views_that_were_trained_on_are_counted(split, trained, fused, room):
    words = load_label_set(room / "classes.json", room / "text.npy")
    report = evaluate(fused, room, encode=words, split=split)
    found = [note for note in report.notes if "trained" in note]
    assert found == ([] if trained is None else [f"{trained} scored views were trained on"])
    assert f"scored pictures: {len(open_question(room, split=split).views)} of 60x80 (height x width)" in report.notes


def test_a_folder_of_kfgs_color_has_no_features(run, splats, room, tmp_path, capsys):
    shutil.copytree(run / "stages", tmp_path / "colors" / "stages")
    shutil.copy(splats / "before.ply", tmp_path / "colors" / "color.ply")
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "colors"), "--scene", str(room)]) == 1
    said = capsys.readouterr().err
    assert re.search(
        "FIELD: expected a result with features for kfgs-pooled/1, .* no features; .*kfgs fit.*kfgs uplift", said
    )
    assert "PSNR" in scored(capsys, tmp_path / "colors", "--scene", room, "--protocol", "kfgs-color")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{run} --protocol kfgs-poled", "--protocol: expected one of kfgs-pooled/1, .* did you mean kfgs-pooled/1"),
        ("{run} --protocol lerf-ovs-2d", "--truth: expected masks in .*found none"),
        ("{run} --protocol scannet-points --truth {room}/images", "--truth: expected labelled points"),
        ("{run} --truth /nothing", "--truth: expected label pictures in /nothing .*no such folder"),
        ("{run} --split nothing", "--split: expected one of train, test"),
        (
            "{run} --protocol kfgs-surface --labels own",
            "--labels: expected none with kfgs-surface/1, .*no class per pixel",
        ),
        ("{run} --set threshold=1", "--set: expected name=value with one of level, got 'threshold=1'"),
        ("{run} --set lvel=1", "did you mean level"),
        ("{run} --set level=x", "--set: expected level as a whole number"),
        ("{run} --set level=0 --set level=0", "--set: expected level once"),
        ("{run} --with-file x.pth", "--with-file: expected none with a result of kfgs"),
        ("{run} --out {run}", "--out: expected a file or nothing"),
        ("{run} --weights x", "--weights: expected none without --teacher"),
        (
            "{run} --protocol feature3dgs-teacher",
            "--text: expected embeddings of all 150 texts .*teacher with a text encoder",
        ),
        ("{run} --protocol feature3dgs-teacher --truth /no", "--truth: expected the teacher's feature maps"),
        ("{run} --protocol kfgs-color", "color.ply: no such file; expected a colour splat"),
        ("{run} --protocol kfgs-removal", "--set: expected before=FILE, removed=CLASS"),
        ("{run} --protocol kfgs-color --truth {room}", "--truth: expected none with kfgs-color/1"),
        (
            "{room}/features --scene {room} --protocol kfgs-surface",
            "FIELD: expected a result with Gaussians for kfgs-surface/1",
        ),
        (
            "{room}/features --scene {room} --protocol kfgs-color",
            "FIELD: expected a result with Gaussians for kfgs-color/1",
        ),
        ("{room}/features", "--scene: expected a scene folder, got none"),
        ("{room} --scene {room}", "expected a result of a known program"),
        ("nothing --scene {room}", "nothing: no such file or folder"),
        ("{splats}/before.ply --scene {room}", "expected columns semantic_0.*features as --with-file"),
        (
            "{splats}/before.ply --with-file {splats}/features.npy --scene {bare}",
            "--text: expected text embeddings, got none",
        ),
    ],
)
def test_mistakes_are_named(words, message, run, room, splats, tmp_path, capsys):
    bare = shutil.copytree(room, tmp_path / "bare", ignore=shutil.ignore_patterns("text.npy"))
    capsys.readouterr()
    assert main(["evaluate", *words.format(run=run, room=room, splats=splats, bare=bare).split()]) == 1
    assert re.search(message, capsys.readouterr().err)


def test_half_made_runs_are_said_to_be(run, room, tmp_path):
    shutil.copytree(run / "stages", tmp_path / "half" / "stages")
    with pytest.raises(ValueError, match="expected a finished run"):
        evaluate(tmp_path / "half", room, encode=load_label_set(room / "classes.json", room / "text.npy"))


def test_masks_of_a_scene_are_found(room, splats, tmp_path):
    scene = load_scene(room)
    masked = shutil.copytree(room, tmp_path / "scene", ignore=shutil.ignore_patterns("labels"))
    names = json.loads((room / "classes.json").read_text())
    (masked / "segmentations").mkdir()
    (masked / "segmentations" / "classes.txt").write_text("\n".join(names))
    for i in scene.views("test"):
        stem = scene.stem(i)
        labels = load_label_map(room / "labels" / f"{stem}.png").numpy()
        (masked / "segmentations" / stem).mkdir()
        for label in np.unique(labels):
            mask = Image.fromarray(np.uint8(labels == label) * 255)
            mask.save(masked / "segmentations" / stem / f"{names[label]}.png")
    words = load_label_set(room / "classes.json", room / "text.npy")
    both = {"encode": words, "with_file": splats / "features.npy"}
    closed = evaluate(splats / "before.ply", masked, "3dovs-closed", **both)
    assert closed.value > 0.6
    again = evaluate(splats / "before.ply", open_question(masked, "3dovs-closed", split="test"), **both)
    assert dict(again.scores) == dict(closed.scores)
