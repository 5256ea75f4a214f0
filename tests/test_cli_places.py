"""No command replaces what it reads, or writes among the parts of a scene."""

import inspect
import re
import shutil
from pathlib import Path

import pytest
from messages import tells
from small_room import make_desk

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
def desk(tmp_path_factory):
    """A scene, a run and its files, as a user has them: the names of LINES."""
    folder = make_desk(tmp_path_factory.mktemp("desk"))
    scene, run = folder / "scene", folder / "run"
    places = {"tmp": folder, "scene": scene, "run": run, "splat": folder / "my.ply", "list": folder / "list.txt"}
    places |= {"packed": folder / "p.kfgs", "labelled": folder / "l.ply"}
    places["list"].write_text(f"{scene}\n")
    places["table"] = folder / "lseg.safetensors"
    places["table"].write_text("weights")
    shutil.copytree(scene / "images", folder / "photos")
    shutil.copyfile(places["splat"], run / "color.ply")
    (scene / "labels").mkdir(exist_ok=True)
    assert main(["convert", str(run / "field.kfgs"), str(places["packed"])]) == 0
    assert main(["attach", str(run / "field.kfgs"), str(places["splat"]), "--out", str(places["labelled"])]) == 0
    return places


def contents(places):
    return {path: path.is_file() and path.read_bytes() for path in places["tmp"].rglob("*")}


def with_output(line, out):
    return line.replace("{}", out)


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
def test_no_command_writes_among_the_parts_of_a_scene(command, desk, capsys):
    line = LINES[command][0]
    own = {"features": "features"}.get(command)
    for place in ("images", "features", "sparse/0", "labels"):
        if place != own:
            there = desk["scene"] / place
            refused(with_output(line, f"{there}/new"), desk, capsys, "expected a place apart from", there)


@pytest.mark.parametrize("command", [name for name, (_, given) in LINES.items() if given])
def test_no_command_replaces_what_it_reads(command, desk, tmp_path, capsys):
    line, given = LINES[command]
    file = Path(given.format(**desk))
    link = tmp_path / file.name
    link.symlink_to(file)
    for out in (file, link):
        words = re.sub(r"\{\}\S*", str(out), line)
        refused(words, desk, capsys, "expected another place than", file, "give another name")


FILES = {  # an existing file of the scene, the run or the user, and commands that would have replaced it
    "{scene}/images/view_000.png": ["evaluate {run} --out"],
    "{scene}/features/view_000_fmap_CxHxW.pt": ["evaluate {run} --out"],
    "{scene}/sparse/0/images.bin": ["evaluate {run} --out"],
    "{run}/field.kfgs": ["evaluate {run} --out", "evaluate {run}/field.kfgs --out"],
    "{run}/color.ply": ["convert {run}/color.ply"],
    "{packed}": ["evaluate {packed} --out"],
    "{list}": ["evaluate {run} --truth {list} --out"],
}


@pytest.mark.parametrize(("file", "line"), [(file, line) for file, lines in FILES.items() for line in lines])
def test_an_input_or_a_file_of_the_scene_is_not_replaced(file, line, desk, capsys):
    refused(f"{line} {file}", desk, capsys, "give another")


def test_the_page_puts_no_picture_among_those_of_the_scene(desk, capsys):
    refused("view {run} --out {scene}/images/mine", desk, capsys, "--out", "apart", desk["scene"] / "images")


def test_what_a_command_makes_for_a_scene_or_beside_it_is_written(desk, capsys):
    """The checks refuse no more than they should."""
    scene, run = desk["scene"], desk["run"]
    examples = desk["tmp"] / "examples.json"
    examples.write_text('{"chair": [{"gaussians": [1]}], "floor": [{"gaussians": [2]}]}')
    for line, written in (
        (
            f"features {run}/field.kfgs --examples {examples} --out {scene}/text.safetensors",
            scene / "text.safetensors",
        ),
        (f"evaluate {run} --out {run}/scores.json", run / "scores.json"),
        (f"select chair {run}/field.kfgs --out {scene}/chairs", scene / "chairs"),
    ):
        for _ in range(2):
            assert main(line.split()) == 0, capsys.readouterr().err
            assert written.exists()
