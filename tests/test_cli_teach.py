"""The whole path of the command line, from photographs and weights to words: LSeg's own code with a tiny network."""

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_teach import TinyLSeg, save_checkpoint, shrink_door
from lseg_layout import layout
from messages import tells
from PIL import Image
from small_room import make_room

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.labels import load_label_set
from kfgs.scenes import load_scene
from kfgs.teachers.lseg import LSegConfig

HERE = Path(__file__).parent
TEACHER = ["--teacher", "cases_teach:TinyLSeg", "--weights"]
QUICK = ["--steps", "3", "--method", "adc"]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("room") / "scene")


@pytest.fixture(scope="module")
def scene(request, tmp_path_factory):
    """12 real photographs of a door, taken through a lens; the toy room where they are missing. No test changes it."""
    try:
        source = request.getfixturevalue("shared_data") / "lund_door"
    except pytest.skip.Exception:
        return request.getfixturevalue("room")
    return shrink_door(source, tmp_path_factory.mktemp("door") / "scene")


@pytest.fixture(scope="module")
def pictures(scene):
    """The training pictures by their stems: 10 of the door, 6 of the room."""
    loaded = load_scene(scene)
    return {loaded.stem(i): loaded.image_paths[i] for i in loaded.views("train")}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return save_checkpoint(tmp_path_factory.mktemp("weights") / "tiny.ckpt")


@pytest.fixture(scope="module")
def maps(scene, weights, tmp_path_factory):
    """The scene's maps, made in one go."""
    folder = tmp_path_factory.mktemp("maps") / "features"
    assert main(["features", str(scene), *TEACHER, str(weights), "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def run(scene, maps, tmp_path_factory):
    """A field fitted to stored maps."""
    out = tmp_path_factory.mktemp("run")
    assert main(["fit", str(scene), "--features", str(maps), "--out", str(out), *QUICK]) == 0
    return out


@pytest.fixture
def seen(tmp_path, monkeypatch):
    """Tells how many pictures the teacher has seen since it was asked last."""
    log = tmp_path / "seen.txt"
    monkeypatch.setenv("TEACH_LOG", str(log))

    def count() -> int:
        number = len(log.read_text().splitlines()) if log.is_file() else 0
        log.unlink(missing_ok=True)
        return number

    return count


def fails(arguments, capsys) -> str:
    """The one line that a command which cannot do its work leaves on stderr."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert error.endswith("\n")
    assert "Traceback" not in error
    return error


def told(folder: Path):
    """What features.json tells."""
    return json.loads((folder / "features.json").read_text())


def command(arguments, **environment):
    """A process of its own, in the folder of the user's module."""
    return subprocess.Popen(
        [sys.executable, "-m", "kfgs", *map(str, arguments)],
        cwd=HERE,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("sent", "code", "last_words"),
    [
        (signal.SIGKILL, -signal.SIGKILL, ""),
        (signal.SIGINT, 130, "interrupted; the same command continues where it stopped\n"),
    ],
    ids=["killed", "interrupted"],
)
def test_ended_in_the_middle_it_goes_on_and_ends_byte_for_byte_the_same(
    scene, pictures, weights, maps, seen, tmp_path, capsys, sent, code, last_words
):
    log, out = tmp_path / "log.txt", tmp_path / "features"
    arguments = ["features", scene, *TEACHER, weights, "--out", out]
    process = command(arguments, TEACH_LOG=str(log), TEACH_STOP="4")
    while not log.is_file() or log.read_text().count("\n") < 4:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.send_signal(sent)
    _, error = process.communicate()
    assert process.returncode == code
    assert error.endswith(last_words)
    assert "Traceback" not in error
    finished = list(json.loads((out / "features.json").read_text())["pictures"])
    assert 3 <= len(finished) < len(pictures)
    before = {name: (out / f"{name}.npy").stat().st_mtime_ns for name in finished}

    assert main([str(argument) for argument in arguments]) == 0
    assert seen() == len(pictures) - len(finished)
    for name, was in before.items():
        assert (out / f"{name}.npy").stat().st_mtime_ns == was  # not even written again
    files = sorted(path.name for path in maps.iterdir())
    assert sorted(path.name for path in out.iterdir()) == files  # and nothing half-written is left
    for name in files:
        if name.endswith(".npy"):
            assert (out / name).read_bytes() == (maps / name).read_bytes(), name
    assert told(out) == told(maps)


def test_maps_are_lsegs_of_the_photographs(pictures, weights, maps):
    teacher = TinyLSeg(weights)
    assert sorted(path.stem for path in maps.glob("*.npy")) == sorted(pictures)
    for stem, path in pictures.items():
        photo = np.asarray(Image.open(path).convert("RGB"), dtype=np.float32) / 255
        expected = teacher.encode_image(torch.from_numpy(photo).permute(2, 0, 1)).permute(1, 2, 0)
        found = np.load(maps / f"{stem}.npy")
        assert found.dtype == np.float16
        assert max(found.shape[:2]) == 64
        np.testing.assert_allclose(found, expected.half().numpy(), rtol=2e-3, atol=2e-3)


def test_run_again_nothing_is_made_and_a_changed_picture_is_made_alone(
    scene, pictures, weights, maps, seen, tmp_path, capsys
):
    copy, out = tmp_path / "scene", tmp_path / "maps"
    shutil.copytree(scene, copy)
    shutil.copytree(maps, out)  # times and all
    arguments = ["features", str(copy), *TEACHER, str(weights), "--out", str(out)]
    assert main(arguments) == 0
    assert seen() == 0
    first, second, third = list(pictures)[1:4]
    shutil.copy(pictures[second], copy / "images" / pictures[first].name)
    capsys.readouterr()
    assert main(arguments) == 0
    assert seen() == 1
    assert (out / f"{first}.npy").read_bytes() == (out / f"{second}.npy").read_bytes()
    (out / f"{third}.npy").unlink()
    assert main(arguments) == 0
    assert seen() == 1
    assert (out / f"{third}.npy").read_bytes() == (maps / f"{third}.npy").read_bytes()


def test_other_weights_are_refused_unless_the_maps_are_given_up(scene, pictures, maps, seen, tmp_path, capsys):
    out, other = tmp_path / "maps", save_checkpoint(tmp_path / "other.ckpt", seed=1)
    shutil.copytree(maps, out)
    arguments = ["features", scene, *TEACHER, other, "--out", out]
    error = fails(arguments, capsys)
    assert re.search(tells("same teacher", out, "weights", f"{len(pictures)} maps"), error)
    assert seen() == 0
    assert told(out) == told(maps)


def test_check_reports_maps_that_do_not_fit(scene, pictures, maps, tmp_path, capsys):
    assert main(["features", str(scene), "--out", str(maps)]) == 0
    assert f"next: kfgs fit {scene} --out run --features {maps}" in capsys.readouterr().out
    out = tmp_path / "maps"
    shutil.copytree(maps, out)
    gone, broken, turned, *good = pictures
    (out / f"{gone}.npy").unlink()
    np.save(out / f"{broken}.npy", np.full_like(np.load(out / f"{broken}.npy"), np.nan))
    np.save(out / f"{turned}.npy", np.load(out / f"{turned}.npy").transpose(1, 0, 2))
    capsys.readouterr()
    assert main(["features", str(scene), "--out", str(out)]) == 1
    said, error = capsys.readouterr()
    assert error.startswith(f"error: --out: expected a map that fits for each of the {len(pictures)} views of split")
    assert error.count("\n") == 1
    for name in (gone, broken, turned):
        assert name in said
        assert name not in error  # said once
    assert not any(name in said for name in good)


def test_info_tells_a_folder_of_maps(pictures, maps, capsys):
    assert main(["convert", str(maps)]) == 0
    said = capsys.readouterr().out
    assert f"{len(pictures)} feature maps by lseg" in said
    h, w, D = np.load(maps / f"{next(iter(pictures))}.npy").shape
    assert f"{h} x {w} cells, {D} channels" in said
    assert told(maps)["teacher"]["weights"] in said


def test_maps_and_words_of_a_scene_are_made_in_one_go(scene, pictures, weights, maps, tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("features", "text.npy", "classes.json"))
    assert main(["features", str(copy), "--words", "door,wall", *TEACHER, str(weights)]) == 0
    assert f"wrote:\n  {copy / 'text.safetensors'}\n  {copy / 'features'}" in capsys.readouterr().out
    assert load_label_set(copy / "text.safetensors").names == ("door", "wall")
    name = f"{next(iter(pictures))}.npy"
    assert (copy / "features" / name).read_bytes() == (maps / name).read_bytes()


def test_words_of_the_same_weights_query_the_field(run, weights, tmp_path, capsys):
    table = tmp_path / "text.safetensors"
    assert (
        main(["features", "--words", "wooden door,stone wall,ground", *TEACHER, str(weights), "--out", str(table)]) == 0
    )
    assert "3 classes, 16 channels each, by lseg, as '{}'" in capsys.readouterr().out
    field = SemanticField.load(run / "field.kfgs")
    assert main(["select", "wooden door", str(run / "field.kfgs"), "--text", str(table)]) == 0
    first = capsys.readouterr().out
    assert f" of {len(field)} Gaussians" in first
    assert "2 negatives" in first
    assert "text of another" not in first
    teacher = ["--text", str(table), *TEACHER, str(weights)]
    assert main(["select", "wooden door", str(run / "field.kfgs"), *teacher]) == 0
    assert capsys.readouterr().out == first  # embedded anew, it is the same
    assert main(["select", "the old door behind the arch", str(run / "field.kfgs"), *TEACHER, str(weights)]) == 0
    assert f" of {len(field)} Gaussians" in capsys.readouterr().out
    other = save_checkpoint(tmp_path / "other.ckpt", seed=1)
    assert main(["select", "a door", str(run / "field.kfgs"), *TEACHER, str(other)]) == 0
    assert "got text of another" in capsys.readouterr().out


class Run:
    """An object whose pickle, loaded by Python's rules, calls a function."""

    def __init__(self, function, argument):
        self.call = function, (argument,)

    def __reduce__(self):
        return self.call


def hostile(marker: Path) -> dict[str, Run]:
    """Two ways to make a file."""
    return {"pickle": Run(os.system, f"touch '{marker}'"), "zip": Run(exec, f"open({str(marker)!r}, 'w').close()")}


def wrong_files(folder: Path, weights: Path) -> dict[str, tuple[Path, str]]:
    """Paths that people give as LSeg's weights, and a word of what they are to be told."""
    evil = hostile(folder / "marker")
    made = {
        name: folder / f"{name}.ckpt" for name in ("noise", "short", "half", "pickle", "zip", "rn101", "clip", "html")
    }
    made["noise"].write_bytes(np.random.default_rng(0).bytes(5000))
    made["short"].write_bytes(weights.read_bytes()[:300])
    made["half"].write_bytes(weights.read_bytes()[: weights.stat().st_size // 2])
    made["pickle"].write_bytes(pickle.dumps(evil["pickle"]))
    torch.save({"state_dict": evil["zip"]}, made["zip"])
    torch.save(
        {"net.pretrained.layer1.0.weight": torch.ones(1), "net.scratch.head1.bias": torch.ones(1)}, made["rn101"]
    )
    torch.save({"visual.conv1.weight": torch.ones(1), "ln_final.bias": torch.ones(1)}, made["clip"])
    made["html"].write_text(
        "<!DOCTYPE html>\n<html><head><title>Google Drive - Virus scan warning</title></head></html>"
    )
    (folder / "folder.ckpt").mkdir()
    words = {
        "noise": "got",
        "short": "not a zip file",
        "half": "not a zip file",
        "pickle": "pickle",
        "zip": "expected a checkpoint",
        "rn101": "clip_resnet101",
        "clip": "got CLIP",
        "html": "HTML",
    }
    return {name: (made[name], word) for name, word in words.items()} | {
        "tiny": (weights, "clip_vitl16_384"),
        "folder": (folder / "folder.ckpt", "got a folder"),
        "missing": (folder / "missing.ckpt", "no such file"),
    }


KINDS = ["noise", "short", "half", "pickle", "zip", "rn101", "clip", "html", "tiny", "folder", "missing"]


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_weights_are_named_in_one_line_and_not_run(room, weights, tmp_path, capsys, kind):
    files = wrong_files(tmp_path, weights)
    assert sorted(files) == sorted(KINDS)
    path, word = files[kind]
    out = tmp_path / "features"
    error = fails(["features", room, "--teacher", "lseg", "--weights", path, "--out", out], capsys)
    assert str(path) in error
    assert word in error
    assert len(error) < 700
    assert not (tmp_path / "marker").exists()
    assert not out.exists()
    table = tmp_path / "t.safetensors"
    assert str(path) in fails(
        ["features", "--words", "wall", "--teacher", "lseg", "--weights", path, "--out", table], capsys
    )
    assert not table.exists()
    assert not (tmp_path / "marker").exists()


@pytest.mark.parametrize("kind", ["pickle", "zip"])
def test_the_marker_would_have_been_made(tmp_path, kind):
    """The pickles of the test above do what they are there for."""
    marker = tmp_path / "marker"
    pickle.loads(pickle.dumps(hostile(marker)[kind]))
    assert marker.exists()


def test_a_process_says_no_more_than_the_one_line(room, weights, tmp_path):
    path = wrong_files(tmp_path, weights)["pickle"][0]
    process = command(["features", room, "--teacher", "lseg", "--weights", path, "--out", tmp_path / "maps"])
    _, error = process.communicate()
    assert process.returncode == 1
    assert error.startswith(f"error: {path}: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "marker").exists()
    assert not (tmp_path / "maps").exists()


def test_a_missing_tensor_is_counted_and_named(room, tmp_path, capsys):
    names = [name for name in layout(LSegConfig()) if not name.endswith("scratch.head1.bias")]
    path = tmp_path / "a.ckpt"
    torch.save({name: torch.zeros(1) for name in names}, path)
    error = fails(["features", room, "--teacher", "lseg", "--weights", path, "--out", tmp_path / "o"], capsys)
    assert f"error: {path}: " in error
    assert "head1.bias" in error


def test_what_a_manifest_says_is_told_in_one_line_each(maps, tmp_path, capsys):
    folder = tmp_path / "maps"
    shutil.copytree(maps, folder)
    facts = json.loads((folder / "features.json").read_text())
    facts["teacher"] = {"name": "x\x1b[31mPWN\nwrote:\n  fake"}
    (folder / "features.json").write_text(json.dumps(facts))
    assert main(["convert", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "\nwrote:" not in said
    assert r"x\x1b[31mPWN\nwrote:" in said
