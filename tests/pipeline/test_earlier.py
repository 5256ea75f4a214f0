"""New views of a scene that was fitted before: they are added to the earlier field."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from small_room import make_room

from kfgs.cli import main
from kfgs.features import FeatureFolder
from kfgs.fields import UpliftConfig
from kfgs.formats import write_splats
from kfgs.gaussians import Gaussians
from kfgs.pipeline import FitConfig, fit_scene
from kfgs.pipeline.color import ColorConfig
from kfgs.scenes import load_scene

CONFIG = FitConfig(uplift=UpliftConfig.field(max_gaussians=500))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_room(tmp_path_factory.mktemp("earlier") / "scene")


@pytest.fixture(scope="module")
def scene(room):
    return load_scene(room)


def fewer(scene, count, *, first=0):
    """The scene with some of its training views; the others are interleaved with them."""
    views = scene.views("train")
    order = sorted(range(len(views)), key=lambda i: (i % 3 == first, i))
    return dataclasses.replace(scene, splits={**scene.splits, "train": sorted(views[i] for i in order[:count])})


def maps_of(room, scene):
    return FeatureFolder(room / "features", [scene.stem(i) for i in scene.views("train")])


@pytest.fixture(scope="module")
def splat(room):
    with np.load(room / "surface.npz") as surface:
        points = torch.from_numpy(surface["points"]).float()[::4]
    n = len(points)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(points, quats, torch.full((n, 3), 0.1), torch.full((n,), 0.9), sh=torch.zeros(n, 1, 3))


def fit(room, scene, folder, splat, config=CONFIG, lines=None):
    report = None if lines is None else lines.append
    return fit_scene(scene, maps_of(room, scene), folder, config, splat=splat, report=report)


def test_new_views_are_added_and_the_run_says_so(room, scene, splat, tmp_path):
    total = len(scene.views("train"))
    old = fit(room, fewer(scene, total - 2), tmp_path, splat)
    before = old.stages[-1]
    lines = []
    more = fit(room, scene, tmp_path, splat, lines=lines)
    assert f"uplift: goes on from the {total - 2} views of {before.folder.name}; 2 new" in lines
    assert more.field.info["goes_on"] == before.folder.name
    assert (more.field.info["views_before"], more.field.info["views_new"]) == (total - 2, 2)
    assert json.loads((more.stages[-1].folder / "stage.json").read_text())["inputs"]["onto"] == before.key
    assert len(more.field.cameras) == total
    again = fit(room, scene, tmp_path, splat)
    assert again.stages[-1].reused
    assert again.stages[-1].key == more.stages[-1].key

    whole = fit(room, scene, tmp_path, splat, dataclasses.replace(CONFIG, refit=True))
    assert "goes_on" not in whole.field.info
    assert whole.stages[-1].key != more.stages[-1].key
    elsewhere = fit(room, scene, tmp_path / "elsewhere", splat)
    assert elsewhere.stages[-1].key == whole.stages[-1].key
    found = fit(room, scene, tmp_path, splat)  # the better one, once it is there
    assert found.stages[-1].key == whole.stages[-1].key
    off = (more.field.seen.pixels.sum() - whole.field.seen.pixels.sum()).abs() / whole.field.seen.pixels.sum()
    assert float(off) < 0.01


def test_only_maps_of_new_views_are_needed(room, scene, splat, tmp_path):
    features = shutil.copytree(room / "features", tmp_path / "maps")
    part = fewer(scene, len(scene.views("train")) - 1)
    stems = [part.stem(i) for i in part.views("train")]
    fit_scene(part, FeatureFolder(features, stems), tmp_path / "run", CONFIG, splat=splat)
    all_maps = FeatureFolder(features, [scene.stem(i) for i in scene.views("train")])

    class Guarded:
        files, shape = all_maps.files, all_maps.shape

        def __len__(self):
            return len(all_maps)

        def __getitem__(self, i):
            assert scene.stem(scene.views("train")[i]) not in stems
            return all_maps[i]

    made = fit_scene(scene, Guarded(), tmp_path / "run", CONFIG, splat=splat)
    assert made.field.info["views_new"] == 1


def test_an_interrupted_addition_leaves_whole_stages_and_goes_on(room, scene, splat, tmp_path):
    part, stored = fewer(scene, len(scene.views("train")) - 2), maps_of(room, scene)
    fit(room, part, tmp_path / "run", splat)
    before = sorted(path.name for path in (tmp_path / "run" / "stages").iterdir())
    shutil.copytree(tmp_path / "run", tmp_path / "whole")

    class Stopped:
        files, shape, read = stored.files, stored.shape, []

        def __len__(self):
            return len(stored)

        def __getitem__(self, i):
            self.read.append(i)
            if len(self.read) == 4:  # two maps for the directions, and one for the means
                raise KeyboardInterrupt
            return stored[i]

    with pytest.raises(KeyboardInterrupt):
        fit_scene(scene, Stopped(), tmp_path / "run", CONFIG, splat=splat)
    assert sorted(path.name for path in (tmp_path / "run" / "stages").iterdir()) == before
    assert len([*(tmp_path / "run" / "unfinished").rglob("*.npz")]) == 1
    one, other = (fit(room, scene, tmp_path / name, splat) for name in ("run", "whole"))
    assert one.field.info["views_new"] == 2
    assert one.stages[-1].key == other.stages[-1].key
    assert torch.equal(one.field.features, other.field.features)


@pytest.mark.parametrize(
    "change", ["seed", "options", "splat", "pose", "map", "sums", "damaged", "description", "many"]
)
def test_another_fit_is_not_gone_on_from(room, scene, splat, tmp_path, change):
    total = len(scene.views("train"))
    part = fewer(scene, total // 2 - 1 if change == "many" else total - 1)
    config, cloud, now = CONFIG, splat, scene
    first = dataclasses.replace(CONFIG, discard_sums=change == "sums")
    made = fit(room, part, tmp_path / "run", splat, first).stages[-1].folder
    assert (made / "sums.safetensors").is_file() == (change != "sums")
    folder = room
    if change == "seed":
        config = dataclasses.replace(CONFIG, seed=1)
    elif change == "options":
        config = FitConfig(uplift=UpliftConfig.field(max_gaussians=400))
    elif change == "splat":
        cloud = splat.replace(means=splat.means + 1e-3)
    elif change == "pose":
        moved = list(scene.cameras)
        i = part.views("train")[0]
        viewmat = moved[i].viewmat.clone()
        viewmat[0, 3] = torch.nextafter(viewmat[0, 3], torch.tensor(9.0, dtype=viewmat.dtype))
        moved[i] = dataclasses.replace(moved[i], viewmat=viewmat)
        now = dataclasses.replace(scene, cameras=moved)
    elif change == "map":
        folder = tmp_path
        shutil.copytree(room / "features", tmp_path / "features")
        file = maps_of(tmp_path, part).files[0]
        data = torch.load(file)
        torch.save(data * 1.01, file)
    elif change == "damaged":
        with (made / "sums.safetensors").open("ab") as opened:
            opened.write(b"0")
    elif change == "description":
        (made / "stage.json").write_text("{")
        color = tmp_path / "run" / "stages" / "color-0" / "stage.json"
        color.parent.mkdir()
        color.write_text("{")
    assert "goes_on" not in fit(folder, now, tmp_path / "run", cloud, config).field.info


def test_the_command_keeps_no_sums_if_told_and_refuses_options_without_effect(room, splat, tmp_path, capsys):
    write_splats(tmp_path / "splat.ply", splat)
    out = tmp_path / "run"
    arguments = ["fit", str(room), "--out", str(out), "--splat", str(tmp_path / "splat.ply")]
    assert main([*arguments, "--discard-sums"]) == 0
    assert list(out.glob("stages/uplift-*/uplift.safetensors"))
    assert not list(out.glob("stages/uplift-*/sums.safetensors"))
    capsys.readouterr()
    for option in ("--refit", "--discard-sums"):
        assert main(["fit", str(room), "--out", str(out), "--method", "paper", option]) != 0
        told = "".join(capsys.readouterr())
        assert option in told
        assert "--method paper" in told


def test_trained_gaussians_stay_until_a_refit(room, scene, tmp_path):
    color = dataclasses.replace(ColorConfig.quick(), field=ColorConfig.quick().field.with_steps(20), picture_scale=0.5)
    config = dataclasses.replace(CONFIG, color=color)
    part = fewer(scene, len(scene.views("train")) - 1)
    old = fit(room, part, tmp_path, None, config)
    lines = []
    more = fit(room, scene, tmp_path, None, config, lines)
    assert [stage.name for stage in more.stages] == ["uplift"]
    assert more.field.info["views_new"] == 1
    assert old.stages[0].folder.name in more.field.info["geometry"]
    assert any(line.startswith(f"geometry: {old.stages[0].folder.name}") for line in lines)
    fresh = fit(room, scene, tmp_path, None, dataclasses.replace(config, refit=True))
    assert [(stage.name, stage.reused) for stage in fresh.stages] == [("color", False), ("uplift", False)]
    found = fit(room, scene, tmp_path, None, config)
    assert [(stage.name, stage.reused) for stage in found.stages] == [("color", True), ("uplift", True)]
