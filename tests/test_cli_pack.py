"""The command pack, and that other commands take its file wherever they take a field folder."""

import json
import re
import shutil
from typing import get_args

import pytest
import torch
from cases_packed import assert_same, assert_within, field
from messages import tells

from kfgs._files import digest_file
from kfgs.cli import main, options
from kfgs.evaluation import Report
from kfgs.fields import SemanticField, remember
from kfgs.fields.precision import PRECISIONS, PrecisionName
from kfgs.formats import read_splats
from kfgs.labels import LabelSet

ENDING = ".kfgs.safetensors"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run folder with a field, its scene, and the packed field beside them."""
    root = tmp_path_factory.mktemp("pack")
    scene, made = root / "scene", field("fused", n=400)
    scene.mkdir()
    (scene / "classes.json").write_text('["wall", "chair"]')
    words = LabelSet(("wall", "chair"), made.linear.decode(made.features[:2]))
    words.save(scene / "text.safetensors")
    info = {"method": "fuse", **remember(scene, root / "run" / "field")}
    made = SemanticField(**{**vars(made), "words": None, "info": info})
    made.save(root / "run" / "field")
    assert main(["pack", str(root / "run" / "field"), str(root / f"room{ENDING}")]) == 0
    return root


def test_a_packed_field_is_told_in_bytes_and_errors(place, tmp_path, capsys):
    out = tmp_path / f"a{ENDING}"
    assert main(["pack", str(place / "run" / "field"), str(out), "--precision", "fine"]) == 0
    said = capsys.readouterr().out
    packed = SemanticField.load(out)
    errors = packed.info["rounded"][0]["errors"]
    assert f"within {errors['gaussians.means']:.3g} world units" in said
    assert "within 0.5 degrees" in said
    assert "Morton order" in said
    assert str(out) in said
    assert packed.label_set().names == ("wall", "chair")


def test_the_file_holds_the_classes_that_the_folder_remembers(place, tmp_path, capsys):
    moved = tmp_path / f"elsewhere{ENDING}"
    shutil.copy(place / f"room{ENDING}", moved)
    assert main(["select", "chair", str(moved)]) == 0
    assert "chair: " in capsys.readouterr().out
    shutil.copytree(place / "run" / "field", tmp_path / "field")  # its notes lead nowhere from here
    assert main(["select", "chair", str(tmp_path / "field")]) == 1
    assert main(["pack", str(tmp_path / "field"), str(tmp_path / f"b{ENDING}")]) == 0
    assert "note: without classes" in capsys.readouterr().out
    words = ["--text", str(place / "scene" / "text.safetensors")]
    assert main(["pack", str(tmp_path / "field"), str(tmp_path / f"b{ENDING}"), *words]) == 0
    assert SemanticField.load(tmp_path / f"b{ENDING}").label_set().names == ("wall", "chair")
    LabelSet(("wall",), torch.ones(1, 7)).save(tmp_path / "others.safetensors")
    words = ["--text", str(tmp_path / "others.safetensors")]
    assert main(["pack", str(tmp_path / "field"), str(tmp_path / f"c{ENDING}"), *words]) == 1
    assert "7" in capsys.readouterr().err
    assert not (tmp_path / f"c{ENDING}").exists()


def test_lossless_and_back_is_the_same_folder(place, tmp_path, capsys):
    out, folder = tmp_path / f"a{ENDING}", tmp_path / "field"
    assert main(["pack", str(place / "run" / "field"), str(out), "--precision", "lossless"]) == 0
    assert "within" not in capsys.readouterr().out
    assert main(["pack", str(out), str(folder)]) == 0
    before, after = SemanticField.load(place / "run" / "field"), SemanticField.load(folder)
    for name in ("means", "quats", "scales", "opacities", "features"):
        assert torch.equal(getattr(before.gaussians, name), getattr(after.gaussians, name))
    assert after.label_set().names == before.label_set().names == ("wall", "chair")
    assert json.loads((folder / "field.json").read_text())["version"] == 3
    again = tmp_path / f"again{ENDING}"
    assert main(["pack", str(folder), str(again), "--precision", "lossless"]) == 0
    assert_same(SemanticField.load(again), after)


def test_a_folder_may_be_packed_from_python_too(place, tmp_path):
    made = SemanticField.load(place / "run" / "field")
    made.save(tmp_path / f"a{ENDING}", precision="small")
    assert_within(
        SemanticField(**{**vars(made), "words": made.label_set()}), SemanticField.load(tmp_path / f"a{ENDING}")
    )


def test_other_commands_take_the_file(place, tmp_path, capsys):
    packed = place / f"room{ENDING}"
    assert main(["info", str(packed)]) == 0
    said = capsys.readouterr().out
    assert "400 Gaussians" in said
    assert "rounded: precision small" in said
    assert "one file of 0.0" in said
    assert main(["label", str(packed), "--out", str(tmp_path / "labelled")]) == 0
    labels = read_splats(tmp_path / "labelled" / "gaussians.ply").gaussians.labels
    assert torch.equal(labels, SemanticField.load(packed).classify().labels)
    assert main(["convert", str(packed), str(tmp_path / "a.ply")]) == 1
    assert "a semantic field" in capsys.readouterr().err


def test_the_command_line_offers_the_precisions_that_there_are():
    assert get_args(options.Precision) == get_args(PrecisionName) == tuple(PRECISIONS)


def test_scores_travel_in_the_file(place, tmp_path, capsys):
    scores, out = tmp_path / "scores.json", tmp_path / f"a{ENDING}"
    scores.write_text(json.dumps(Report("kfgs-pooled/1", {"mIoU": 0.84}, ({"class": "wall", "IoU": 0.9},)).to_json()))
    words = ["pack", str(place / "run" / "field"), str(out), "--scores", str(scores)]
    assert main(words) == 0
    (kept,) = SemanticField.load(out).info["scores"]
    assert (kept["protocol"], kept["scores"]) == ("kfgs-pooled/1", {"mIoU": 0.84})
    assert "rows" not in kept
    scores.write_text('{"a": 1}')
    before = out.read_bytes()
    assert main(words) == 1
    assert "kfgs evaluate --out" in capsys.readouterr().err
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}", "{tmp}/o" + ENDING], ("FIELD:", "field.json", ENDING, "`kfgs fit`")),
        (["{place}/run", "{tmp}/o" + ENDING], ("FIELD:", "a run folder", "pass {place}/run/field")),
        (["{place}/run/field", "{tmp}/o", "--precision", "small"], ("--precision:", "folder", ENDING)),
        (["{place}/room" + ENDING, "{place}/room" + ENDING], ("OUT:", "another place")),
        (
            ["{place}/room" + ENDING, "{place}/run/field"],
            ("OUT:", "{place}/run/field", "holds another field", "rename"),
        ),
        (["{place}/room" + ENDING, "{place}/run"], ("{place}/run", "something else", "another")),
        (["{place}/run/field", "{tmp}/o" + ENDING, "--scores", "{tmp}/no.json"], ("no.json:", "no such file")),
    ],
)
def test_bad_input_ends_with_one_message_and_no_files(arguments, message, place, tmp_path, capsys):
    fill = {"tmp": str(tmp_path), "place": str(place)}
    before = digest_file(place / "run" / "field" / "field.json")
    assert main(["pack", *(one.format(**fill) for one in arguments)]) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert re.search(tells(*(part.format(**fill) for part in message)), said)
    assert not list(tmp_path.iterdir())
    assert digest_file(place / "run" / "field" / "field.json") == before
