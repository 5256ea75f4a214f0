"""A fit replaces the field of its run folder, and the report that showed it."""

import dataclasses
import os

import pytest
import torch
from killed import kill_everywhere
from messages import tells
from small_room import make_room

from kfgs.fields import SemanticField
from kfgs.gaussians import Gaussians
from kfgs.pipeline import FitConfig, fit_scene
from kfgs.pipeline.stages import LOCK, Run
from kfgs.scenes import FeatureFolder, load_scene

REPLACED = """
import numpy as np, torch
from kfgs.fields import Identity, SemanticField
from kfgs.gaussians import Gaussians
from kfgs.pipeline.fit import REPORT, TITLE, replace_field
from kfgs.viz import save_picture

def tiny_field(number):
    means = torch.arange(12.0).view(4, 3) + number
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(4, 1)
    cloud = Gaussians(means, quats, torch.full((4, 3), 0.5), torch.full((4,), 0.5), features=torch.eye(4))
    return SemanticField(cloud, Identity(4))

def prepare(folder):
    tiny_field(0).save(folder / "field.kfgs")
    (folder / "notes.txt").write_text("mine")
    (folder / REPORT).write_text(TITLE + "0")
    save_picture(folder / "preview.png", np.zeros((2, 2), np.uint8))
    (folder / "codebook.png").write_text("mine")

def work(folder):
    replace_field(folder, tiny_field(1))
"""


def test_at_every_kill_a_field_is_whole_and_its_report_its_own_or_gone(tmp_path):
    seen = set()
    for folder in kill_everywhere(REPLACED, tmp_path / "kills"):
        first = int(SemanticField.load(folder / "field.kfgs").gaussians.means[0, 0])
        seen.add((first, *(name for name in ("report.html", "preview.png") if (folder / name).exists())))
        assert (folder / "notes.txt").read_text() == "mine"
    assert seen == {(0, "report.html", "preview.png"), (0, "preview.png"), (0,), (1,)}


@pytest.fixture(scope="module")
def fuse(tmp_path_factory):
    scene = load_scene(make_room(tmp_path_factory.mktemp("room") / "scene"))
    maps = FeatureFolder(scene.folder / "features", [scene.stem(i) for i in scene.splits["train"]])
    return scene, maps, FitConfig.cpu(), tiny_splat(scene)


def tiny_splat(scene):
    points = scene.points[:: len(scene.points) // 50].float()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1)
    return Gaussians(points, quats, torch.full((len(points), 3), 0.3), torch.full((len(points),), 0.9))


def test_going_back_to_the_old_options_makes_no_stage_again(fuse, tmp_path):
    scene, maps, config, splat = fuse
    one = fit_scene(scene, maps, tmp_path, config, splat=splat)
    before = (tmp_path / "field.kfgs").read_bytes()
    fewer = dataclasses.replace(config, uplift=dataclasses.replace(config.uplift, max_gaussians=10))
    fit_scene(scene, maps, tmp_path, fewer, splat=splat)
    assert len(SemanticField.load(tmp_path / "field.kfgs")) == 10 < len(one.field)
    again = fit_scene(scene, maps, tmp_path, config, splat=splat)
    assert all(stage.reused for stage in again.stages)
    assert (tmp_path / "field.kfgs").read_bytes() == before


def test_a_damaged_field_is_replaced(fuse, tmp_path):
    scene, maps, config, splat = fuse
    fit_scene(scene, maps, tmp_path, config, splat=splat)
    for size in (1000, 100, 0):
        os.truncate(tmp_path / "field.kfgs", size)
        with pytest.raises(ValueError, match="fit the field again"):
            SemanticField.load(tmp_path / "field.kfgs")
        fit_scene(scene, maps, tmp_path, config, splat=splat)
        SemanticField.load(tmp_path / "field.kfgs")


def test_what_is_no_field_is_named_before_the_work(fuse, tmp_path):
    scene, maps, config, splat = fuse
    (tmp_path / "field.kfgs").mkdir()
    (tmp_path / "field.kfgs" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=tells(tmp_path / "field.kfgs", "something else")):
        fit_scene(scene, maps, tmp_path, config, splat=splat)
    assert not (tmp_path / "stages").exists()
    assert [path.name for path in (tmp_path / "field.kfgs").iterdir()] == ["notes.txt"]


def test_a_second_fit_in_the_folder_is_refused_and_destroys_nothing(fuse, tmp_path):
    scene, maps, config, splat = fuse
    seen = []

    class Second:
        """Maps that start another fit of the same folder when they are read."""

        path, files, stems, identity = maps.path, maps.files, maps.stems, None

        def __len__(self):
            return len(maps)

        def __getitem__(self, i):
            if not seen:
                with pytest.raises(
                    ValueError, match=tells(f"{tmp_path}: ", f"process {os.getpid()}", "wait")
                ) as caught:
                    fit_scene(scene, maps, tmp_path, config, splat=splat)
                seen.append(caught.value)
            return maps[i]

    fit_scene(scene, Second(), tmp_path, config, splat=splat)
    assert seen
    with Run(tmp_path).locked():  # free again
        assert f"process {os.getpid()} of " in (tmp_path / LOCK).read_text()
