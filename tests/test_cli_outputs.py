"""What commands do before, while and after they write: outputs that cannot be written, full disks."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from messages import tells

from kfgs.cli import main
from kfgs.fields import SemanticField


@pytest.fixture
def splat(desk, tmp_path):
    return Path(shutil.copyfile(desk / "labelled.ply", tmp_path / "a.ply"))


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(arguments, capsys, *parts):
    assert main([str(word) for word in arguments]) == 1
    error = capsys.readouterr().err
    assert re.search(tells(*parts), error), error
    assert ".kfgs-new" not in error


@pytest.mark.parametrize(
    "words",
    [
        "demo --out {file}",
        "sfm {room}/images --out {file}",
        "features {room} --teacher lseg --out {file}",
        "fit {room} --out {file}",
        "color {room} --out {file}",
        "segment {run}/field.kfgs --out {file}",
        "select chair {run}/field.kfgs --out {file}",
        "view {run}/field.kfgs --out {file}",
        "features --words chair --teacher lseg --out {file}/deep/a.safetensors",
        "attach {run}/field.kfgs {splat} --out {file}/deep/a.ply",
        "edit {splat} --remove chair --out {file}/deep/a.ply",
        "convert {splat} {file}/deep/a.ply",
        "render {run} --out {file}/deep/a.gif",
        "convert {run}/field.kfgs {file}/deep/a.kfgs",
        "evaluate {run}/field.kfgs --out {file}/deep/a.json",
    ],
)
def test_an_output_that_cannot_be_is_refused_before_the_work(words, room, desk, splat, capsys, monkeypatch):
    file = splat.parent / "file"
    file.write_text("mine")
    before = files(splat.parent)
    arguments = [word.format(file=file, room=room, run=desk / "run", splat=splat) for word in words.split()]
    monkeypatch.setattr(SemanticField, "load", None)  # the work
    refused(arguments, capsys, "expected a folder", file)
    assert files(splat.parent) == before


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process")
@pytest.mark.parametrize("name", ["b.ply", "b.splat", "b.spz", "b.sog", "b.glb", "b.compressed.ply"])
def test_a_disk_that_takes_no_more_is_one_message_with_the_file(name, splat, tmp_path, capsys):
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, hard))
    try:
        code = main(["convert", str(splat), str(tmp_path / name)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    error = capsys.readouterr().err
    assert code == 1, error
    assert len(error.strip().splitlines()) == 1
    assert str(tmp_path / name) in error
    assert "kfgs-unfinished" not in error
    assert not any(path.name.startswith((".", name)) for path in tmp_path.iterdir())


def test_the_second_fit_and_the_second_color_are_told_who_works_there(room, desk, tmp_path, capsys):
    run = shutil.copytree(desk / "run", tmp_path / "run")
    before = files(run)
    hold = (
        "import sys, pathlib; from kfgs._files import locked\n"
        "with locked(pathlib.Path(sys.argv[1]), '.run.lock'): print('held', flush=True); sys.stdin.read()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", hold, run], **pipes) as first:
        assert first.stdout.readline() == b"held\n"
        lock = {run / ".run.lock": (run / ".run.lock").read_bytes()}
        for words in (["fit", room, "--out", run, "--method", "paper"], ["color", room, "--out", run]):
            refused(words, capsys, run, "in use", "wait")
        assert files(run) == before | lock
        first.stdin.close()


def test_a_model_is_not_replaced_unasked(room, tmp_path, capsys):
    scene = tmp_path / "scene"
    shutil.copytree(room, scene)
    before = files(scene)
    refused(["sfm", room / "images", "--out", scene], capsys, "sparse/0", "--replace")
    assert files(scene) == before


def test_two_runs_of_kfgs_give_the_same_bytes(room, tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for run in (one, two):
        options = ["--method", "adc", "--steps", "10", "--set", "training.densify.maximum=2000"]
        assert main(["fit", str(room), "--out", str(run), *options]) == 0
    made = sorted(one.glob("stages/*/*.safetensors"))
    assert len(made) == 3  # the codebook, the index maps, the field
    for file in made:
        assert (two / file.relative_to(one)).read_bytes() == file.read_bytes(), file


@pytest.mark.parametrize("words", [["fit", "scene", "--out", ""], ["color", "a", "--out="], ["select", "", "a.ply"]])
def test_an_empty_path_is_not_the_current_folder(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(words, capsys, "empty", "write . for this folder")
    assert not list(tmp_path.iterdir())


def test_closed_streams_are_no_error():
    closed = f"{sys.executable} -m kfgs --version >&- 2>&-"
    assert subprocess.run(["sh", "-c", closed], check=False).returncode == 0
