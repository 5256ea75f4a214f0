"""Both methods on a small toy room: stages that are found again, kills, and what the field answers."""

import dataclasses
import os
import shutil

import numpy as np
import pytest
import torch
from messages import refused, tells
from small_room import FIELD, PAPER, SMALL, paper, stages
from tiny_teacher import Tiny

from kfgs._files import read_json
from kfgs.cameras import Distortion
from kfgs.cli import main
from kfgs.fields import Codewords, Identity, SemanticField, UpliftConfig
from kfgs.formats import read_splats
from kfgs.pipeline import ColorConfig, Paper, Uplift, fit, fit_color, score_scene, segment_scene, true_labels
from kfgs.pipeline.stages import Run
from kfgs.scenes import FeatureFolder, extract_features

LENS = Distortion("brown_conrady", (0.3, 0.05, 0.001, -0.002))


def same(a: SemanticField, b: SemanticField) -> bool:
    names = ("means", "quats", "scales", "opacities", "features")
    return all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in names)


def save(folder, stems, maps):
    folder.mkdir()
    for stem, features in zip(stems, maps, strict=True):
        np.save(folder / f"{stem}.npy", features.half().numpy())


def refit(*arguments, **options):
    """The field, and the stages that were found or done."""
    lines = []
    return fit(*arguments, report=lines.append, **options), stages(lines)


# Stages


def test_the_run_folder_holds_every_stage_and_the_field(trained, runs):
    run = runs / "paper"
    names = ["codebook", "index_maps", "autoencoder", "field", "answers"]
    assert [name.rpartition("-")[0] for name in trained.info["stages"]] == list(trained.info["seconds"]) == names
    assert all((run / "stages" / name).is_dir() for name in trained.info["stages"])
    assert not list((run / "unfinished").glob("*"))
    loaded = SemanticField.load(run / "field.kfgs")
    assert same(loaded, trained)
    assert loaded.info["method"] == "paper"
    assert loaded.info["codebook"] == "PaperCodebook"
    assert loaded.info["changed_from_paper"].startswith("codebook.maximum=24, codebook.initial=4, codebook.epochs=4")
    assert "codebook: PaperCodebook" in loaded.summary()
    assert loaded.latents.shape[1] == 4
    losses = [row["loss"] for row in read_json(Run(run).finished("field")[0].folder / "history.json")]
    assert losses[-1] < 0.7 * losses[0]


def test_a_second_fit_finds_all_and_gives_the_same(trained, runs, scene, maps):
    again, seen = refit(scene, maps, PAPER, folder=runs / "paper")
    assert set(seen.values()) == {"found"}
    assert same(again, trained)
    assert again.info == trained.info


def test_going_back_to_old_options_makes_no_stage_again(scene, maps, splat, tmp_path):
    first = fit(scene, maps, Uplift(splat, SMALL), folder=tmp_path)
    (tmp_path / "report.html").write_text("of the first")
    fewer = fit(scene, maps, Uplift(splat, UpliftConfig.field(max_gaussians=10)), folder=tmp_path)
    assert len(SemanticField.load(tmp_path)) == len(fewer) <= 10
    assert not (tmp_path / "report.html").exists()
    again, seen = refit(scene, maps, Uplift(splat, SMALL), folder=tmp_path)
    assert seen == {"uplift": "found"}
    assert same(again, first)


def test_killed_in_the_middle_of_the_field_it_goes_on_and_ends_the_same(trained, scene, maps, tmp_path):
    rows = 0

    def kill(row):
        nonlocal rows
        if "count" in row:  # a row of the field's history
            rows += 1
            if rows == 5:
                raise KeyboardInterrupt

    options = paper(training=dataclasses.replace(FIELD, report_every=12))  # not part of what is learnt
    with pytest.raises(KeyboardInterrupt):
        fit(scene, maps, options, folder=tmp_path, progress=kill)
    assert not (tmp_path / "field.kfgs").exists()
    resumed, seen = refit(scene, maps, options, folder=tmp_path)
    assert [name for name, word in seen.items() if word == "done"] == ["field", "answers"]
    assert same(resumed, trained)


def test_what_decides_a_stage_makes_another(scene, maps, splat, fused, runs, tmp_path):
    run = shutil.copytree(runs / "fused", tmp_path / "run")

    def found(scene, maps, splat, **options):
        return refit(scene, maps, Uplift(splat, SMALL), folder=run, **options)[1]["uplift"] == "found"

    assert found(scene, maps, splat)
    assert not found(scene, maps, splat.replace(means=splat.means + 0.01))
    assert not found(scene, maps, splat.replace(antialiased=True))
    assert not found(scene, maps, splat, seed=1)
    assert found(scene, maps, splat)
    changed = tmp_path / "features"
    save(changed, maps.stems, [maps[i] if i != 2 else maps[i].flip(0) for i in range(len(maps))])
    assert not found(scene, FeatureFolder(changed).of(scene, "train"), splat)
    cameras = [dataclasses.replace(camera, distortion=LENS) for camera in scene.cameras]
    bent = dataclasses.replace(scene, cameras=cameras).undistorted()
    assert not found(bent, maps, splat)


# Uplift


def test_a_splat_becomes_a_small_field_that_is_right_on_unseen_views(fused, scene, classes, room, tmp_path):
    assert len(fused) <= 1_500
    assert fused.latents.shape[1] <= 32
    labels = segment_scene(fused, scene, classes, tmp_path, pictures=1)
    truth = true_labels(scene, room / "labels", "test")
    assert score_scene(labels, truth, classes).accuracy.value > 0.75
    shuffled = {stem: one.flip(1) for stem, one in labels.items()}
    assert score_scene(shuffled, truth, classes).accuracy.value < 0.6
    assert len(list((tmp_path / "predicted").iterdir())) == 3
    assert len(list((tmp_path / "sheets").iterdir())) == 1


def test_without_a_splat_gaussians_are_trained_and_a_longer_colour_fit_is_taken(scene, maps, tmp_path):
    color = dataclasses.replace(ColorConfig.quick(), training=FIELD.with_steps(10), picture_scale=0.5)
    made, seen = refit(scene, maps, Uplift(color=color), folder=tmp_path)
    assert seen == {"color": "done", "uplift": "done"}
    assert len(read_splats(tmp_path / "color.ply")) > 0
    again, seen = refit(scene, maps, Uplift(color=color), folder=tmp_path)
    assert seen == {"color": "found", "uplift": "found"}
    assert again.info == made.info
    fit_color(scene, tmp_path, dataclasses.replace(color, training=FIELD.with_steps(12)), seed=3)
    lines = []
    taken = fit(scene, maps, Uplift(color=color), folder=tmp_path, report=lines.append)
    assert stages(lines) == {"uplift": "done"}
    assert f"geometry: the colours of 12 steps that are in {tmp_path}" in lines
    assert taken.info["steps"] == {"color": 12}


def test_maps_may_be_a_list_in_memory_or_a_teacher(scene, maps, splat, fused, tmp_path):
    given = [maps[i] for i in range(len(maps))]
    made = fit(scene, given, Uplift(splat, SMALL), folder=tmp_path)
    torch.testing.assert_close(made.latents, fused.latents, rtol=1e-3, atol=1e-3)  # a folder is read in blocks
    _, seen = refit(scene, [one.numpy() for one in given], Uplift(splat, SMALL), folder=tmp_path)
    assert seen == {"uplift": "found"}
    extract_features(Tiny(), scene, tmp_path / "maps", split="train")
    stored = fit(scene, FeatureFolder(tmp_path / "maps").of(scene, "train"), Uplift(splat, SMALL))
    assert same(fit(scene, Tiny(), Uplift(splat, SMALL), folder=tmp_path / "run"), stored)


# Paper


@pytest.mark.parametrize("row", ["adc", "decouple"])
def test_the_other_rows_of_table_1(row, scene, maps, trained, runs, classes):
    short = paper(autoencoder=None, training=dataclasses.replace(FIELD, steps=40))
    method = short if row == "adc" else dataclasses.replace(short, codebook=None)
    field, seen = refit(scene, maps, method, folder=runs / "paper")  # shares the codebook with the first
    assert field.latents.shape[1] == 32
    assert type(field.decoder) is (Codewords if row == "adc" else Identity)
    if row == "adc":
        assert seen == {"codebook": "found", "index_maps": "found", "field": "done", "answers": "done"}
    labels = field.segment(scene.cameras[scene.splits["test"][0]], classes.embeddings)
    assert len(labels.unique()) > 2


# What is refused


def test_bad_input_is_refused_before_any_work(scene, room, maps, splat, tmp_path):
    two = FeatureFolder(room / "features", [scene.stem(0), scene.stem(1)])
    backwards = FeatureFolder(room / "features", maps.stems[::-1])
    bent = dataclasses.replace(scene, cameras=[dataclasses.replace(c, distortion=LENS) for c in scene.cameras])
    for arguments, error, words in (
        ((scene, two), ValueError, ("maps:", "6 views of split 'train'", "got 2")),
        ((scene, backwards), ValueError, ("maps:", "order (view_")),
        ((scene, [m.permute(2, 0, 1) for m in maps]), ValueError, ("maps[0]:", "channels are first", "from_bchw")),
        ((bent, maps), ValueError, ("scene:", "distortion", "scene.undistorted()")),
        ((scene, "features"), TypeError, ("maps", "str", "FeatureFolder")),
        ((scene, ["a.npy"]), TypeError, ("maps[0]", "str")),
        ((scene, maps, "paper"), TypeError, ("method:", "Paper()", "str")),
    ):
        refused(lambda arguments=arguments: fit(*arguments, folder=tmp_path), *words, error=error)
    refused(lambda: fit(scene, maps, folder=tmp_path, split="val"), "split:", "train, test", "got 'val'")
    refused(lambda: Paper(codebook=None), "autoencoder:", "codebook=None")
    refused(lambda: Paper(codebook="grown"), "codebook:", "GrownCodebook", "got 'grown'", error=TypeError)
    assert list(tmp_path.iterdir()) == []


def test_a_map_that_is_cut_short_is_found_before_any_work(scene, maps, tmp_path):
    save(tmp_path / "maps", maps.stems, maps)
    damaged = sorted((tmp_path / "maps").iterdir())[2]
    os.truncate(damaged, damaged.stat().st_size - 1000)
    with pytest.raises(ValueError, match=tells(damaged.name)):
        fit(scene, FeatureFolder(tmp_path / "maps").of(scene, "train"), PAPER, folder=tmp_path / "run")
    assert not list((tmp_path / "run").rglob("stage.json"))


# One answer, whoever asks


def test_a_field_remembers_classes_and_cameras(fused, runs, scene, classes):
    loaded = SemanticField.load(runs / "fused")
    assert loaded.classes.names == classes.names
    assert [camera.name for camera in loaded.cameras] == [scene.cameras[i].name for i in scene.views("train")]
    camera = scene.cameras[scene.views("test")[0]]
    assert torch.equal(loaded.segment(camera), fused.segment(camera, classes))


def test_python_and_the_command_line_select_the_same_gaussians(fused, runs, classes, tmp_path, capsys):
    field = SemanticField.load(runs / "fused")
    python = field.query("chair", classes)
    assert len(python) > 0
    assert torch.equal(field.classify(classes).labels == classes.index("chair"), python.mask)
    assert main(["select", "chair", str(runs / "fused" / "field.kfgs"), "--out", str(tmp_path)]) == 0
    assert f"chair: {len(python)} of {len(field)} Gaussians" in capsys.readouterr().out
    assert torch.equal(read_splats(tmp_path / "selection.ply").means, field.gaussians.means[python.mask])


def test_fit_from_the_command_line(desk, tmp_path):
    words = ["fit", str(desk / "scene"), "--splat", str(desk / "my.ply"), "--out", str(tmp_path / "run")]
    assert main([*words, "--set", "uplift.max_gaussians=900", "--set", "uplift.keep=0.9"]) == 0
    assert "half of the views explains" in (tmp_path / "run" / "report.html").read_text()
    assert len(SemanticField.load(tmp_path / "run")) <= 900
    assert main([*words, "--set", "uplift.max_gaussians=none"]) == 0
    assert len(SemanticField.load(tmp_path / "run")) == 4_000
