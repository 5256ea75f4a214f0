"""Scenes that cannot be trained on are refused before the work."""

from pathlib import Path

import pytest
import torch
from messages import refused, tells

from kfgs.cameras import Camera
from kfgs.pipeline import fit_color
from kfgs.pipeline.stages import Run
from kfgs.pipeline.train import FEW_POINTS, check_scene
from kfgs.scenes import Scene


def scene_with(points: torch.Tensor) -> Scene:
    K = torch.tensor([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]])
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1]))  # looks back
    cameras = [Camera(E, K, 32, 24, f"{i}.png") for i, E in enumerate((torch.eye(4), turned))]
    paths = [Path(f"{i}.png") for i in range(2)]
    return Scene(cameras, paths, points, torch.zeros(len(points), 3, dtype=torch.uint8), {"train": [0], "test": [1]})


def test_points_out_of_sight_of_all_views_are_refused():
    behind = torch.tensor([[0.0, 0, -2], [0.1, 0, -3], [50.0, 0, 1]])
    refused(lambda: check_scene(scene_with(behind), [0], few=1), "got 3 out of sight of all 1 views", "one frame?")
    check_scene(scene_with(behind), [0, 1], few=1)  # the other view shows two of them
    check_scene(scene_with(torch.cat([behind, torch.tensor([[0.0, 0, 2]])])), [0], few=1)


def test_a_colour_field_of_points_out_of_sight_is_refused_before_training(tmp_path):
    with pytest.raises(ValueError, match=tells("out of sight")):
        fit_color(scene_with(torch.tensor([[0.0, 0, -2], [0.1, 0, -3]]).repeat(FEW_POINTS, 1)), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("count", "got"), [(1, "got 1 at one"), (9, "got 9 at one")])
def test_a_scene_without_different_points_is_refused_before_the_work(count, got):
    points = torch.ones(count, 3)
    with pytest.raises(ValueError, match=tells("scene:", got, "run_sfm")):
        check_scene(Scene([], [], points, torch.zeros(count, 3, dtype=torch.uint8)), [], few=1)


def test_a_finished_stage_is_found_again_by_its_name_and_inputs(tmp_path):
    lines = []

    def made(text, inputs):
        return Run(tmp_path, lines.append).stage("a", inputs, lambda folder: (folder / "value").write_text(text))

    first, other, again = made("one", {"x": 1}), made("two", {"x": 2}), made("three", {"x": 1})
    assert again == first
    assert other.key != first.key
    assert [(stage.folder / "value").read_text() for stage in (first, other)] == ["one", "two"]
    assert [line.split(" in ")[0] for line in lines] == ["a: working", "a: done"] * 2 + ["a: found"]


def test_a_killed_stage_leaves_nothing_and_is_made_again(tmp_path):
    def dies(folder):
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    run = Run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run.stage("a", {}, dies)
    assert list((tmp_path / "stages").iterdir()) == []
    stage = run.stage("a", {}, lambda folder: (folder / "value").write_text("whole"))
    assert sorted(path.name for path in stage.folder.iterdir()) == ["stage.json", "value"]


@pytest.mark.parametrize("text", ["[]", "{}", "{", "", "null", "[1]"])
def test_a_damaged_cache_of_digests_is_made_again(tmp_path, text):
    (tmp_path / "a.npy").write_text("a")
    whole = Run(tmp_path / "run").digests([tmp_path / "a.npy"])
    kept = (tmp_path / "run" / "digests.json").read_text()
    (tmp_path / "run" / "digests.json").write_text(text)
    assert Run(tmp_path / "run").digests([tmp_path / "a.npy"]) == whole
    assert (tmp_path / "run" / "digests.json").read_text() == kept
