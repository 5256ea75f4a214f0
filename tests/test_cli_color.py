"""The commands of colour scenes, as a person runs them: color, attach, select, edit, convert."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_color import SH0, surface
from PIL import Image

import kfgs.pipeline.color
from kfgs import Gaussians
from kfgs.cli import main
from kfgs.fields import SemanticField, fuse_views
from kfgs.formats import read_splats, write_splats
from kfgs.formats.ply import read_ply
from kfgs.labels import connected_parts, load_label_set, number_instances
from kfgs.scenes import load_scene
from kfgs.splat import rasterize

COLOR = ["--steps", "30", "--set", "training.densify.maximum=2000"]


@pytest.fixture(scope="module")
def truth(room):
    return surface(room)[1]


@pytest.fixture(scope="module")
def field(desk):
    return desk / "true" / "field.kfgs"


@pytest.fixture(scope="module")
def splat(desk):
    return desk / "my.ply"


@pytest.fixture(scope="module")
def labelled(room, field, splat, tmp_path_factory):
    """The splat with classes, through the command line."""
    out = tmp_path_factory.mktemp("labelled") / "room.ply"
    assert main(["attach", str(field), str(splat), "--scene", str(room), "--by", "distance", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def colored(room, tmp_path_factory):
    """A run of `kfgs color`."""
    out = tmp_path_factory.mktemp("color")
    assert main(["color", str(room), "--out", str(out), *COLOR]) == 0
    return out


def test_color_scores_the_views_held_out(colored, room):
    gaussians = read_splats(colored / "color.ply")
    assert 500 < len(gaussians) <= 2000
    assert gaussians.sh.shape[1:] == (9, 3)
    scores = json.loads((colored / "scores.json").read_text())["color"]
    scene = load_scene(room)
    psnr = {}
    for i in scene.views("test"):
        rendered = rasterize(gaussians, scene.cameras[i]).map.clamp(0, 1).double()
        taken = np.asarray(Image.open(scene.image_paths[i]).convert("RGB")) / 255
        psnr[scene.stem(i)] = -10 * np.log10(((rendered.numpy() - taken) ** 2).mean())
    assert {stem: row["psnr"] for stem, row in scores["views"].items()} == pytest.approx(psnr, abs=1e-3)
    assert scores["psnr"] == pytest.approx(np.mean(list(psnr.values())), abs=1e-3)
    assert len(list((colored / "views").iterdir())) == len(scene.views("test"))


def test_an_interrupted_command_says_that_it_continues(room, tmp_path, monkeypatch, capsys):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(kfgs.pipeline.color, "fit_field", stopped)
    assert main(["color", str(room), "--out", str(tmp_path), *COLOR]) == 130
    assert capsys.readouterr().err.endswith("interrupted; the same command continues where it stopped\n")
    assert not (tmp_path / "color.ply").exists()


def test_attach_by_distance_gives_each_gaussian_the_class_at_its_place(labelled, field, splat, truth, room):
    found, before = read_splats(labelled), read_splats(splat)
    # The field's Gaussians lie at the same places; few, small views show some as their neighbours.
    assert (found.labels == truth).float().mean() > 0.9
    scene = load_scene(room).select("train")
    classes = load_label_set(room / "classes.json", room / "text.npy")
    semantic = fuse_views(SemanticField.load(field), scene.cameras).classify(classes).labels
    assert torch.equal(found.scores == 1, semantic >= 0)  # the same place: no distance
    assert torch.equal(found.labels[semantic >= 0], semantic[semantic >= 0])
    assert found.names == tuple(json.loads((room / "classes.json").read_text()))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(found, name), getattr(before, name))


def test_attach_by_views_is_what_a_scene_does(field, splat, truth, room, tmp_path, capsys):
    out = tmp_path / "new" / "a.compressed.ply"
    assert main(["attach", str(field), str(splat), "--scene", str(room), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "the frames agree" in said
    assert "votes of 6 segmented views" in said
    assert "got a class by the views" in said
    found = read_splats(out).labels
    counts = [f"  {name:<16s} {int((found == i).sum()):8d} Gaussians" for i, name in enumerate(read_splats(out).names)]
    assert "\n".join(counts) in said
    assert f"{'(none)':<16s} {int((found < 0).sum()):8d}" in said or bool((found >= 0).all())
    assert torch.bincount(found + 1, minlength=14)[1:].sum() > 0.9 * len(truth)


def test_select_counts_places_and_saves(labelled, room, tmp_path, capsys):
    out = tmp_path / "o"
    assert main(["select", "sofa", str(labelled), "--scene", str(room), "--out", str(out)]) == 0
    cloud = read_splats(labelled)
    index = cloud.names.index("sofa")
    mask = cloud.labels == index
    said = capsys.readouterr().out
    assert f"sofa: {int(mask.sum())} of 4000 Gaussians, label sofa" in said
    facts = json.loads((out / "selection.json").read_text())
    assert facts["count"] == int(mask.sum())
    largest = facts["parts"][0]
    assert largest["count"] == len(largest["indices"]) <= facts["count"]
    assert mask[largest["indices"]].all()
    np.testing.assert_allclose(largest["extent"][0], cloud.means[largest["indices"]].amin(0), atol=1e-6)
    assert largest["best_view"]["camera"] in {camera.name for camera in load_scene(room).cameras}
    assert largest["best_view"]["camera"] in said
    assert (out / "parts.png").is_file()
    saved = read_splats(out / "selection.ply")
    assert torch.equal(saved.means, cloud.means[mask])
    assert set(saved.labels.tolist()) == {index}


def by_name(path):
    """The cloud, and a mask for each class."""
    cloud = read_splats(path)
    return cloud, {name: cloud.labels == i for i, name in enumerate(cloud.names)}


def test_edit_does_each_of_its_options(labelled, tmp_path, capsys):
    out = tmp_path / "new" / "e.ply"
    options = ["--remove", "chair", "--remove", "rug", "--move", "sofa:0.5,0,-0.25"]
    options += ["--recolor", "plant:#0000ff"]
    assert main(["edit", str(labelled), "--out", str(out), *options]) == 0
    (before, old), (after, new) = by_name(labelled), by_name(out)
    a, b = before, after
    assert f"4000 Gaussians before, {len(b)} after 4 edit(s)" in capsys.readouterr().out
    assert len(b) == 4000 - int(old["chair"].sum()) - int(old["rug"].sum())
    assert not new["chair"].any()
    assert not new["rug"].any()
    torch.testing.assert_close(b.means[new["sofa"]], a.means[old["sofa"]] + torch.tensor([0.5, 0.0, -0.25]))
    rgb = b.sh[new["plant"]][:, 0] * SH0 + 0.5
    assert (rgb[:, 2] > rgb[:, 0] + 0.1).all()
    torch.testing.assert_close(b.means[new["wall"]], a.means[old["wall"]], rtol=0, atol=0)


def test_edits_are_replayed_to_the_same_bytes_from_anywhere(labelled, tmp_path, capsys):
    part, whole, again = tmp_path / "a" / "lamp.ply", tmp_path / "b" / "e.ply", tmp_path / "c" / "e.ply"
    assert main(["edit", str(labelled), "--out", str(part), "--extract", "lamp"]) == 0
    (before, old), (lamp, _) = by_name(labelled), by_name(part)
    assert torch.equal(lamp.means, before.means[old["lamp"]])
    options = ["--remove", "lamp", "--move", "table:0,0,0.5"]
    assert main(["edit", str(labelled), "--out", str(whole), *options]) == 0
    arguments = ["edit", str(labelled), "--out", str(again), "--replay", str(tmp_path / "b" / "e.ply.edits.json")]
    assert main(arguments) == 0
    assert again.read_bytes() == whole.read_bytes()
    assert main([*arguments, "--remove", "chair:fill"]) == 0
    assert "continue the surfaces around" in capsys.readouterr().out
    edits = json.loads((tmp_path / "c" / "e.ply.edits.json").read_text())["edits"]
    assert [(edit["op"], edit.get("fill")) for edit in edits] == [("move", None), ("remove", None), ("remove", True)]


def test_convert_by_class_writes_a_plain_file_for_each_class(labelled, tmp_path, capsys):
    cloud, out = read_splats(labelled), tmp_path / "objects"
    words = ["convert", str(labelled), str(out), "--by-class"]
    assert main(words) == 0
    assert main(words) == 0  # its own files may be replaced
    said = capsys.readouterr().out
    counts = {path.name: len(read_splats(path)) for path in out.iterdir()}
    labels = cloud.labels
    assert counts.pop("unlabelled.ply", 0) == int((labels < 0).sum())
    assert counts[f"05_{cloud.names[5]}.ply"] == int((labels == 5).sum())
    assert sum(counts.values()) == int((labels >= 0).sum())
    for name in counts:
        assert {"class_id", "score"}.isdisjoint(read_ply(out / name))
        assert name in said
    assert "note:" not in said


def test_convert_by_class_tells_the_losses_of_every_class(tmp_path, capsys):
    cloud = Gaussians(
        means=torch.rand(9, 3), quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(9, 1), scales=torch.full((9, 3), 0.1),
        opacities=torch.full((9,), 0.5), sh=torch.zeros(9, 1, 3), labels=torch.arange(9) % 3, names=("wall", "chair", "sofa"),
    )  # fmt: skip
    write_splats(cloud.replace(origin=(5e5, 4e6, 0.0)), tmp_path / "far.ply")
    assert main(["convert", str(tmp_path / "far.ply"), str(tmp_path / "objects"), "--by-class"]) == 0
    printed, files = capsys.readouterr().out, ["00_wall.ply", "01_chair.ply", "02_sofa.ply"]
    assert re.findall(r"coordinates of (\S+) are relative to the origin", printed) == files
    for name in files:
        assert f"{tmp_path / 'objects' / name}.origin.json" in printed


def test_all_photographs_can_be_used_and_none_is_left_to_score(room, splat, tmp_path, capsys):
    every = sorted(path.stem for path in (room / "images").iterdir())
    assert main(["fit", str(room), "--out", str(tmp_path / "run"), "--splat", str(splat), "--split", "all"]) == 0
    field = SemanticField.load(tmp_path / "run" / "field.kfgs")
    assert [Path(name).stem for name in field.info["views"]] == every
    out = tmp_path / "segmented"
    assert main(["segment", str(tmp_path / "run" / "field.kfgs"), "--out", str(out), "--split", "all"]) == 0
    assert sorted(path.stem for path in (out / "predicted").iterdir()) == every
    capsys.readouterr()
    assert main(["color", str(room), "--out", str(tmp_path / "color"), *COLOR, "--split", "all"]) == 0
    printed = capsys.readouterr().out
    assert "nothing to score against" in printed
    assert re.findall("^note: split .*", printed, re.MULTILINE) in ([], [f"note: split all: all {len(every)} views"])
    assert not (tmp_path / "color" / "scores.json").exists()


def test_parts_that_are_not_listed_are_counted(desk, capsys):
    field = SemanticField.load(desk / "run")
    selection = field.query("chair")
    counts = lambda lines: [int(re.search(r"Part\((\d+) ", line)[1]) for line in lines]  # noqa: E731
    assert main(["select", "chair", str(desk / "run")]) == 0
    told = connected_parts(number_instances(field, field.cameras), selection)
    assert counts(capsys.readouterr().out.splitlines()[1:]) == [part.count for part in told]
    assert main(["select", "chair", str(desk / "run"), "--distance", "0.3"]) == 0
    *parts, note = capsys.readouterr().out.splitlines()[1:]
    listed = connected_parts(field, selection, distance=0.3)
    assert counts(parts) == [part.count for part in listed]
    left = listed[0].total - len(listed)
    assert left > 0
    assert note == f"  {left} smaller part{'s are' if left > 1 else ' is'} not listed"
    assert main(["select", "chair", str(desk / "run"), "--distance", "100"]) == 0
    [whole] = capsys.readouterr().out.splitlines()[1:]
    assert whole.startswith(f"  Part({len(selection)} Gaussians")
