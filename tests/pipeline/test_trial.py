"""Small runs: a line through two of them, the teacher's one picture, and what this machine has."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from small_room import make_room

from kfgs.features import FeatureFolder, pictures_of
from kfgs.pipeline import FitConfig
from kfgs.pipeline.stages import Stage
from kfgs.pipeline.trial import Timing, _time_twice, disk_free, few_views, memory_free, time_color, time_picture
from kfgs.scenes import load_scene
from kfgs.teachers import LSeg, LSegConfig, LSegOptions
from kfgs.teachers.lseg.network import LSegNetwork


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(make_room(tmp_path_factory.mktemp("trial") / "scene"))


def test_two_runs_give_a_line():
    calls = []

    def make(views, steps, folder, report):
        calls.append((views, steps))
        folder.mkdir()
        seconds = {"index_maps": 3 + 0.5 * views, "field": 0.1 + 0.25 * steps, "noise": 1.0}
        return [Stage(name, "", folder, time, False) for name, time in seconds.items()]

    found = _time_twice(make, 90, {"field"})
    assert calls == [(2, 2), (2, 2), (4, 16)]  # 16 steps of 0.3 s: five seconds
    assert found["index_maps"].seconds(90) == pytest.approx(3 + 45)
    assert found["field"].seconds(1_000) == pytest.approx(0.1 + 250)
    assert found["noise"].seconds(90) > 2  # a view never costs nothing
    only = _time_twice(make, 1, {"field"})
    assert only["index_maps"].seconds(1) == pytest.approx(3.5)
    assert Timing(1, 2).seconds(3) == 7


def test_reading_a_picture_is_counted_once_per_view_not_per_step(scene, monkeypatch):
    """Large photos took 1.3 s to read and 0.06 s a step: a plan of 13 minutes for a fit of 50 s."""

    class Colors:
        def __init__(self, few, folder, config, *, device, report):
            steps = config.field.steps
            seconds = 2 + 1.3 * min(len(few), steps) + 0.06 * steps
            self.stages = [Stage("color", "", folder, seconds, False)]

    monkeypatch.setattr("kfgs.pipeline.trial.fit_color", Colors)
    monkeypatch.setattr("kfgs.pipeline.trial._time_reading", lambda *_: 1.3)
    found = time_color(scene, FitConfig(), 100)["color"]
    assert found.each == pytest.approx(0.06)
    assert found.seconds(600) == pytest.approx(2 + 6 * 1.3 + 0.06 * 600)


def test_few_views_have_as_many_points_as_asked_for(scene):
    few = few_views(scene, "train", 2, 4_000)
    assert len(few) == len(few.views("train")) == 2
    assert few.points.shape == few.colors.shape == (4_000, 3)
    assert torch.allclose(few.points[:1_500].median(0).values, scene.points.median(0).values, atol=0.1)


def test_one_picture_gives_a_map_as_the_cache_would_write_it(scene, tmp_path):
    picture = pictures_of(scene, scene.views("train"))[0]
    found = time_picture(lambda image: image[:, ::4, ::4] + 0.1, picture, tmp_path / "maps")
    assert found.shape == FeatureFolder(tmp_path / "maps").shape == (15, 20, 3)
    assert found.seconds > 0
    assert found.peak is None or found.peak > 10**7


def test_lseg_looks_once_and_is_multiplied(scene, tmp_path):
    torch.manual_seed(0)
    network = LSegNetwork(LSegConfig(width=32, depth=5, heads=4, window=96, hooks=(0, 1, 2, 4)))
    runs = []
    network.register_forward_hook(lambda *_: runs.append(1))
    teacher = LSeg(network, LSegOptions(scales=(1.0, 2.0)))
    picture = pictures_of(scene, scene.views("train"))[0]
    found = time_picture(teacher, picture, tmp_path / "maps")
    assert len(runs) <= 2
    assert found.shape[:2] == teacher.options.map_size(60, 80, window=96)
    assert found.seconds > 0


def test_the_machine_is_looked_at(tmp_path):
    assert disk_free(tmp_path / "not" / "there") > 0
    assert memory_free() is None or memory_free() > 10**7


PEAKS = """
import torch
from kfgs.pipeline.trial import PeakMemory

torch.ones(75_000_000)  # 300 MB, an earlier peak
with PeakMemory() as nothing:
    pass
with PeakMemory() as much:
    torch.ones(50_000_000)  # 200 MB, gone at the end
print(nothing.bytes, much.bytes)
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux can forget an earlier peak")
def test_a_peak_is_of_its_block_alone():
    """In a process of its own: in one that has done much, memory that was freed before may serve again."""
    done = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True, check=True, timeout=600)
    nothing, much = map(int, done.stdout.split())
    assert 100e6 < much - nothing < 300e6
