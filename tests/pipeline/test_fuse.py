"""The default method on a small toy room: a splat in, a small field out; and one answer, whoever asks."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image
from safetensors.torch import load_file
from small_room import make_room

import kfgs
from kfgs.cli import main
from kfgs.fields import Clicks, SemanticField, UpliftConfig
from kfgs.formats import read_splats, write_splats
from kfgs.gaussians import Gaussians
from kfgs.labels import load_label_set
from kfgs.pipeline import FitConfig, fit_color, fit_scene, score_scene, segment_scene, true_labels, uplift
from kfgs.pipeline.color import ColorConfig
from kfgs.pipeline.stages import LOCK
from kfgs.scenes import FeatureFolder, load_scene, save_feature_map
from kfgs.viz import explore

CONFIG = FitConfig(uplift=UpliftConfig.field(max_gaussians=1_500))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("fuse") / "scene")


@pytest.fixture(scope="module")
def scene(room):
    return load_scene(room)


@pytest.fixture(scope="module")
def maps(room, scene):
    return FeatureFolder(room / "features", [scene.stem(i) for i in scene.views("train")])


@pytest.fixture(scope="module")
def splat(room):
    """A Gaussian on each of 4,000 points of the true surface, small and opaque."""
    with np.load(room / "surface.npz") as surface:
        points = torch.from_numpy(surface["points"]).float()
    n = len(points)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(points, quats, torch.full((n, 3), 0.06), torch.full((n,), 0.9), sh=torch.zeros(n, 1, 3))


@pytest.fixture(scope="module")
def fitted(scene, maps, splat, tmp_path_factory):
    return fit_scene(scene, maps, tmp_path_factory.mktemp("run"), CONFIG, splat=splat)


@pytest.fixture(scope="module")
def classes(room):
    return load_label_set(room / "classes.json", room / "text.npy")


def test_photos_cut_to_portraits_give_nearly_the_same_labels(room, scene, maps, splat, classes, tmp_path):
    """Every second photo, 80 x 60, keeps its columns 20 to 60 and a map of its own, 20 x 30 instead of 40 x 30 cells."""
    frames = []
    for i, view in enumerate(scene.views("train")):
        camera, cut = scene.cameras[view], 20 * (i % 2)
        picture = (scene.image(view)[:, cut : 80 - cut] * 255).byte().numpy()
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(picture).save(tmp_path / "images" / camera.name)
        save_feature_map(tmp_path / "maps", scene.stem(view), maps[i][:, cut // 2 : 40 - cut // 2])
        pose = torch.linalg.inv(camera.viewmat.double()) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
        K = camera.K.tolist()
        frame = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2] - cut, "cy": K[1][2]}
        frames.append(frame | {"file_path": f"images/{camera.name}", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    mixed = load_scene(tmp_path, split="all")
    assert {camera.size for camera in mixed.cameras} == {(60, 80), (60, 40)}
    cut_maps = FeatureFolder(tmp_path / "maps").of(mixed)
    plain = FitConfig(uplift=UpliftConfig(corrections=0))
    whole, part = (
        uplift(views, given, splat, plain).classify(classes) for views, given in ((scene, maps), (mixed, cut_maps))
    )
    both = (whole.labels >= 0) & (part.labels >= 0)
    assert both.float().mean() > 0.9
    assert (whole.labels == part.labels)[both].float().mean() > 0.95  # 0.966
    wrong = uplift(mixed, [one.flip(1) for one in cut_maps], splat, plain).classify(classes).labels
    assert (whole.labels == wrong)[both].float().mean() < 0.7  # 0.659


def test_a_splat_becomes_a_small_field_that_is_right_on_unseen_views(fitted, scene, classes, room, tmp_path):
    assert fitted.field.decoder.name == "fused"
    assert len(fitted.field) <= 1_500
    assert fitted.field.decoder.latent <= 32
    found = segment_scene(fitted.field, scene, classes, tmp_path, pictures=1)
    truth = true_labels(scene, room / "labels", "test")
    assert score_scene(found, truth, classes).accuracy.value > 0.75
    shuffled = {stem: labels.flip(1) for stem, labels in found.items()}
    assert score_scene(shuffled, truth, classes).accuracy.value < 0.6


def test_a_second_run_reuses_the_stage_and_another_splat_makes_another(fitted, scene, maps, splat):
    again = fit_scene(scene, maps, fitted.folder, CONFIG, splat=splat)
    assert [(stage.name, stage.reused) for stage in again.stages] == [("uplift", True)]
    assert torch.equal(again.field.features, fitted.field.features)
    moved = splat.replace(means=splat.means + 0.01)
    assert not fit_scene(scene, maps, fitted.folder, CONFIG, splat=moved).stages[0].reused
    fine = fit_scene(scene, maps, fitted.folder, CONFIG, splat=splat.replace(antialiased=True))
    assert not fine.stages[0].reused
    assert fine.field.gaussians.antialiased
    assert SemanticField.load(fine.field_path).gaussians.antialiased
    fit_scene(scene, maps, fitted.folder, CONFIG, splat=splat)  # the folder's field is the fixture's again


def test_the_seed_decides_alone(scene, maps, splat, fitted, tmp_path):
    same = fit_scene(scene, maps, tmp_path / "a", CONFIG, splat=splat)
    assert torch.equal(same.field.features, fitted.field.features)
    assert torch.equal(same.field.gaussians.means, fitted.field.gaussians.means)
    other = fit_scene(scene, maps, tmp_path / "b", dataclasses.replace(CONFIG, seed=1), splat=splat)
    same_count = len(same.field) == len(other.field)
    assert not (same_count and torch.equal(same.field.gaussians.means, other.field.gaussians.means))


def test_without_a_splat_gaussians_are_trained_and_a_longer_colour_fit_is_taken(scene, maps, tmp_path):
    quick = dataclasses.replace(CONFIG.color, field=ColorConfig.quick().field.with_steps(30), picture_scale=0.5)
    config = dataclasses.replace(CONFIG, color=quick)
    made = fit_scene(scene, maps, tmp_path, config)
    assert [(stage.name, stage.reused) for stage in made.stages] == [("color", False), ("uplift", False)]
    assert (tmp_path / "color.ply").is_file()
    written = (tmp_path / "field.kfgs").stat().st_mtime_ns
    again = fit_scene(scene, maps, tmp_path, config)
    assert [(stage.name, stage.reused) for stage in again.stages] == [("color", True), ("uplift", True)]
    assert again.field.info == made.field.info
    assert (tmp_path / "field.kfgs").stat().st_mtime_ns == written
    other = fit_scene(scene, maps, tmp_path, dataclasses.replace(config, seed=1))
    assert not any(stage.reused for stage in other.stages)
    longer = dataclasses.replace(quick, field=quick.field.with_steps(40))
    explicit = dataclasses.replace(longer.field, extent=scene.extent)  # what None computes
    fit_color(scene, tmp_path, dataclasses.replace(longer, field=explicit))
    lines = []
    taken = fit_scene(scene, maps, tmp_path, config, report=lines.append)
    assert [stage.name for stage in taken.stages] == ["uplift"]
    assert f"geometry: the colours of 40 steps that are in {tmp_path}" in lines


def test_the_colours_of_a_shorter_fit_are_kept(scene, maps, tmp_path):
    quick = dataclasses.replace(CONFIG.color, field=ColorConfig.quick().field.with_steps(30), picture_scale=0.5)
    shorter = fit_color(scene, tmp_path, dataclasses.replace(quick, field=quick.field.with_steps(20)))
    before = shorter.path.read_bytes()
    lines = []
    made = fit_scene(scene, maps, tmp_path, dataclasses.replace(CONFIG, color=quick), report=lines.append)
    assert shorter.path.read_bytes() == before
    trained = load_file(made.stages[0].folder / "params.safetensors")
    told = [line for line in lines if line.startswith("color.ply: left as it is")]
    assert len(told) == 1
    assert str(made.stages[0].folder) in told[0]
    assert f"{len(trained['means']):,} Gaussians of the field" in told[0]
    assert "holds other Gaussians" in told[0]
    replaced = fit_color(scene, tmp_path, quick, report=lines.append)  # asked for by name, and said
    assert replaced.stages[0].reused
    assert shorter.path.read_bytes() != before
    assert sum(line.startswith("color.ply: replaced") for line in lines) == 1
    assert fit_color(scene, tmp_path, dataclasses.replace(quick, field=quick.field.with_steps(20))).stages[0].reused
    assert shorter.path.read_bytes() == before


def test_a_color_ply_of_another_hand_is_never_replaced(scene, maps, tmp_path):
    config = dataclasses.replace(CONFIG.color, field=ColorConfig.quick().field.with_steps(3), picture_scale=0.5)
    path = tmp_path / "color.ply"

    def refused(steps=3):
        with pytest.raises(ValueError, match=tells(path, "found another file", "move it", "--out")):
            fit_color(scene, tmp_path, dataclasses.replace(config, field=config.field.with_steps(steps)))

    path.write_text("mine")
    refused()
    assert path.read_text() == "mine"
    assert not list(tmp_path.glob("stages/color-*"))  # refused before training
    lines = []
    fit_scene(scene, maps, tmp_path, dataclasses.replace(CONFIG, color=config), report=lines.append)
    assert [line.split(";")[1] for line in lines if line.startswith("color.ply: left")] == [" it is another file"]
    path.unlink()
    path.symlink_to(tmp_path / "nowhere.ply")
    refused(4)
    refused()  # the stage is finished, but its Gaussians cannot be written
    lines.clear()
    fit_scene(scene, maps, tmp_path, dataclasses.replace(CONFIG, color=config, seed=0), report=lines.append)
    assert any("is a link to a file that does not exist" in line for line in lines)
    assert path.is_symlink()
    path.unlink()

    made = fit_color(scene, tmp_path, config)
    labels = torch.zeros(len(made.gaussians), dtype=torch.int64)
    write_splats(made.gaussians.replace(labels=labels), path)  # as `kfgs attach --out run/color.ply` does
    labelled = path.read_bytes()
    assert fit_color(scene, tmp_path, config).stages[-1].reused
    refused(4)
    assert path.read_bytes() == labelled
    assert [one.name for one in tmp_path.glob(".*")] == [LOCK]


def test_the_paper_takes_no_splat(scene, maps, splat, tmp_path):
    with pytest.raises(ValueError, match=tells("splat:", "'paper'")):
        fit_scene(scene, maps, tmp_path, FitConfig.paper(), splat=splat)
    with pytest.raises(ValueError, match=tells("method:", "'fuse', 'paper'", "got 'magic'")):
        FitConfig(method="magic")
    assert list(tmp_path.iterdir()) == []


def test_a_field_remembers_classes_and_cameras(fitted, scene, classes):
    loaded = SemanticField.load(fitted.field_path)
    assert loaded.classes.names == classes.names
    assert [camera.name for camera in loaded.cameras] == [scene.cameras[i].name for i in scene.views("train")]
    camera = scene.cameras[scene.views("test")[0]]
    assert torch.equal(loaded.segment(camera), fitted.field.segment(camera, classes))
    assert torch.equal(loaded.query("chair").mask, fitted.field.query("chair", classes).mask)


def test_uplift_keeps_every_gaussian_and_is_a_field_like_any_other(scene, maps, splat, classes, tmp_path):
    found = kfgs.uplift(scene, maps, splat, folder=tmp_path / "field.kfgs")
    assert len(found) == len(splat)
    assert torch.equal(found.gaussians.means, splat.means)
    assert found.seen is not None
    shown = found.seen.pixels > 0
    assert 0.5 < shown.float().mean() <= 1
    assert torch.equal(found.known, shown)
    assert (found.classify(classes).labels[~shown] == -1).all()
    assert float(found.seen.agreement.max()) <= 1
    found.save(tmp_path / "field.kfgs")
    assert torch.equal(SemanticField.load(tmp_path / "field.kfgs").classify().labels, found.classify(classes).labels)
    twice = uplift(scene, maps, found)  # a field's Gaussians will do
    assert torch.equal(twice.features, found.features)


@pytest.mark.parametrize("name", ["chair", "floor", "plant"])
def test_python_command_line_and_explorer_select_the_same_gaussians(name, fitted, classes, tmp_path, capsys):
    field = SemanticField.load(fitted.field_path)
    python = field.query(name, classes)
    assert len(python) > 0
    assert torch.equal(field.query(name).mask, python.mask)
    assert torch.equal(field.classify(classes).labels == classes.index(name), python.mask)
    assert main(["select", name, str(fitted.field_path), "--out", str(tmp_path)]) == 0
    assert f"{name}: {len(python)} of {len(field)} Gaussians" in capsys.readouterr().out
    chosen = read_splats(tmp_path / "selection.ply").means
    assert torch.equal(chosen, field.gaussians.means[python.mask])
    assert main(["label", str(fitted.field_path), "--out", str(tmp_path / "l"), "--query", name]) == 0
    labels = read_splats(tmp_path / "l" / "gaussians.ply").labels
    assert torch.equal(labels == classes.index(name), python.mask)
    with explore(field, where="picture") as view:
        view.ask(name)
        assert np.array_equal(view.state.selected("semantic"), python.mask.numpy())


def test_the_command_line_needs_the_field_alone(fitted, splat, scene, tmp_path, capsys):
    write_splats(splat, tmp_path / "splat.ply")
    field = str(fitted.field_path)
    assert main(["attach", field, str(tmp_path / "splat.ply"), "--out", str(tmp_path / "labelled.ply")]) == 0
    assert f"votes of {len(scene.views('train'))} segmented views" in capsys.readouterr().out
    assert main(["segment", field, "--out", str(tmp_path / "seg"), "--pictures", "0"]) == 0
    assert "mIoU" in capsys.readouterr().out


def test_a_field_that_is_saved_elsewhere_still_finds_its_classes(fitted, classes, tmp_path):
    SemanticField.load(fitted.field_path).save(tmp_path / "deep" / "er" / "field.kfgs")
    assert SemanticField.load(tmp_path / "deep" / "er" / "field.kfgs").classes.names == classes.names


def test_a_moved_scene_is_told(fitted, room, tmp_path, capsys):
    shutil.copytree(fitted.folder, tmp_path / "elsewhere" / "run")
    assert main(["select", "chair", str(tmp_path / "elsewhere" / "run" / "field.kfgs")]) == 1
    assert "where this field's classes were; pass the classes" in capsys.readouterr().err
    arguments = ["select", "chair", str(tmp_path / "elsewhere" / "run" / "field.kfgs"), "--scene", str(room)]
    assert main(arguments) == 0


def test_fit_and_uplift_from_the_command_line(room, splat, scene, tmp_path, capsys):
    write_splats(splat, tmp_path / "splat.ply")
    features = tmp_path / "features"
    shutil.copytree(room / "features", features)
    arguments = ["fit", str(room), "--features", str(features), "--out", str(tmp_path / "run")]
    assert main([*arguments, "--splat", str(tmp_path / "splat.ply"), "--max-gaussians", "900"]) == 0
    said = capsys.readouterr().out
    assert "semantic field (fused)" in said
    assert len(SemanticField.load(tmp_path / "run" / "field.kfgs")) <= 900
    arguments = ["uplift", str(room), str(tmp_path / "splat.ply"), "--features", str(features)]
    assert main([*arguments, "--out", str(tmp_path / "up")]) == 0
    assert len(SemanticField.load(tmp_path / "up")) == len(splat)
    assert main(["info", str(tmp_path / "up")]) == 0
    assert "semantic field (fused)" in capsys.readouterr().out


def test_classes_by_examples_answer_like_the_words(fitted, scene, room, classes, tmp_path, capsys):
    """Clicks on five pixels of floor, wall and table, read off the label pictures, find mostly what the words find."""
    field, shown, names = SemanticField.load(fitted.field_path), {}, ("floor", "wall", "table")
    truth = true_labels(scene, room / "labels", "train")
    for name in names:
        view, labels = max(truth.items(), key=lambda pair: int((pair[1] == classes.index(name)).sum()))
        places = (labels == classes.index(name)).nonzero()
        places = places[torch.linspace(0, len(places) - 1, 7).long()[1:-1]]
        shown[name] = [{"view": view, "points": [[float(x) + 0.5, float(y) + 0.5] for y, x in places.tolist()]}]
    (tmp_path / "examples.json").write_text(json.dumps(shown))
    table = tmp_path / "table.safetensors"
    arguments = ["text", "--examples", str(tmp_path / "examples.json"), "--field", str(fitted.field_path)]
    assert main([*arguments, "--out", str(table)]) == 0
    assert "3 classes, 32 channels each, by examples: floor, wall, table" in capsys.readouterr().out
    made = load_label_set(table)
    words = field.classify(classes.select(names)).labels
    assert (field.classify(made).labels == words).float().mean() > 0.85
    given = {name: Clicks(one[0]["view"], one[0]["points"]) for name, one in shown.items()}
    assert torch.equal(kfgs.label_set_from_examples(field, given).embeddings, made.embeddings)


def test_maps_may_be_a_list_in_memory(scene, maps, splat, tmp_path):
    given = [maps[i] for i in range(len(maps))]
    made = fit_scene(scene, given, tmp_path, CONFIG, splat=splat)
    stored = fit_scene(scene, maps, tmp_path / "stored", CONFIG, splat=splat)
    assert torch.equal(made.field.features, stored.field.features)
    again = fit_scene(scene, [one.numpy() for one in given], tmp_path, CONFIG, splat=splat)
    assert all(stage.reused for stage in again.stages)
    other = fit_scene(scene, [given[0] * 2, *given[1:]], tmp_path, CONFIG, splat=splat)
    assert not any(stage.reused for stage in other.stages)
    with pytest.raises(TypeError, match=tells("maps", "str", "FeatureFolder")):
        fit_scene(scene, "features", tmp_path, CONFIG, splat=splat)
    with pytest.raises(TypeError, match=tells("maps[0]", "str")):
        fit_scene(scene, ["a.npy"], tmp_path, CONFIG, splat=splat)
