import dataclasses
import json

import pytest
import torch
from small_room import CONFIG, config, make_room

from kfgs.evaluation import load_label_set
from kfgs.fields import SemanticField
from kfgs.pipeline import fit_scene, load_history, score_scene, segment_scene
from kfgs.scenes import load_scene
from kfgs.teachers import FeatureFolder, save_feature_map


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
    assert names == ["codebook", "index_maps", "autoencoder", "field"]
    assert not any(stage.reused for stage in fitted.stages)
    assert not list((fitted.folder / "unfinished").glob("*"))
    loaded = SemanticField.load(fitted.field_path)
    assert _same(loaded, fitted.field)
    assert loaded.info["mode"] == "adc+sc"
    assert loaded.features.shape[1] == 4
    losses = [row["loss"] for row in load_history(fitted.folder, "field")]
    assert losses[-1] < 0.7 * losses[0]


def test_a_second_run_redoes_nothing_and_gives_the_same(fitted, scene, maps):
    lines: list[str] = []
    again = fit_scene(scene, maps, fitted.folder, CONFIG, report=lines.append)
    assert all(stage.reused for stage in again.stages)
    assert _same(again.field, fitted.field)
    assert again.seconds == fitted.seconds
    assert len(lines) == 4
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
        fit_scene(scene, maps, tmp_path, settings, callback=kill)
    assert not (tmp_path / "field").exists()
    resumed = fit_scene(scene, maps, tmp_path, settings)
    assert [stage.reused for stage in resumed.stages] == [True, True, True, False]
    # report_every is part of the configuration, but not of what is learnt
    assert _same(resumed.field, fitted.field)


def test_killed_in_the_codebook_it_starts_that_stage_again(fitted, scene, maps, tmp_path):
    def kill(row):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_scene(scene, maps, tmp_path, CONFIG, callback=kill)
    assert list((tmp_path / "stages").iterdir()) == []
    assert _same(fit_scene(scene, maps, tmp_path, CONFIG).field, fitted.field)


@pytest.mark.parametrize(("mode", "channels"), [("adc", 32), ("decouple", 32)])
def test_the_other_rows_of_table_1_run(mode, channels, scene, maps, fitted, room):
    result = fit_scene(scene, maps, fitted.folder, config(mode=mode))  # shares the codebook with the first
    assert result.field.features.shape[1] == channels
    assert (result.field.codebook is None) == (mode == "decouple")
    assert result.field.autoencoder is None
    if mode == "adc":
        assert [stage.reused for stage in result.stages] == [True, True, False]
    classes = load_label_set(room / "classes.json", room / "text.npy")
    labels = result.field.segment(scene.cameras[scene.splits["test"][0]], classes.embeddings)
    assert labels.shape == (60, 80)
    assert len(labels.unique()) > 2


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
    labels = segment_scene(fitted.field, scene, classes, tmp_path, decode="latent", pictures=2)
    scores = score_scene(labels, room / "labels", classes)
    assert scores.views == 3
    assert scores.accuracy.value > 0.5  # sixty steps on a postage stamp; chance is below 0.1
    assert len(list((tmp_path / "labels").iterdir())) == 3
    assert len(list((tmp_path / "overlay").iterdir())) == 2
    assert len(list((tmp_path / "features").iterdir())) == 2
    assert json.dumps(scores.to_json())


def test_wrong_number_of_maps_is_refused(scene, room, tmp_path):
    two = FeatureFolder(room / "features", [scene.stem(0), scene.stem(1)])
    with pytest.raises(ValueError, match=r"one teacher map per view of split 'train' \(6\), got 2"):
        fit_scene(scene, two, tmp_path, CONFIG)
    with pytest.raises(ValueError, match="mode: expected one of 'decouple', 'adc', 'adc\\+sc', got 'all'"):
        config(mode="all")
    with pytest.raises(ValueError, match=r"split: expected one of train, test.*got 'val'"):
        fit_scene(scene, two, tmp_path, config(split="val"))
    assert list(tmp_path.iterdir()) == []
