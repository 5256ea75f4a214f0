"""`kfgs compare`: its numbers are those of evaluate, its pictures show something, and numbers that differ in kind are refused."""

import json
import re
import shutil
from types import SimpleNamespace

import cases_methods as cases
import numpy as np
import pytest
import torch
from evaluated_room import save_splats
from PIL import Image
from small_room import fit_run, make_room

from kfgs.cli import main
from kfgs.evaluation import LerfOvs2D, MaskAndBoxes, MaskTruth, OVS3DClosed
from kfgs.labels import load_label_set
from kfgs.pipeline import open_question
from kfgs.pipeline.evaluate import open_result
from kfgs.pipeline.side_by_side import VOID, WRONG, _show_labels, draw_errors, show_views


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("compare") / "scene")


@pytest.fixture(scope="module")
def run(room, tmp_path_factory):
    return fit_run(room, tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def kept(room, run, tmp_path_factory):
    """Three evaluations in JSON: the field and the teacher's maps under one protocol, and the field under another."""
    out = tmp_path_factory.mktemp("kept")
    splats = save_splats(room, out)
    features = ["--with-file", str(splats / "features.npy"), "--scene", str(room)]
    assert main(["evaluate", str(run), "--out", str(out / "field.json")]) == 0
    assert main(["evaluate", str(room / "features"), "--scene", str(room), "--out", str(out / "teacher.json")]) == 0
    assert main(["evaluate", str(splats / "before.ply"), *features, "--out", str(out / "exact.json")]) == 0
    assert main(["evaluate", str(run), "--protocol", "kfgs-surface", "--out", str(out / "surface.json")]) == 0
    assert main(["evaluate", str(run), "--split", "train", "--out", str(out / "train.json")]) == 0
    return out


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def colors_in(path):
    return len(np.unique(pixels(path).reshape(-1, 3), axis=0))


def test_numbers_are_those_of_evaluate_and_pictures_show_something(run, room, kept, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "again")
    names = ["field.json", "teacher.json", "exact.json"]
    words = [*(str(kept / name) for name in names), str(tmp_path / "again"), "--scene", str(room), "--pictures", "2"]
    capsys.readouterr()
    assert main(["compare", *words, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert len(found) == 4
    scores = [one["scores"]["mIoU"] for one in found.values()]
    assert scores == sorted(scores, reverse=True)
    expected = {name: json.loads((kept / name).read_text())["scores"] for name in names}
    title = {one["digests"]["field"]: name for name, one in found.items()}
    for name in names:
        digest = json.loads((kept / name).read_text())["digests"]["field"]
        assert found[title[digest]]["scores"] == expected[name]
        assert re.search(rf"^{re.escape(title[digest])} +{expected[name]['mIoU']:.3f}", said, re.MULTILINE)
    assert scores.count(expected["field.json"]["mIoU"]) == 2  # the run that was scored now, and before
    assert (tmp_path / "out" / "compare.txt").read_text().strip() in said
    pictures = sorted((tmp_path / "out").glob("*.png"))
    assert len(pictures) == 2
    for picture in pictures:
        assert colors_in(picture) > 200
        assert pixels(picture).shape[1] > 6 * 320  # photograph, truth, four results


def test_second_files_reach_their_results(run, room, kept, tmp_path, capsys):
    features, scene = kept / "features.npy", ["--scene", str(room)]
    expected = json.loads((kept / "exact.json").read_text())
    capsys.readouterr()
    one = [str(run), str(kept / "before.ply"), "--with-file", str(features), *scene, "--pictures", "0"]
    assert main(["compare", *one, "--out", str(tmp_path / "one")]) == 0
    found = json.loads((tmp_path / "one" / "compare.json").read_text())
    (exact,) = (report for report in found.values() if report["digests"]["field"] == expected["digests"]["field"])
    assert exact["scores"] == expected["scores"]
    shutil.copy(kept / "before.ply", tmp_path / "b=c.ply")
    np.save(tmp_path / "zero.npy", np.roll(np.load(features), 1, 0))
    files = [f"{kept}/before.ply={features}", f"{tmp_path}/b=c.ply={tmp_path}/zero.npy"]
    two = [str(kept / "before.ply"), str(tmp_path / "b=c.ply"), *scene, "--pictures", "1"]
    assert (
        main(["compare", *two, "--with-file", files[0], "--with-file", files[1], "--out", str(tmp_path / "two")]) == 0
    )
    found = json.loads((tmp_path / "two" / "compare.json").read_text())
    assert found["before"]["scores"] == expected["scores"]
    assert found["b=c"]["scores"] != expected["scores"]
    assert len(list((tmp_path / "two").glob("*.png"))) == 1


def test_errors_are_where_labels_differ(room, run):
    words = load_label_set(room / "classes.json", room / "text.npy")
    question = open_question(room)
    shown = show_views(question, {"field": open_result(run, question)}, lambda names: words.embeddings, 3)
    assert list(shown) == [view.stem for view in question.views]
    for one in shown.values():
        picture, errors, share = one.answers["field"]
        truth, labels = one.labels
        wrong = (labels != truth) & (truth >= 0)
        assert share == pytest.approx(float(wrong.float().mean()))
        assert 0.01 < share < 0.9
        vermilion = (errors[..., 0] - errors[..., 2]) > 0.3
        assert bool((vermilion == wrong).all())
        assert picture.shape == tuple(errors.shape)


def test_pixels_that_no_level_knows_have_no_class_in_pictures():
    truth, maps = torch.zeros(2, 3, dtype=torch.bool), torch.full((2, 2, 3), torch.nan)
    truth[:, :2] = True
    low, high = maps.clone(), maps.clone()
    low[0, :, 1:], high[1, :, 1:] = 0.1, 0.2  # each level knows one text's score; the first column is unknown to both
    low[1, :, 1:], high[0, :, 1:] = -0.3, -0.2
    method = cases.Numbers(["mug", "spoon"], {"a": {"mug": low, "spoon": high}})
    view = cases.view("a", 2, 3)
    question = SimpleNamespace(
        protocol=LerfOvs2D(), truth=MaskTruth({"a": {t: MaskAndBoxes(truth) for t in method.texts}})
    )
    shown = _show_labels(question, torch.rand(2, 3, 3), view, {"it": method}, method.encode)
    assert shown.labels[1].tolist() == [[-1, 1, 1]] * 2


def test_pictures_of_a_closed_set_choose_from_all_texts():
    mask, maps = torch.ones(2, 3, dtype=torch.bool), torch.full((1, 2, 3), 0.1)
    method = cases.Numbers(["mug", "spoon"], {"a": {"mug": maps, "spoon": maps + 0.1}})
    truth = MaskTruth({"a": {"mug": MaskAndBoxes(mask)}}, listed=("mug", "spoon"))  # no spoon in this view
    question = SimpleNamespace(protocol=OVS3DClosed(), truth=truth)
    shown = _show_labels(question, torch.rand(2, 3, 3), cases.view("a", 2, 3), {"it": method}, method.encode)
    assert shown.labels[1].eq(1).all()
    assert shown.answers["it"][2] == 1


def test_void_is_plain_grey():
    photo = torch.rand(4, 5, 3)
    wrong, void = torch.zeros(4, 5), torch.zeros(4, 5, dtype=torch.bool)
    wrong[1], void[2] = 1, True
    found = draw_errors(photo, wrong, void)
    assert bool((found[2] == VOID).all())
    assert float((found[1] - torch.tensor(WRONG)).abs().max()) < 0.15


def test_pictures_of_colours_and_of_a_teacher(room, run, kept, tmp_path, capsys):
    for name in ("before", "painted"):
        shutil.copy(kept / f"{name}.ply", tmp_path / f"{name}.ply")
    both = [str(tmp_path / "before.ply"), str(tmp_path / "painted.ply"), "--scene", str(room)]
    capsys.readouterr()
    assert (
        main(["compare", *both, "--protocol", "kfgs-color", "--pictures", "1", "--out", str(tmp_path / "color")]) == 0
    )
    assert "PSNR" in capsys.readouterr().out
    (picture,) = (tmp_path / "color").glob("*.png")
    assert colors_in(picture) > 200
    teacher = ["--protocol", "feature3dgs-teacher", "--set", "texts=classes", "--set", "split=none", "--pictures", "1"]
    shutil.copytree(run, tmp_path / "b")
    assert main(["compare", str(run), str(tmp_path / "b"), *teacher, "--out", str(tmp_path / "taught")]) == 0
    assert len(list((tmp_path / "taught").glob("*.png"))) == 1
    surface = ["--protocol", "kfgs-surface", "--out", str(tmp_path / "points")]
    assert main(["compare", str(run), str(tmp_path / "b"), *surface]) == 0
    assert "note: no pictures: kfgs-surface/1" in capsys.readouterr().out


def test_a_field_that_changed_is_not_drawn(room, run, kept, tmp_path, capsys):
    one = json.loads((kept / "field.json").read_text())
    one["digests"]["field"] = "0"
    (tmp_path / "changed.json").write_text(json.dumps(one))
    one["inputs"]["field"] = str(tmp_path / "gone")
    (tmp_path / "gone.json").write_text(json.dumps(one))
    capsys.readouterr()
    words = [str(tmp_path / "changed.json"), str(tmp_path / "gone.json"), str(kept / "field.json")]
    assert main(["compare", *words, "--out", str(tmp_path / "out"), "--pictures", "1"]) == 0
    said = capsys.readouterr().out
    assert re.search("changed.json is not drawn: .* has changed since it was scored", said)
    assert "gone.json is not drawn: " in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{kept}/field.json {kept}/surface.json", r"differ in protocol \(kfgs-pooled/1 and kfgs-surface/1\)"),
        ("{kept}/field.json {kept}/train.json", r"differ in digest of the truth \(.*digest of the views"),
        ("{kept}/field.json {kept}/options.json", r"differ in option level \(0 and 1\)"),
        ("{kept}/field.json", "RUNS: expected at least two different results, got 1"),
        ("{kept}/field.json {kept}/field.json", "RUNS: expected at least two different results, got 1"),
        ("", "RUNS: expected at least two different results, got 0"),
        ("{run} {run}", "RUNS: expected at least two different results, got 1"),
        ("{kept}/field.json {kept}/other.json", "other.json: expected a report in JSON"),
        ("{kept}/field.json {kept}/nothing.json", "nothing.json: no such file"),
        ("{kept}/field.json {run} --split train", "differ in digest of the truth"),
        ("{kept}/field.json {run} --protocol kfgs-surface", "--protocol: expected kfgs-pooled/1, that of .*field.json"),
        ("{kept}/field.json {kept}/fewer.json", r"differ in scores \(.*accuracy.* and .*mIoU.*\)"),
        ("{kept}/field.json {kept}/list.json", "list.json: expected a report in JSON"),
        ("{kept}/field.json {kept}/null.json", "null.json: expected a report in JSON"),
        ("{kept}/number.json {run}", "number.json: expected texts in 'inputs'"),
        (
            "{kept}/field.json {run} --with-file a.pth",
            "--with-file: expected RUN=FILE with one of no run .* leave it out",
        ),
        (
            "{kept}/field.json {run} --with-file {run}=a.pth",
            "--with-file: expected none with a result of kfgs, got a.pth",
        ),
        (
            "{kept}/before.ply {kept}/painted.ply --with-file a.npy",
            r"--with-file: expected RUN=FILE with one of .*before.ply, .*painted.ply .*, got a.npy; write .*before.ply=FILE",
        ),
        (
            "{kept}/before.ply {run} --with-file a.npy --with-file b.npy",
            "--with-file: expected one file for .*before.ply, got a.npy and b.npy",
        ),
    ],
)
def test_numbers_that_cannot_be_compared_are_refused(words, message, kept, run, capsys):
    one = json.loads((kept / "field.json").read_text())
    one["options"]["level"] = 1
    (kept / "options.json").write_text(json.dumps(one))
    (kept / "other.json").write_text("[]")
    broken = {"list": {"options": [1]}, "null": {"digests": None}, "number": {"inputs": {"scene": 5}}}
    for name, part in (*broken.items(), ("fewer", {"scores": {"mIoU": 0.5}})):
        (kept / f"{name}.json").write_text(json.dumps(one | {"options": {"level": 0, "labels": "own"}} | part))
    capsys.readouterr()
    assert main(["compare", *words.format(kept=kept, run=run).split()]) == 1
    assert re.search(message, capsys.readouterr().err)


def test_scores_whose_scene_is_gone_are_compared_without_pictures(kept, tmp_path, capsys):
    for name in ("field", "exact"):
        one = json.loads((kept / f"{name}.json").read_text())
        one["inputs"]["scene"] = str(tmp_path / "gone")
        (tmp_path / f"{name}.json").write_text(json.dumps(one))
    both = [str(tmp_path / f"{name}.json") for name in ("field", "exact")]
    capsys.readouterr()
    assert main(["compare", *both, "--out", str(tmp_path / "out")]) == 0
    assert re.search(r"(?s)mIoU +accuracy.*note: no pictures: .*gone: no such folder", capsys.readouterr().out)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["compare.json", "compare.txt"]
