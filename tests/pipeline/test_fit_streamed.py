"""Fits of maps that were discarded, or are computed again each time, against the fit of the same maps on disk."""

import dataclasses

import pytest
import torch
from messages import tells
from small_room import CONFIG, config, make_room

from kfgs.cameras import Distortion
from kfgs.features import FeatureFolder, RecomputedMaps, discard_maps, extract_features, pictures_of
from kfgs.pipeline import Run, fit_scene
from kfgs.pipeline.maps import map_digests, map_shape, maps_of_views
from kfgs.quant import sample_grid
from kfgs.scenes import load_scene

QUICK = config(field=dataclasses.replace(CONFIG.field, steps=3))
LENS = Distortion("brown_conrady", (0.3, 0.05, 0.001, -0.002))


class Mixer:
    name = "mixer"
    identity = {"name": "mixer", "weights": "w1"}  # noqa: RUF012

    def __init__(self, dies_at=None):
        self.matrix = torch.randn(16, 3, generator=torch.Generator().manual_seed(0))
        self.calls, self.dies_at = 0, dies_at

    def encode_image(self, image):
        self.calls += 1
        if self.calls == self.dies_at:
            raise KeyboardInterrupt
        return torch.tanh(3 * torch.einsum("dc,chw->dhw", self.matrix, torch.nn.functional.avg_pool2d(image - 0.5, 4)))

    def encode_text(self, prompts):
        raise NotImplementedError


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(make_room(tmp_path_factory.mktemp("room") / "scene"))


@pytest.fixture(scope="module")
def maps_folder(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    extract_features(Mixer(), pictures_of(scene, scene.views("train")), folder)
    return folder


def read(folder, scene):
    return FeatureFolder(folder, [scene.stem(i) for i in scene.views("train")])


@pytest.fixture(scope="module")
def fitted(scene, maps_folder, tmp_path_factory):
    return fit_scene(scene, read(maps_folder, scene), tmp_path_factory.mktemp("run"), QUICK)


def same(a, b) -> bool:
    names = ("means", "quats", "scales", "opacities", "features")
    return all(torch.equal(getattr(a.gaussians, name), getattr(b.gaussians, name)) for name in names)


def test_the_manifests_digests_are_those_of_the_files(scene, maps_folder, tmp_path):
    run, maps = Run(tmp_path), read(maps_folder, scene)
    assert map_digests(run, maps) == run.digests(maps.files) == maps.digests()
    (maps_folder / "features.json").rename(tmp_path / "features.json")
    assert maps_folder.joinpath("features.json").exists() is False
    without = read(maps_folder, scene)
    assert without.digests() is None
    assert map_digests(run, without) == run.digests(maps.files)
    (tmp_path / "features.json").rename(maps_folder / "features.json")


def test_once_index_maps_are_made_discarded_maps_serve_every_later_field(scene, tmp_path):
    folder = tmp_path / "maps"
    pictures = pictures_of(scene, scene.views("train"))
    extract_features(Mixer(), pictures, folder)
    first = fit_scene(scene, read(folder, scene), tmp_path / "run", QUICK)
    discard_maps(folder)
    maps = read(folder, scene)
    again = fit_scene(scene, maps, tmp_path / "run", QUICK)
    assert all(stage.reused for stage in again.stages)
    assert same(first.field, again.field)
    assert again.field.info["teacher_map"] == [15, 20, 16]
    smaller = dataclasses.replace(QUICK, autoencoder=dataclasses.replace(QUICK.autoencoder, latent=3))
    other = fit_scene(scene, maps, tmp_path / "run", smaller)
    assert [stage.reused for stage in other.stages] == [True, True, False, False, False]
    with pytest.raises(FileNotFoundError, match=tells("maps:", "'decouple'", "got 6 of 6", "kfgs features")):
        fit_scene(scene, maps, tmp_path / "run", dataclasses.replace(QUICK, mode="decouple"))
    before = sorted((tmp_path / "run" / "stages").iterdir())
    with pytest.raises(FileNotFoundError, match=tells("maps:", "codebook", "got 6 of 6")):
        fit_scene(scene, maps, tmp_path / "run", dataclasses.replace(QUICK, seed=5))
    assert sorted((tmp_path / "run" / "stages").iterdir()) == before
    extract_features(Mixer(), pictures, folder)
    fresh = fit_scene(scene, read(folder, scene), tmp_path / "run", QUICK)
    assert all(stage.reused for stage in fresh.stages)


def test_maps_made_anew_give_the_same_field_and_run_the_teacher_twice(scene, fitted, tmp_path):
    teacher = Mixer()
    maps = RecomputedMaps(teacher, scene, scene.views("train"), tmp_path / "store")
    result = fit_scene(scene, maps, tmp_path / "run", QUICK)
    assert same(result.field, fitted.field)
    assert torch.equal(result.field.codebook.codewords, fitted.field.codebook.codewords)
    assert teacher.calls == 12
    maps.clear()
    idle = Mixer()
    again = fit_scene(
        scene, RecomputedMaps(idle, scene, scene.views("train"), tmp_path / "store"), tmp_path / "run", QUICK
    )
    assert all(stage.reused for stage in again.stages)
    assert idle.calls == 0
    with pytest.raises(ValueError, match=tells("maps:", "stored", "'decouple'", "teacher")):
        fit_scene(scene, maps, tmp_path / "run", dataclasses.replace(QUICK, mode="decouple"))


@pytest.mark.parametrize(("dies_at", "left"), [(4, 3 + 6), (9, 4)])  # among the samples; among the index maps
def test_killed_in_between_it_runs_the_teacher_only_for_what_is_left(dies_at, left, scene, fitted, tmp_path):
    views = scene.views("train")
    with pytest.raises(KeyboardInterrupt):
        fit_scene(scene, RecomputedMaps(Mixer(dies_at), scene, views, tmp_path / "store"), tmp_path / "run", QUICK)
    teacher = Mixer()
    resumed = fit_scene(scene, RecomputedMaps(teacher, scene, views, tmp_path / "store"), tmp_path / "run", QUICK)
    assert teacher.calls == left
    assert same(resumed.field, fitted.field)
    assert not list((tmp_path / "run" / "unfinished").glob("*"))


def test_through_a_lens_samples_are_kept_and_the_field_is_that_of_stored_maps(scene, maps_folder, tmp_path):
    cameras = [dataclasses.replace(c, distortion=LENS if i % 2 else None) for i, c in enumerate(scene.cameras)]
    bent = dataclasses.replace(scene, cameras=cameras).undistorted()
    views = bent.views("train")
    stored = fit_scene(bent, read(maps_folder, bent), tmp_path / "stored", QUICK)
    teacher = Mixer()
    again = fit_scene(bent, RecomputedMaps(teacher, bent, views, tmp_path / "store"), tmp_path / "again", QUICK)
    assert teacher.calls == 12
    assert same(stored.field, again.field)


class _Plain(list):
    files = ()


class _Grid(_Plain):
    shape = (6, 8, 3)

    def grid(self, i, step, samples):
        return torch.full((1, 3), float(i))

    def digests(self):
        return [["a", "1"]]


def test_a_lens_passes_on_what_the_maps_offer_where_it_may(scene):
    features = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0)) + 0.5
    views = scene.select([0, 1])
    views = dataclasses.replace(
        views, lenses=[views.cameras[0], dataclasses.replace(views.cameras[1], distortion=LENS)]
    )
    offered = maps_of_views(views, [0, 1], _Grid([features, features]))
    assert (offered.shape, offered.digests()) == ((6, 8, 3), [["a", "1"]])
    assert offered.grid(0, None, 10).tolist() == [[0.0, 0.0, 0.0]]
    assert torch.equal(offered.grid(1, (2, 3)), sample_grid(offered[1], (2, 3)))
    assert not torch.equal(offered[1], features)
    bare = maps_of_views(views, [0], _Plain([features]))
    assert (bare.shape, bare.digests(), map_shape(bare)) == ((6, 8, 3), None, (6, 8, 3))
    assert torch.equal(bare.grid(0, None, 12), sample_grid(features, samples=12))
