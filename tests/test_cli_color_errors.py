"""Bad input to the commands of colour scenes: one line that says what to do, exit code 1, nothing written."""

from pathlib import Path

import pytest
import torch
from cases_color import make_field, make_splat
from small_room import make_room

from kfgs.cli import main
from kfgs.formats import SplatFile, read_splats, write_splats
from kfgs.labels.edits import EditList, Remove

TWICE = ["--views", "view_001", "--views", "view_001.png"]
ERRORS = {
    "attach": [
        (["{splat}", "{field}", "--scene", "{room}", "--out", "{o}.ply"], "FIELD: expected the folder that `kfgs fit`"),
        (["{run}", "{splat}", "--scene", "{room}", "--out", "{o}.ply"], "a run folder; pass {field}"),
        (["{tmp}/no", "{splat}", "--scene", "{room}", "--out", "{o}.ply"], "no such folder; make one with `kfgs fit`"),
        (
            ["{field}", "{field}", "--scene", "{room}", "--out", "{o}.ply"],
            "SPLATS: expected a splat file, got {field}, a",
        ),
        (["{field}", "{run}", "--scene", "{room}", "--out", "{o}.ply"], "{run}, a semantic field; pass a colour splat"),
        (["{field}", "{tmp}/no.ply", "--scene", "{room}", "--out", "{o}.ply"], "{tmp}/no.ply: no such file"),
        (["{field}", "{splat}", "--out", "{o}.ply"], "pass --classes and --text, or --scene"),
        (
            ["{field}", "{splat}", "--scene", "{room}", "--out", "{o}.ksplat"],
            "--out: expected a file whose name ends in one",
        ),
        (["{field}", "{splat}", "--scene", "{room}", "--out", "{splat}"], "--out: expected another file than {splat}"),
        (["{field}", "{splat}", "--scene", "{room}", "--out", "{splat}/a.ply"], "below the file {splat}; give another"),
        (
            ["{field}", "{splat}", "--out", "{o}.ply", "--by", "views", *["--classes", "a", "--text", "b"]],
            "--by: expected --scene",
        ),
        (
            ["{field}", "{splat}", "--out", "{o}.ply", "--splat-scene", "{room}"],
            "--splat-scene: expected --scene beside it",
        ),
        (
            ["{field}", "{splat}", "--out", "{o}.ply", "--images", "{room}/images"],
            "--images: expected none without --scene",
        ),
        (
            ["{field}", "{splat}", "--out", "{o}.ply", "--scene", "{room}", "--splat-scene", "{room}", "--same-frame"],
            "--same-frame: expected it alone",
        ),
        (
            ["{field}", "{splat}", "--scene", "{room}", "--out", "{o}.ply", "--distance", "-1"],
            "--distance: expected a number",
        ),
        (
            ["{field}", "{four}", "--scene", "{room}", "--out", "{o}.ply"],
            "SPLATS: no frame found in which field and splat",
        ),
    ],
    "select": [
        (["{labelled}", "chair"], "QUERY, SOURCE: expected a class, then a file"),
        (["chiar", "{labelled}", "--out", "{o}"], "did you mean 'chair'?"),
        (
            ["chair", "{splat}"],
            "SOURCE: expected a splat with classes, got {splat} without; `kfgs attach` gives it some",
        ),
        (["chair", "{tmp}/no.ply"], "{tmp}/no.ply: no such file"),
        (["chair", "{field}"], "pass --classes and --text, or --scene"),
        (["chair", "{run}"], "a run folder; pass {field}"),
        (["chair", "{labelled}", "--threshold", "2"], "--threshold: expected a number in [0, 1], got 2"),
        (["chair", "{labelled}", "--threshold", "1", "--out", "{o}"], "QUERY: expected Gaussians to save, got none"),
        (["chair", "{labelled}", "--text", "x.npy"], "--text: expected none beside a splat, which has its own classes"),
        (["chair", "{labelled}", "--negatives", "none"], "--negatives: expected none beside a splat"),
        (["chair", "{labelled}", "--teacher", "lseg"], "--teacher: expected none beside a splat"),
        (["chair", "{labelled}", "--images", "{room}"], "--images: expected none without --scene"),
        (["chair", "{labelled}", "--out", "{splat}"], "--out: expected a folder or nothing at {splat}, got a file"),
    ],
    "edit": [
        (["{labelled}", "--out", "{o}.ply"], "edits: expected at least one, got none; give --remove"),
        (["{labelled}", "--out", "{o}.ply", "--remove", "chiar"], "edits[0] (remove): class: expected one of wall"),
        (["{labelled}", "--out", "{o}.ply", "--recolor", "chair:rde"], "--recolor: expected a colour such as"),
        (["{labelled}", "--out", "{o}.ply", "--move", "chair:1,2"], "--move: expected 3 numbers between commas"),
        (["{labelled}", "--out", "{o}.ply", "--insert", "{tmp}/no.ply"], "--insert: expected a splat file"),
        (
            ["{labelled}", "--out", "{o}.ply", "--insert", "{room}/text.npy"],
            "edits[0] (insert): {room}/text.npy: expected",
        ),
        (["{labelled}", "--out", "{splat}", "--insert", "{splat}"], "--out: expected another file than {splat}"),
        (["{labelled}", "--out", "{labelled}", "--remove", "chair"], "--out: expected another file than {labelled}"),
        (
            ["{labelled}", "--out", "{o}.ksplat", "--remove", "chair"],
            "--out: expected a file whose name ends in one of",
        ),
        (["{labelled}", "--out", "{o}", "--remove", "chair"], "got {o}; the ending chooses the format"),
        (["{splat}", "--out", "{o}.ply", "--remove", "chair"], "SPLATS: expected a splat with classes, got {splat}"),
        (
            ["{field}", "--out", "{o}.ply", "--remove", "chair"],
            "SPLATS: expected a splat file, got {field}, a semantic",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair", "--views", "view_001"],
            "--views: expected none without",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair", "--scene", "{room}", "--views", "view_01"],
            "--views: expected names of the scene's 9 views, got 'view_01'; did you mean 'view_001.png' or",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "rug", "--scene", "{room}", *TWICE],
            "--views: expected each view once, got 'view_001.png' twice; name it once",
        ),
        (
            ["{labelled}", "--out", "{same}.ply", "--replay", "{same}.edits.json"],
            "--replay: expected another file than {same}.edits.json, where the edits behind {same}.ply are saved, got the same",
        ),
        (
            ["{labelled}", "--out", "{taken}.ply", "--remove", "rug"],
            "a file or nothing at {taken}.edits.json, got a folder",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair/0"],
            "--remove: expected parts counted from 1, got 'chair/0'",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair/99"],
            "chair/99: expected a part from chair/1 to chair/",
        ),
        (
            ["{labelled}", "--out", "{o}.ply", "--remove", "chair", "--pictures", "-1"],
            "--pictures: expected a number in",
        ),
        (["{labelled}", "--out", "{o}.ply", "--replay", "{tmp}/no.json"], "{tmp}/no.json: no such file"),
        (["{labelled}", "--out", "{o}.ply", "--replay", "{room}/classes.json"], "expected edits that kfgs saved"),
        (
            ["{plain}", "--out", "{o}.ply", "--remove", "chair", "--scene", "{room}"],
            "--scene: expected a splat with colours",
        ),
    ],
    "color": [
        (["{room}", "--out", "{splat}"], "--out: expected a folder or nothing at {splat}, got a file"),
        (["{room}", "--out", "{o}", "--pictures", "-1"], "--pictures: expected a number in"),
        (["{room}", "--out", "{o}", "--steps", "0"], "--steps: expected a whole number of at least 1, got 0"),
        (["{room}", "--out", "{o}", "--split", "val"], "--split: expected one of train, test, got 'val'"),
        (["{tmp}", "--out", "{o}"], "expected a COLMAP model"),
    ],
    "convert": [
        (["{splat}", "{splat}"], "TARGET: expected another file than {splat}, got the same"),
        (
            ["{splat}", "{o}.ksplat"],
            "TARGET: expected a file whose name ends in one of .compressed.ply, .ply, .spz, .sog",
        ),
        (["{field}", "{o}.ply"], "SOURCE: expected a splat file, got {field}, a semantic field"),
        (["{room}/text.npy", "{o}.ply"], "expected a splat file of a known format, got something else"),
        (["{tmp}", "{o}.ply"], "expected a splat file of a known format"),
    ],
}


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """What the errors speak of.

    `plain` has classes but no colours, `four` has four Gaussians far away; edits lie beside `same`, a folder beside `taken`.
    """
    folder = tmp_path_factory.mktemp("errors")
    room = make_room(folder / "scene")
    field, splat = make_field(room, folder / "run" / "field"), make_splat(room, folder / "splat.ply")
    labelled = folder / "labelled.ply"
    arguments = ["attach", str(field), str(splat), "--scene", str(room), "--by", "distance", "--same-frame"]
    assert main([*arguments, "--out", str(labelled)]) == 0
    cloud = read_splats(labelled)
    write_splats(folder / "plain.ply", SplatFile(cloud.gaussians.replace(sh=None), {}, cloud.classes))
    four = read_splats(splat).gaussians.select(torch.arange(4))
    write_splats(folder / "four.ply", four.replace(means=four.means + 100))
    same = EditList((Remove("rug"),)).save(folder / "same.edits.json")
    (folder / "taken.edits.json").mkdir()
    paths = {"room": room, "field": field, "run": field.parent, "splat": splat, "labelled": labelled, "saved": same}
    paths |= {"same": folder / "same", "taken": folder / "taken"}
    paths |= {name: folder / f"{name}.ply" for name in ("plain", "four")}
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
    assert message.format(**places) in said
    assert list(tmp_path.iterdir()) == []
    assert before == {name: Path(path).read_bytes() for name, path in sources.items()}


@pytest.mark.parametrize("arguments", [["edit", "a.ply"], ["attach", "a", "b", "--out", "c.ply", "--by", "magic"]])
def test_wrong_usage_of_color_commands_ends_with_2(arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
