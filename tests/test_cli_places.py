"""No command replaces what it reads, or writes among the parts of a scene."""

import inspect
import re
import shutil
from pathlib import Path

import pytest
from messages import tells

from kfgs.cli import COMMANDS, main
from kfgs.cli.files import OUTPUTS

LINES = {  # a command with its output {}; and one of its inputs that could be named as the output, if there is one
    "attach": ("attach {run}/field.kfgs {splat} --out {}.ply", "{splat}"),
    "batch": ("batch {list} --out {} --workers tcp://127.0.0.1:1", None),
    "color": ("color {scene} --out {}", None),
    "convert": ("convert {splat} {}.ply", "{splat}"),
    "demo": ("demo --out {}", None),
    "edit": ("edit {labelled} --remove chair --out {}.ply", "{labelled}"),
    "evaluate": ("evaluate {run} --out {}", "{run}/field.kfgs"),
    "features": ("features {scene} --teacher lseg --weights {tmp}/none --out {}", None),
    "fit": ("fit {scene} --splat {splat} --out {}", None),
    "render": ("render {run} --out {}.gif", None),
    "segment": ("segment {run}/field.kfgs --out {}", None),
    "select": ("select chair {run}/field.kfgs --out {}", None),
    "sfm": ("sfm {tmp}/photos --out {}", None),
    "view": ("view {run}/field.kfgs --where html --out {}", None),
}


@pytest.fixture(scope="module")
def places(desk, tmp_path_factory):
    """A scene, a run and its files, as a user has them, at the names of LINES."""
    folder = shutil.copytree(desk, tmp_path_factory.mktemp("places") / "desk", symlinks=True)
    scene = folder / "scene"
    (folder / "list.txt").write_text(f"{scene}\n")
    shutil.copytree(scene / "images", folder / "photos")
    found = {"tmp": folder, "scene": scene, "run": folder / "run", "splat": folder / "my.ply"}
    return found | {"list": folder / "list.txt", "labelled": folder / "labelled.ply"}


def contents(places):
    return {path: path.is_file() and path.read_bytes() for path in places["tmp"].rglob("*")}


def refused(line, places, capsys, *parts):
    line = line.format(**places)
    before = contents(places)
    capsys.readouterr()
    assert main(line.split()) == 1, line
    error = capsys.readouterr().err
    assert re.search(tells(*parts), error), (line, error)
    assert contents(places) == before, line


def test_every_command_that_writes_is_tried():
    writing = {name for name, command in COMMANDS.items() if set(inspect.signature(command).parameters) & set(OUTPUTS)}
    assert writing == set(LINES)
    assert writing == set(COMMANDS)


@pytest.mark.parametrize("command", LINES)
def test_no_command_writes_among_the_parts_of_a_scene(command, places, capsys):
    line = LINES[command][0]
    own = {"features": "features"}.get(command)
    for place in ("images", "features", "sparse/0", "labels"):
        if place != own:
            there = places["scene"] / place
            refused(line.replace("{}", f"{there}/new"), places, capsys, "expected a place apart from", there)


@pytest.mark.parametrize("command", [name for name, (_, given) in LINES.items() if given])
def test_no_command_replaces_what_it_reads(command, places, tmp_path, capsys):
    line, given = LINES[command]
    file = Path(given.format(**places))
    link = tmp_path / file.name
    link.symlink_to(file)
    for out in (file, link):
        words = re.sub(r"\{\}\S*", str(out), line)
        refused(words, places, capsys, "expected another place than", file, "give another name")
