"""`kfgs evaluate`: every own protocol end to end, its JSON, and what is said when something does not fit."""

import json
import re
import shutil

import numpy as np
import pytest
from evaluated_room import REMOVED, save_splats
from PIL import Image
from small_room import fit_run, make_room

from kfgs import SemanticField, load_scene
from kfgs.cli import main
from kfgs.evaluation import FieldMethod, KfgsPooled, LabelTruth, Report, View, load_label_map
from kfgs.labels import load_label_set
from kfgs.pipeline import evaluate, open_question


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("evaluate") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def splats(room, tmp_path_factory):
    return save_splats(room, tmp_path_factory.mktemp("splats"))


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
    assert (kept["protocol"], kept["version"], kept["options"]) == ("kfgs-pooled/1", 1, {"level": 0})
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


def test_label_pictures_of_test_views_are_scored_unless_a_split_is_named(room):
    assert len(open_question(room).views) == 3
    assert len(open_question(room, split="train").views) == 6
    assert len(open_question(room, split="all").views) == 9


def test_truth_elsewhere(run, room, tmp_path, capsys):
    labels = shutil.copytree(room / "labels", tmp_path / "truth" / "labels")
    shutil.copy(room / "classes.json", tmp_path / "truth")
    capsys.readouterr()
    first = scored(capsys, run)
    assert scored(capsys, run, "--truth", labels) == scored(capsys, run, "--truth", tmp_path / "truth") == first


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{run} --protocol kfgs-poled", "--protocol: expected one of kfgs-pooled/1, .* did you mean kfgs-pooled/1"),
        ("{run} --protocol lerf-ovs-2d", "--truth: expected masks in .*found none"),
        ("{run} --protocol scannet-points --truth {room}/images", "--truth: expected labelled points"),
        ("{run} --truth /nothing", "--truth: expected label pictures in /nothing .*no such folder"),
        ("{run} --split nothing", "--split: expected one of train, test"),
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
