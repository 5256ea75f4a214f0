"""`kfgs evaluate`: every protocol end to end, its JSON, and what is said when something does not fit."""

import json

import pytest

from kfgs import SemanticField, load_scene
from kfgs.cli import main
from kfgs.evaluation import FieldMethod, LabelTruth, View
from kfgs.evaluation.label_pictures import load_label_map
from kfgs.evaluation.protocols import KfgsPooled
from kfgs.labels import load_label_set
from kfgs.pipeline import evaluate, open_question


@pytest.fixture(scope="module")
def run(desk):
    return desk / "run"


@pytest.fixture(scope="module")
def words(room):
    return load_label_set(room / "classes.json", room / "text.npy")


@pytest.fixture(scope="module")
def asked(room, words):
    """The views and the truth of kfgs-pooled, read without `open_question`."""
    scene = load_scene(room)
    views = [View(scene.stem(i), scene.cameras[i]) for i in scene.views("test")]
    return LabelTruth(words.names, {v.stem: load_label_map(room / "labels" / f"{v.stem}.png") for v in views}), views


def scored(capsys, *words):
    """What the command printed."""
    assert main(["evaluate", *map(str, words)]) == 0, capsys.readouterr().err
    return capsys.readouterr().out.strip()


def test_a_run_remembers_its_scene_and_its_score_is_the_protocols(run, words, asked, tmp_path, capsys, monkeypatch):
    typed = ["kfgs", "evaluate", str(run), "--out", str(tmp_path / "s.json")]
    monkeypatch.setattr("sys.argv", typed)
    capsys.readouterr()
    assert main() == 0
    said = capsys.readouterr().out.splitlines()[0]
    rows = words.embeddings
    expected = KfgsPooled().score(FieldMethod(SemanticField.load(run / "field.kfgs")), *asked, lambda _: rows)
    assert said == str(expected)
    kept = json.loads((tmp_path / "s.json").read_text())
    assert kept["scores"] == dict(expected.scores)
    assert kept["protocol"] == "kfgs-pooled/1"
    assert kept["options"] == {"level": 0, "merged": [], "most": None, "labels": "own"}
    assert kept["machine"]
    assert kept["command"] == " ".join(typed)


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("{run}/field.kfgs --scene {room}", "mIoU"),
        ("{run} --protocol kfgs-surface", "agreement"),
        ("{run}/color.ply --scene {room} --protocol kfgs-color", "PSNR"),
        ("{run} --protocol feature3dgs-teacher --truth {room}/features", "mIoU"),
        ("{room}/features --scene {room}", "mIoU"),
    ],
)
def test_every_protocol_end_to_end(words, shown, run, room, tmp_path, capsys):
    capsys.readouterr()
    words = words.format(run=run, room=room).split()
    if "feature3dgs-teacher" in words:  # every 8th view from index 2: the room has 9
        assert "1 of 9 views are scored" in scored(capsys, *words)
    assert shown in scored(capsys, *words, "--out", tmp_path / "s.json")
    kept = json.loads((tmp_path / "s.json").read_text())
    assert kept["scores"][next(iter(kept["scores"]))] is not None
    long = scored(capsys, *words, "--long")
    assert kept["about"] in long
    assert long.count("\n") >= 5


def test_the_rule_for_labels_is_that_of_the_protocol_unless_asked(run, room, words, asked, tmp_path, capsys):
    field = SemanticField.load(run)
    expected = {
        rule: KfgsPooled().score(FieldMethod(field, rule=rule), *asked, lambda _: words.embeddings)
        for rule in ("own", "nearest", "paper")
    }
    assert expected["own"].scores != expected["nearest"].scores
    capsys.readouterr()
    for rule in (None, *expected):
        given, rule = () if rule is None else ("--labels", rule), rule or "own"
        said = scored(capsys, run, *given, "--out", tmp_path / f"{rule}.json")
        kept = json.loads((tmp_path / f"{rule}.json").read_text())
        assert kept["scores"] == dict(expected[rule].scores)
        assert kept["options"]["labels"] == rule
        assert (f"labels={rule}" in said.splitlines()[0]) == (rule != "own")
    question = open_question(room, "feature3dgs-teacher")
    published, own = (evaluate(run, question, encode=words, labels=rule) for rule in (None, "own"))
    assert (published.options["labels"], published.changed) == ("nearest", ("texts",))
    assert (own.options["labels"], own.changed) == ("own", ("texts", "labels"))
    papers = evaluate(run, question := open_question(room, "df3dgs"), encode=words)
    assert (papers.options["labels"], papers.changed) == ("paper", ())
    assert [view.stem for view in question.views] == [question.scene.stem(0)]  # whatever the scene's own split is
    trained = field.info["views"]
    both = trained.count(question.scene.cameras[5].name)
    assert f"split df3dgs: {both} of the {len(trained)} views trained are its train views" in papers.notes
    method = FieldMethod(field, rule="nearest")
    pooled = open_question(room)
    assert evaluate(method, pooled, encode=words).options["labels"] == "nearest"  # its rule, unless one is asked
    assert evaluate(method, pooled, encode=words, labels="own").scores == expected["own"].scores
