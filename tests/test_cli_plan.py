"""The command plan: what it refuses before it plans, and what it counts."""

import json
import re
import shutil

import pytest
from messages import tells
from small_room import make_room

from kfgs.cli import main


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("plan") / "scene")


@pytest.fixture(autouse=True)
def untimed(monkeypatch):
    for name in ("time_color", "time_fit"):
        monkeypatch.setattr(f"kfgs.pipeline.plan.{name}", lambda *_: {})


def test_a_plan_is_said_and_written(room, tmp_path, capsys):
    out = tmp_path / "new" / "plan.json"
    assert main(["plan", str(room), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"wrote:\n  {out}" in said
    found = json.loads(out.read_text())
    assert found["title"] in said
    assert "6 of 6 maps exist" in said
    assert [stage["name"] for stage in found["stages"]] == ["color", "uplift"]


def test_maps_may_lie_in_another_folder(room, tmp_path, capsys):
    moved = tmp_path / "scene"
    shutil.copytree(room, moved)
    (moved / "features").rename(tmp_path / "maps")
    assert main(["plan", str(moved), "--features", str(tmp_path / "maps"), "--run", str(tmp_path / "run")]) == 0
    assert "6 of 6 maps exist" in capsys.readouterr().out
    assert main(["plan", str(moved), "--teacher", "clip"]) == 0
    assert "clip was not run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--out", "{tmp}"], ("--out:", "{tmp}", "got a folder")),
        (
            ["--out", "{tmp}/file/plan.json"],
            ("--out:", "got {tmp}/file/plan.json", "file {tmp}/file"),
        ),
        (["--teacher", "lsge"], ("teacher:", "got 'lsge'", "did you mean 'lseg'")),
        (["--features", "{tmp}/maps"], ("--features:", "got {tmp}/maps")),
        (["--weights", "{tmp}/no.ckpt"], ("{tmp}/no.ckpt:",)),
        (["--teacher", "clip", "--weights", "{tmp}"], ("{tmp}:",)),
    ],
)
def test_what_cannot_end_well_is_refused_before_planning(room, given, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("kfgs.pipeline.plan.Plan.__init__", lambda *_, **__: pytest.fail("it planned"))
    bare = tmp_path.with_name(tmp_path.name + "-scene")
    shutil.copytree(room, bare, ignore=shutil.ignore_patterns("features"))
    (tmp_path / "file").write_text("")
    assert main(["plan", str(bare), *(word.format(tmp=tmp_path) for word in given)]) == 1
    error = capsys.readouterr().err
    assert re.search(tells(*(part.format(tmp=tmp_path) for part in message)), error)
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_list_of_scenes_is_answered_with_what_to_do(tmp_path, capsys):
    file = tmp_path / "scenes.txt"
    file.write_text("room\n")
    assert main(["plan", str(file)]) == 1
    told = tells("SCENE: expected the folder of one scene", f"got the file {file}", "multiply", "slurm.md")
    assert re.search(told, capsys.readouterr().err)


def test_a_typo_is_not_hidden_by_maps_that_exist(room, tmp_path, capsys):
    assert main(["plan", str(room), "--teacher", "nix"]) == 1
    assert re.search(tells("teacher:", "got 'nix'", "name one of them"), capsys.readouterr().err)
    assert main(["plan", str(room), "--features", str(tmp_path), "--run", str(tmp_path / "nowhere")]) == 0
    said = capsys.readouterr().out
    assert f"note: no maps of these views in {tmp_path}" in said
    assert f"note: there is no folder {tmp_path / 'nowhere'} yet" in said
    assert not (tmp_path / "nowhere").exists()
    assert "--splat" not in said  # which plan does not have
    assert re.search(r"at most [\d,]+ Gaussians", said)
    assert "at most 50,000 are kept" in said
