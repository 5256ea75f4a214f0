import dataclasses
import json

import numpy as np
import pytest
import torch
from messages import tells
from safetensors.torch import save_file
from small_room import CONFIG, config, make_room

from kfgs.cameras import Distortion
from kfgs.fields import SemanticField
from kfgs.labels import load_label_set
from kfgs.pipeline import fit_scene, score_scene, score_teacher, segment_scene, true_labels
from kfgs.pipeline.fit import load_history
from kfgs.scenes import FeatureFolder, load_scene, save_feature_map


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("room") / "scene")


@pytest.fixture(scope="module")
def scene(room):
    return load_scene(room)


@pytest.fixture(scope="module")
def maps(room, scene):
    return FeatureFolder(room / "features", [scene.stem(i) for i in scene.splits["train"]])


@pytest.fixture(scope="module")
def fitted(scene, maps, tmp_path_factory):
    return fit_scene(scene, maps, tmp_path_factory.mktemp("run"), CONFIG)


def _same(a: SemanticField, b: SemanticField) -> bool:
    names = ("means", "quats", "scales", "opacities", "features")
    return all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in names)


def test_the_run_folder_holds_every_stage_and_the_field(fitted):
    names = [stage.name for stage in fitted.stages]
    assert names == ["codebook", "index_maps", "autoencoder", "field", "answers"]
    assert not any(stage.reused for stage in fitted.stages)
    assert not list((fitted.folder / "unfinished").glob("*"))
    loaded = SemanticField.load(fitted.field_path)
    assert _same(loaded, fitted.field)
    assert loaded.info["mode"] == "adc+sc"
    assert loaded.features.shape[1] == 4
    losses = [row["loss"] for row in load_history(fitted.stages[3])]
    assert losses[-1] < 0.7 * losses[0]


def test_a_second_run_redoes_nothing_and_gives_the_same(fitted, scene, maps):
    lines: list[str] = []
    again = fit_scene(scene, maps, fitted.folder, CONFIG, report=lines.append)
    assert all(stage.reused for stage in again.stages)
    assert _same(again.field, fitted.field)
    assert again.seconds == fitted.seconds
    assert len(lines) == 5
    assert all("found in" in line for line in lines)


@pytest.mark.parametrize("when", [1, 2, 5])
def test_killed_in_the_middle_of_the_field_it_goes_on_and_ends_the_same(when, fitted, scene, maps, tmp_path):
    seen = 0

    def kill(row):
        nonlocal seen
        if "count" in row:  # a row of the field's history
            seen += 1
            if seen == when:
                raise KeyboardInterrupt

    settings = config(field=dataclasses.replace(CONFIG.field, report_every=12))
    with pytest.raises(KeyboardInterrupt):
        fit_scene(scene, maps, tmp_path, settings, progress=kill)
    assert not (tmp_path / "field.kfgs").exists()
    resumed = fit_scene(scene, maps, tmp_path, settings)
    assert [stage.reused for stage in resumed.stages] == [True, True, True, False, False]
    # report_every is part of the configuration, but not of what is learnt
    assert _same(resumed.field, fitted.field)
    assert resumed.stages[3].seconds >= load_history(resumed.stages[3])[-1]["seconds"]  # both processes' time


def test_killed_in_the_codebook_it_starts_that_stage_again(fitted, scene, maps, tmp_path):
    def kill(row):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_scene(scene, maps, tmp_path, CONFIG, progress=kill)
    assert list((tmp_path / "stages").iterdir()) == []
    assert _same(fit_scene(scene, maps, tmp_path, CONFIG).field, fitted.field)


@pytest.mark.parametrize(("mode", "channels"), [("adc", 32), ("decouple", 32)])
def test_the_other_rows_of_table_1_run(mode, channels, scene, maps, fitted, room):
    result = fit_scene(scene, maps, fitted.folder, config(mode=mode))  # shares the codebook with the first
    assert result.field.features.shape[1] == channels
    assert hasattr(result.field.decoder, "codebook") == (mode != "decouple")
    if mode == "adc":
        assert [stage.reused for stage in result.stages] == [True, True, False, False]
    classes = load_label_set(room / "classes.json", room / "text.npy")
    labels = result.field.segment(scene.cameras[scene.splits["test"][0]], classes.embeddings)
    assert labels.shape == (60, 80)
    assert len(labels.unique()) > 2


def test_what_else_lies_in_the_field_folder_outlasts_a_second_run(fitted, scene, maps):
    fit_scene(scene, maps, fitted.folder, CONFIG)  # other tests fit other fields into this folder
    (fitted.field_path / "mine").mkdir()
    fit_scene(scene, maps, fitted.folder, CONFIG)
    assert (fitted.field_path / "mine").is_dir()


def test_another_extent_is_another_field(fitted, scene, maps):
    fewer = dataclasses.replace(scene, splits=scene.splits | {"all": scene.splits["train"], "train": [0, 1]})
    assert fewer.extent != scene.extent
    again = fit_scene(fewer, maps, fitted.folder, config(split="all"))
    assert not again.stages[-1].reused


def test_an_extent_of_the_config_decides_the_field_as_the_scenes_does(fitted, scene, maps):
    stated = dataclasses.replace(CONFIG.field, extent=scene.extent)
    assert fit_scene(scene, maps, fitted.folder, config(field=stated)).stages[-1].reused
    larger = dataclasses.replace(CONFIG.field, extent=2 * scene.extent)
    again = fit_scene(scene, maps, fitted.folder, config(field=larger))
    assert not again.stages[-1].reused
    assert not _same(again.field, fitted.field)


def test_other_options_make_other_stages(fitted, scene, maps):
    changed = fit_scene(scene, maps, fitted.folder, config(seed=1))
    assert not any(stage.reused for stage in changed.stages if stage.name != "index_maps")
    assert not _same(changed.field, fitted.field)


def test_changed_features_are_noticed(room, scene, tmp_path):
    stems = [scene.stem(i) for i in scene.splits["train"]]
    copy = tmp_path / "features"
    source = FeatureFolder(room / "features", stems)
    for i, stem in enumerate(stems):
        save_feature_map(copy, stem, source[i])
    quick = config(field=dataclasses.replace(CONFIG.field, steps=2))
    first = fit_scene(scene, FeatureFolder(copy, stems), tmp_path / "run", quick)
    save_feature_map(copy, stems[2], source[2].flip(0) * 1.01)
    second = fit_scene(scene, FeatureFolder(copy, stems), tmp_path / "run", quick)
    assert first.stages[0].key != second.stages[0].key
    assert not second.stages[0].reused


def test_unseen_views_are_segmented_scored_and_drawn(fitted, scene, room, tmp_path):
    classes = load_label_set(room / "classes.json", room / "text.npy")
    labels = segment_scene(fitted.field, scene, classes, tmp_path, pictures=2)
    scores = score_scene(labels, true_labels(scene, room / "labels", "test"), classes)
    assert scores.views == 3
    assert scores.accuracy.value > 0.5  # sixty steps on a postage stamp; chance is below 0.1
    assert len(list((tmp_path / "predicted").iterdir())) == 3
    assert len(list((tmp_path / "overlay").iterdir())) == 2
    assert len(list((tmp_path / "features").iterdir())) == 2
    assert json.dumps(scores.to_json())


def test_pictures_that_give_no_points_are_refused(scene, maps, tmp_path):
    nothing = dataclasses.replace(scene, points=scene.points[:0], colors=scene.colors[:0])
    with pytest.raises(ValueError, match=tells("scene:", "agree with the poses", "--ignore-poses")):
        fit_scene(nothing, maps, tmp_path, CONFIG)
    assert not (tmp_path / "field.kfgs").exists()


def test_bad_input_is_refused_before_any_work(scene, room, tmp_path):
    two = FeatureFolder(room / "features", [scene.stem(0), scene.stem(1)])
    with pytest.raises(ValueError, match=tells("maps:", "'train'", "(6)", "got 2")):
        fit_scene(scene, two, tmp_path, CONFIG)
    with pytest.raises(ValueError, match=tells("mode:", "'decouple', 'adc', 'adc+sc'", "got 'all'")):
        config(mode="all")
    backwards = FeatureFolder(room / "features", [scene.stem(i) for i in reversed(scene.splits["train"])])
    with pytest.raises(ValueError, match=tells("maps:", "order (view_")):
        fit_scene(scene, backwards, tmp_path, CONFIG)
    with pytest.raises(ValueError, match=tells("split:", "train, test", "got 'val'")):
        fit_scene(scene, two, tmp_path, config(split="val"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["npy", "pt", "safetensors"])
def test_a_map_that_is_cut_short_is_found_before_any_work(kind, scene, maps, tmp_path):
    (tmp_path / "maps").mkdir()
    stems = [scene.stem(i) for i in scene.splits["train"]]
    for stem, features in zip(stems, maps, strict=True):
        if kind == "pt":
            save_feature_map(tmp_path / "maps", stem, features)
        elif kind == "npy":
            np.save(tmp_path / "maps" / f"{stem}.npy", features.half().numpy())
        else:
            save_file({"map": features.half()}, tmp_path / "maps" / f"{stem}.safetensors")
    damaged = sorted((tmp_path / "maps").iterdir())[2:4]
    for file in damaged:
        file.write_bytes(file.read_bytes()[:-1000])
    whole = FeatureFolder(tmp_path / "maps").of(scene, "train")
    told = tells(damaged[0].name, "encode it again, or leave the photo out (split.json)", "1 more", "--check")
    with pytest.raises(ValueError, match=told):
        fit_scene(scene, whole, tmp_path / "run", CONFIG)
    assert not (tmp_path / "run").exists()


def test_truth_is_undistorted_as_the_views_are(scene, room):
    lens = Distortion("brown_conrady", (0.3, 0.0, 0.0, 0.0))
    bent = dataclasses.replace(scene, cameras=[dataclasses.replace(c, distortion=lens) for c in scene.cameras])
    plain, straight = (true_labels(s, room / "labels", "test") for s in (scene, bent.undistorted()))
    for stem, labels in plain.items():
        assert (labels >= 0).all()
        assert (straight[stem] < 0).any()  # what the lens did not see
        assert (straight[stem] != labels)[straight[stem] >= 0].float().mean() > 0.02
        assert straight[stem][30, 40] == labels[30, 40] or straight[stem][31, 43] == labels[31, 43]  # the axis stays


def test_the_teacher_is_wrong_where_it_knows_nothing(scene, room, maps):
    classes = load_label_set(room / "classes.json", room / "text.npy")
    truth = true_labels(scene, room / "labels", "test")
    nothing = score_teacher(lambda stem: torch.zeros(30, 40, 32), truth, classes, (60, 80))
    assert nothing.accuracy.value == 0
    with pytest.raises(ValueError, match=tells("embeddings:", "got (13, 32)")):
        score_teacher(lambda stem: torch.zeros(30, 40, 31), truth, classes, (60, 80))


def test_gaussians_that_no_view_showed_have_no_class(fitted, room):
    classes = load_label_set(room / "classes.json", room / "text.npy")

    def blank(field):
        features = field.features.clone()
        features[:5] = 0
        return dataclasses.replace(field, gaussians=field.gaussians.replace(features=features))

    answering = dataclasses.replace(blank(fitted.field), fused=blank(fitted.field.fused))
    for field in (answering, answering.paper):
        labels, scores = field.classify(classes)
        assert labels[:5].tolist() == [-1] * 5
        assert scores[:5].tolist() == [0.0] * 5
        assert (labels[5:] >= 0).any()
        assert not field.query("chair", classes, -1.0, negatives="none").mask[:5].any()
