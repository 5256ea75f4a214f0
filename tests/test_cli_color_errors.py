"""Bad input to the commands of colour scenes: one line that says what to do, exit code 1, nothing written."""

import re
from pathlib import Path

import pytest
import torch
from cases_color import make_field, make_splat
from messages import tells
from small_room import make_room

from kfgs.cli import main
from kfgs.formats import read_splats, write_splats
from kfgs.labels import EditList, Remove

ERRORS = {
    "attach": [
        (["{splat}", "{field}", "--scene", "{room}", "--out", "{o}.ply"], ("FIELD:", "`kfgs fit`", "got {splat}")),
        (
            ["{tmp}/no", "{splat}", "--scene", "{room}", "--out", "{o}.ply"],
            ("FIELD:", "got {tmp}/no", "no such file", "`kfgs fit`"),
        ),
        (
            ["{field}", "{field}", "--scene", "{room}", "--out", "{o}.ply"],
            ("CLOUD:", "got {field}", "kfgs color"),
        ),
        (["{field}", "{tmp}/no.ply", "--scene", "{room}", "--out", "{o}.ply"], ("{tmp}/no.ply:", "no such file")),
        (["{field}", "{splat}", "--out", "{o}.ply"], ("--text:", "got none", "`kfgs features --words")),
        (
            ["{field}", "{splat}", "--scene", "{room}", "--out", "{o}.ksplat"],
            ("--out:", ".compressed.ply, .ply", "got {o}.ksplat"),
        ),
        (["{field}", "{splat}", "--scene", "{room}", "--out", "{splat}"], ("--out:", "another place", "{splat}")),
        (
            ["{field}", "{splat}", "--scene", "{room}", "--out", "{o}.ply", "--distance", "-1"],
            ("--distance:", "(0, inf)", "got -1.0"),
        ),
        (
            ["{field}", "{four}", "--scene", "{room}", "--out", "{o}.ply"],
            ("CLOUD:", "frame", "--same-frame"),
        ),
    ],
    "select": [
        (["chiar", "{labelled}", "--out", "{o}"], ("class:", "got 'chiar'", "'chair'?")),
        (
            ["chair", "{splat}"],
            ("SOURCE:", "classes", "got {splat}", "`kfgs attach FIELD"),
        ),
        (["chair", "{alone}"], ("SOURCE:", "{alone}.classes.json", "copy it")),
        (["chair", "{tmp}/no.ply"], ("{tmp}/no.ply:", "no such file")),
        (["chair", "{field}"], ("--text:", "got none", "`kfgs features --words")),
        (["chair", "{labelled}", "--threshold", "2"], ("--threshold:", "[0, 1]", "got 2.0")),
        (["chair", "{labelled}", "--threshold", "1", "--out", "{o}"], ("QUERY:", "got none")),
        (["chair", "{labelled}", "--out", "{splat}"], ("--out:", "{splat}", "got a file")),
    ],
    "edit": [
        (["{labelled}", "--out", "{o}.ply"], ("edits:", "got none", "--remove")),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chiar"],
            ("class:", "wall, floor", "got 'chiar'"),
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--recolor", "chair:rde"],
            ("--recolor:", "'#c04040' or 'teal'", "got 'rde'"),
        ),
        (["{labelled}", "--out", "{o}.ply", "--move", "chair:1,2"], ("--move:", "got 'chair:1,2'")),
        (["{labelled}", "--out", "{labelled}", "--remove", "chair"], ("--out:", "another place", "{labelled}")),
        (["{labelled}", "--out", "{o}", "--remove", "chair"], ("--out:", ".compressed.ply, .ply", "got {o}")),
        (
            ["{splat}", "--out", "{o}.ply", "--remove", "chair"],
            ("SPLATS:", "classes", "got {splat}", "`kfgs attach FIELD"),
        ),
        (
            ["{field}", "--out", "{o}.ply", "--remove", "chair"],
            ("SPLATS:", "got {field}", "kfgs color"),
        ),
        (
            ["{labelled}", "--out", "{taken}.ply", "--remove", "rug"],
            ("--out:", "{taken}.ply.edits.json", "got a folder"),
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair/0"],
            ("--remove:", "got 'chair/0'"),
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair/99"],
            ("part:", "got chair/99", "`kfgs select`"),
        ),
        (
            ["{splat}", "--out", "{o}.ply", "--replay", "{saved}"],
            ("SPLATS:", "expected a splat with classes, got {splat}", "`kfgs attach FIELD {splat} --out labelled.ply`"),
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--replay", "{room}/classes.json"],
            ("{room}/classes.json:", "'kfgs.edits'"),
        ),
        (
            ["{plain}", "--out", "{o}.ply", "--remove", "chair", "--scene", "{room}"],
            ("--scene:", "colours", "got Gaussians("),
        ),
    ],
    "color": [
        (["{room}", "--out", "{o}", "--steps", "0"], ("--steps:", "got 0")),
        (["{room}", "--out", "{o}", "--split", "val"], ("--split:", "train, test", "got 'val'")),
        (["{tmp}", "--out", "{o}"], ("{tmp}:", "COLMAP", "`kfgs sfm")),
    ],
    "convert": [
        (["{splat}", "{splat}"], ("TARGET:", "another place", "{splat}")),
        (
            ["{splat}", "{o}.ksplat"],
            ("TARGET:", ".compressed.ply, .ply", "got {o}.ksplat"),
        ),
        (["{splat}", "{o}.spz", "--plain"], ("--plain:", ".ply", "{o}.spz")),
        (["{splat}", "{o}", "--by-class"], ("SOURCE:", "expected a splat with classes")),
        (["{room}/text.npy", "{o}.ply"], ("{room}/text.npy:", "known", "compressed_ply")),
    ],
}


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """What the errors speak of.

    `plain` has classes but no colours, `alone` no names beside it, `four` has four Gaussians far away; edits lie beside
    `same`, a folder beside `taken`.
    """
    folder = tmp_path_factory.mktemp("errors")
    room = make_room(folder / "scene")
    field, splat = make_field(room, folder / "run" / "field.kfgs"), make_splat(room, folder / "splat.ply")
    labelled = folder / "labelled.ply"
    arguments = ["attach", str(field), str(splat), "--scene", str(room), "--by", "distance", "--same-frame"]
    assert main([*arguments, "--out", str(labelled)]) == 0
    cloud = read_splats(labelled)
    write_splats(cloud.replace(sh=None), folder / "plain.ply")
    (folder / "alone.ply").write_bytes(labelled.read_bytes())
    four = read_splats(splat).select(torch.arange(4))
    write_splats(four.replace(means=four.means + 100), folder / "four.ply")
    same = EditList((Remove("rug"),)).save(folder / "same.ply.edits.json")
    (folder / "taken.ply.edits.json").mkdir()
    paths = {"room": room, "field": field, "run": field.parent, "splat": splat, "labelled": labelled, "saved": same}
    paths |= {"same": folder / "same", "taken": folder / "taken"}
    paths |= {name: folder / f"{name}.ply" for name in ("plain", "alone", "four")}
    return {name: str(path) for name, path in paths.items()}


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        pytest.param(command, arguments, message, id=f"{command}-{i}")
        for command, cases in ERRORS.items()
        for i, (arguments, message) in enumerate(cases)
    ],
)
def test_bad_input_ends_with_1_one_line_and_no_files(command, arguments, message, places, tmp_path, capsys):
    places = places | {"tmp": str(tmp_path), "o": str(tmp_path / "o" / "new")}
    sources = {name: places[name] for name in ("splat", "labelled", "saved")}
    before = {name: Path(path).read_bytes() for name, path in sources.items()}
    assert main([command, *(one.format(**places) for one in arguments)]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("error: ")
    assert re.search(tells(*(part.format(**places) for part in message)), said)
    assert list(tmp_path.iterdir()) == []
    assert before == {name: Path(path).read_bytes() for name, path in sources.items()}


@pytest.mark.parametrize("arguments", [["edit", "a.ply"], ["attach", "a", "b", "--out", "c.ply", "--by", "magic"]])
def test_wrong_usage_of_color_commands_ends_with_2(arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
