"""Bad input to commands: one line that says what to do, exit code 1, nothing written."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from messages import tells

from kfgs.cli import main
from kfgs.formats import read_splats, write_splats
from kfgs.labels import EditList, Remove

PLACES = "expected orbit, cameras, a transforms.json (a name that ends in .json), or a folder with a COLMAP model,"
ERRORS = [
    ("attach {splat} {field} --scene {room} --out {o}.ply", ("FIELD:", "`kfgs fit`", "got {splat}")),
    ("attach {tmp}/no {splat} --scene {room} --out {o}.ply", ("FIELD:", "got {tmp}/no", "no such file", "`kfgs fit`")),
    ("attach {field} {field} --scene {room} --out {o}.ply", ("CLOUD:", "got {field}", "kfgs color")),
    ("attach {field} {tmp}/no.ply --scene {room} --out {o}.ply", ("{tmp}/no.ply:", "no such file")),
    ("attach {field} {splat} --out {o}.ply", ("--text:", "got none", "`kfgs features --words")),
    ("attach {field} {splat} --scene {room} --out {o}.ksplat", ("--out:", ".compressed.ply, .ply", "got {o}.ksplat")),
    ("attach {field} {splat} --scene {room} --out {splat}", ("--out:", "another place", "{splat}")),
    ("attach {field} {splat} --scene {room} --out {o}.ply --distance -1", ("--distance:", "(0, inf)", "got -1.0")),
    ("attach {field} {four} --scene {room} --out {o}.ply", ("CLOUD:", "frame", "--same-frame")),
    ("select chiar {labelled} --out {o}", ("class:", "got 'chiar'", "'chair'?")),
    ("select chair {splat}", ("SOURCE:", "classes", "got {splat}", "`kfgs attach FIELD")),
    ("select chair {alone}", ("SOURCE:", "{alone}.classes.json", "copy it")),
    ("select chair {tmp}/no.ply", ("{tmp}/no.ply:", "no such file")),
    ("select chair {field}", ("--text:", "got none", "`kfgs features --words")),
    ("select chair {labelled} --threshold 2", ("--threshold:", "[0, 1]", "got 2.0")),
    ("select chair {labelled} --threshold 1 --out {o}", ("QUERY:", "got none")),
    ("select chair {labelled} --out {splat}", ("--out:", "{splat}", "got a file")),
    ("edit {labelled} --out {o}.ply", ("edits:", "got none", "--remove")),
    ("edit {labelled} --out {o}.ply --remove chiar", ("class:", "wall, floor", "got 'chiar'")),
    ("edit {labelled} --out {o}.ply --move chair:1,2", ("--move:", "got 'chair:1,2'")),
    ("edit {labelled} --out {labelled} --remove chair", ("--out:", "another place", "{labelled}")),
    ("edit {labelled} --out {o} --remove chair", ("--out:", ".compressed.ply, .ply", "got {o}")),
    ("edit {splat} --out {o}.ply --remove chair", ("SPLATS:", "classes", "got {splat}", "`kfgs attach FIELD")),
    ("edit {field} --out {o}.ply --remove chair", ("SPLATS:", "got {field}", "kfgs color")),
    ("edit {labelled} --out {taken}.ply --remove rug", ("--out:", "{taken}.ply.edits.json", "got a folder")),
    ("edit {labelled} --out {o}.ply --remove chair/99", ("part:", "got chair/99", "`kfgs select`")),
    (
        "edit {splat} --out {o}.ply --replay {saved}",
        ("SPLATS:", "expected a splat with classes, got {splat}", "`kfgs attach FIELD {splat} --out labelled.ply`"),
    ),
    ("edit {labelled} --out {o}.ply --replay {room}/classes.json", ("{room}/classes.json:", "'kfgs.edits'")),
    ("edit {plain} --out {o}.ply --remove chair --scene {room}", ("--scene:", "colours", "got Gaussians(")),
    ("color {room} --out {o} --steps 0", ("--steps:", "got 0")),
    ("color {room} --out {o} --split val", ("--split:", "train, test", "got 'val'")),
    ("color {tmp} --out {o}", ("{tmp}:", "COLMAP", "`kfgs sfm")),
    ("convert {splat} {splat}", ("TARGET:", "another place", "{splat}")),
    ("convert {splat} {o}.ksplat", ("TARGET:", ".compressed.ply, .ply", "got {o}.ksplat")),
    ("convert {splat} {o}.spz --plain", ("--plain:", ".ply", "{o}.spz")),
    ("convert {splat} {o} --by-class", ("SOURCE:", "expected a splat with classes")),
    ("convert {room}/text.npy {o}.ply", ("{room}/text.npy:", "known", "compressed_ply")),
    ("convert {tmp}/nothing", ("{tmp}/nothing:", "no such file or folder")),
    ("convert {tmp} {o}.kfgs", ("SOURCE:", "field.kfgs", "`kfgs fit`")),
    ("convert {field} {o}", ("path:", ".kfgs")),
    ("convert {field} {field}", ("TARGET:", "another place")),
    ("convert {field} {run}", ("TARGET:", "a file", "a folder")),
    ("sfm {tmp} --out {o}", ("{tmp}:", "3 images", "got 0")),
    ("fit {room} --out {o} --features {tmp}/no", ("{tmp}/no: expected a folder of feature maps", "`kfgs features`")),
    ("fit {room} --out {o} --features {tmp}", ("{tmp}", "expected at least one view")),
    ("fit {tmp} --out {o} --features {room}/features", ("{tmp}:", "COLMAP", "`kfgs sfm")),
    ("fit {room} --out {o} --split val", ("--split:", "train, test", "got 'val'")),
    ("fit {room} --out {o} --method paper --splat a.ply", ("--splat:", "--method paper", "got a.ply")),
    ("segment {tmp} --scene {room} --out {o}", ("FIELD:", "field.kfgs", "got {tmp}", "`kfgs fit`")),
    ("segment {run} --out {o} --path orbit --frames 0", ("--frames:", "got 0")),
    ("segment {run} --out {o} --path orbitt", ("--path:", PLACES, "got orbitt")),
    (
        "segment {run} --out {o} --path {room}/classes.json",
        ("{room}/classes.json, top level:", "'frames'", "a transforms.json"),
    ),
    ("segment {run} --out {o} --path {room}/labels", ("--path:", PLACES, "got {room}/labels")),
    ("segment {run} --out {o} --path {run}", ("--path:", PLACES, "got {run}; `--path cameras`")),
    ("segment {run} --out {o} --path {splat}", ("--path:", PLACES, "my.ply")),
    ("segment {run} --out {o} --path /dev/null", ("--path:", PLACES, "got /dev/null")),
    ("segment {run} --out {o} --path {one} --frames 3", ("two different views, got 1",)),
    ("render {run} --out {o}.avi", ("--out:", "ends in .gif or .mp4", "new.avi")),
    ("render {run} --out {o}.gif --show labels,colour", ("--show:", "'colour'", "query=TEXT")),
    ("render {run} --out {o}.gif --show query=unicorn", ("unicorn",)),
    ("render {run} --out {o}.gif --frames 1", ("--frames:",)),
    ("render {run} --out {o}.gif --width 0", ("--width:", "got 0")),
    ("render {run} --out {o}.gif --path {tmp}/x.json", ("--path:", "got {tmp}/x.json")),
    ("render {splat} --out {o}.gif", ("SOURCE:", "expected a splat with classes")),
    ("view {run} --out {o} --where window", ("--where: expected a display for a window, got none",)),
    ("view {field} --out {o} --where picture", ("--text: expected a table of words",)),
    ("view {run} --out {o} --where picture --weights x", ("--weights: expected --teacher with it",)),
    ("view {run} --out {o} --where picture --ask wal", ("class:", "got 'wal'")),
    ("view {splat} --out {o} --where picture --ask chair", ("words: expected a splat with classes", "kfgs attach")),
    ("view nowhere --out {o} --where picture", ("SOURCE: expected a field (RUN/field.kfgs",)),
    ("view {run} --out {o} --where picture --color {field}", ("--color: expected a splat file",)),
    (
        "evaluate {run} --protocol kfgs-poled",
        ("--protocol: expected one of kfgs-pooled/1,", "did you mean kfgs-pooled/1"),
    ),
    ("evaluate {run} --truth /nothing", ("--truth: expected label pictures in /nothing", "not a folder")),
    ("evaluate {run} --protocol kfgs-surface --labels own", ("--labels: expected none with kfgs-surface/1",)),
    ("evaluate {run} --out {run}", ("--out: expected a file or nothing",)),
    (
        "evaluate {run} --protocol feature3dgs-teacher --truth /no",
        ("--truth: expected a folder of the teacher's feature",),
    ),
    (
        "evaluate {run}/../true --scene {room} --protocol kfgs-color",
        ("color.ply: no such file; expected a colour splat",),
    ),
    ("evaluate {run} --protocol kfgs-color --truth {room}", ("--truth: expected none with kfgs-color/1",)),
    ("evaluate {room}/features --scene {room} --protocol kfgs-surface", ("expected one with Gaussians",)),
    ("evaluate {room}/features", ("--scene: expected a scene folder, got none",)),
    ("evaluate {room} --scene {room}", ("expected a field or a finished run of kfgs",)),
    ("evaluate nothing --scene {room}", ("expected a field or a finished run of kfgs",)),
    ("evaluate {run}/color.ply --scene {room}", ("benchmarks/protocols.py",)),
    ("evaluate {room}/features --scene {bare}", ("--text: expected a table of words, got none",)),
]


@pytest.fixture(scope="module")
def places(desk, room, tmp_path_factory):
    """What the errors speak of.

    `plain` has classes but no colours, `alone` no names beside it, `four` has four Gaussians far away; a folder lies beside
    `taken`; `one` is a path of one camera; `bare` is a scene without a table of words.
    """
    folder, splat, labelled = tmp_path_factory.mktemp("errors"), desk / "my.ply", desk / "labelled.ply"
    cloud = read_splats(labelled)
    write_splats(cloud.replace(sh=None), folder / "plain.ply")
    (folder / "alone.ply").write_bytes(labelled.read_bytes())
    four = read_splats(splat).select(torch.arange(4))
    write_splats(four.replace(means=four.means + 100), folder / "four.ply")
    same = EditList((Remove("rug"),)).save(folder / "same.ply.edits.json")
    (folder / "taken.ply.edits.json").mkdir()
    camera = {"w": 40, "h": 30, "fl_x": 30, "frames": [{"transform_matrix": torch.eye(4).tolist()}]}
    (folder / "one.json").write_text(json.dumps(camera))
    paths = {"room": room, "field": desk / "true" / "field.kfgs", "splat": splat, "labelled": labelled, "saved": same}
    paths["bare"] = shutil.copytree(room, folder / "bare", ignore=shutil.ignore_patterns("text.npy"))
    paths |= {"run": desk / "run", "taken": folder / "taken", "one": folder / "one.json"}
    paths |= {name: folder / f"{name}.ply" for name in ("plain", "alone", "four")}
    return {name: str(path) for name, path in paths.items()}


@pytest.mark.parametrize(("line", "message"), ERRORS)
def test_bad_input_ends_with_1_one_line_and_no_files(line, message, places, tmp_path, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    places = places | {"tmp": str(tmp_path), "o": str(tmp_path / "o" / "new")}
    sources = {name: places[name] for name in ("splat", "labelled", "saved")}
    before = {name: Path(path).read_bytes() for name, path in sources.items()}
    assert main(line.format(**places).split()) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("error: ")
    assert re.search(tells(*(part.format(**places) for part in message)), said)
    assert list(tmp_path.iterdir()) == []
    assert before == {name: Path(path).read_bytes() for name, path in sources.items()}


@pytest.mark.parametrize(
    "line", ["fly", "fit", "fit x --out y --method gpu", "edit a.ply", "attach a b --out c --by magic"]
)
def test_wrong_usage_ends_with_2(line):
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == 2
