"""The command pack, and that other commands take its file wherever they take a field folder."""

from dataclasses import replace

import pytest
import torch
from cases_packed import field

from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.formats import read_splats
from kfgs.labels import LabelSet

ENDING = ".kfgs"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run folder with a field, its scene, and the packed field beside them."""
    root = tmp_path_factory.mktemp("pack")
    scene, made = root / "scene", field("fused", n=400)
    scene.mkdir()
    (scene / "classes.json").write_text('["wall", "chair"]')
    words = LabelSet(("wall", "chair"), made.decoder.decode(made.features[:2]))
    words.save(scene / "text.safetensors")
    made = replace(made, classes=words, info={"method": "fuse", "scene": str(scene)})
    made.save(root / "run" / "field.kfgs")
    assert main(["convert", str(root / "run" / "field.kfgs"), str(root / f"room{ENDING}")]) == 0
    return root


def test_a_packed_field_is_told_in_bytes_and_errors(place, tmp_path, capsys):
    out = tmp_path / f"a{ENDING}"
    assert main(["convert", str(place / "run" / "field.kfgs"), str(out), "--precision", "fine"]) == 0
    said = capsys.readouterr().out
    packed = SemanticField.load(out)
    errors = packed.info["rounded"][0]["errors"]
    assert f"within {errors['gaussians.means']:.3g} world units" in said
    assert "within 0.5 degrees" in said
    assert "Morton order" in said
    assert str(out) in said
    assert packed.classes.names == ("wall", "chair")


def test_other_commands_take_the_file(place, tmp_path, capsys):
    packed = place / f"room{ENDING}"
    assert main(["convert", str(packed)]) == 0
    said = capsys.readouterr().out
    assert "400 Gaussians" in said
    assert "rounded: small" in said
    assert "one file of 0.0" in said
    assert main(["convert", str(packed), str(tmp_path / "labelled.ply")]) == 0
    labels = read_splats(tmp_path / "labelled.ply").labels
    assert torch.equal(labels, SemanticField.load(packed).classify().labels)
