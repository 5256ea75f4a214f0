"""The command plan: what it refuses before it plans, and what it counts."""

import json

import pytest
from small_room import make_room

from kfgs.cli import main
from kfgs.pipeline import plan_stages
from kfgs.pipeline.machine import Speed


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("plan") / "scene")


@pytest.fixture(autouse=True)
def a_known_speed(monkeypatch):
    monkeypatch.setattr(plan_stages, "measure_speed", lambda device="cpu": Speed(4e11, 2))


def test_a_plan_is_said_and_written(room, tmp_path, capsys):
    out = tmp_path / "new" / "plan.json"
    assert main(["plan", str(room), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"wrote:\n  {out}" in said
    found = json.loads(out.read_text())
    assert found["title"] in said
    assert found["stages"][0]["name"] == "features"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--out", "{tmp}"], "out: expected a file or nothing at {tmp}, got a folder; give another name"),
        (
            ["--out", "{tmp}/file/plan.json"],
            "out: expected a folder to write to, got {tmp}/file/plan.json below the file",
        ),
        (
            ["--weights", "{tmp}/no.ckpt"],
            "{tmp}/no.ckpt: expected a checkpoint file of teacher 'lseg', got no such file;",
        ),
        (
            ["--teacher", "clip", "--weights", "{tmp}"],
            "got a folder without config.json; download the whole repository",
        ),
    ],
)
def test_what_cannot_end_well_is_refused_before_planning(room, given, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("kfgs.pipeline.plan.Plan.__init__", lambda *_, **__: pytest.fail("it planned"))
    (tmp_path / "file").write_text("")
    assert main(["plan", str(room), *(word.format(tmp=tmp_path) for word in given)]) == 1
    error = capsys.readouterr().err
    assert message.format(tmp=tmp_path) in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
