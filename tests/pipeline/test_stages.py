from dataclasses import replace
from pathlib import Path

import pytest
import torch

from kfgs.cameras import Camera
from kfgs.pipeline.stages import Run, digest_scene
from kfgs.scenes import Scene


def _maker(calls: list[str], name: str):
    def make(folder):
        calls.append(name)
        (folder / "value").write_text(name)
        return 0.0

    return make


def test_a_finished_stage_is_found_again_by_another_process(tmp_path):
    calls: list[str] = []
    first = Run(tmp_path).stage("a", {"x": 1}, _maker(calls, "one"))
    again = Run(tmp_path).stage("a", {"x": 1}, _maker(calls, "two"))
    assert calls == ["one"]
    assert not first.reused
    assert again.reused
    assert again.key == first.key
    assert again.seconds == first.seconds
    assert (again.folder / "value").read_text() == "one"


def test_other_inputs_make_another_stage_and_keep_the_first(tmp_path):
    calls: list[str] = []
    run = Run(tmp_path)
    one = run.stage("a", {"x": 1}, _maker(calls, "one"))
    two = run.stage("a", {"x": 2}, _maker(calls, "two"))
    assert calls == ["one", "two"]
    assert one.key != two.key
    assert (one.folder / "value").read_text() == "one"


def test_a_killed_stage_leaves_nothing_and_is_made_again(tmp_path):
    def dies(folder):
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    run = Run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run.stage("a", {}, dies)
    assert list((tmp_path / "stages").iterdir()) == []
    calls: list[str] = []
    stage = run.stage("a", {}, _maker(calls, "whole"))
    assert sorted(path.name for path in stage.folder.iterdir()) == ["stage.json", "value"]


def test_digests_follow_content_and_order_and_tell_equal_names_apart(tmp_path):
    run = Run(tmp_path / "run")
    path, twin = tmp_path / "f.bin", tmp_path / "sub" / "f.bin"
    twin.parent.mkdir()
    path.write_bytes(b"one")
    twin.write_bytes(b"two")
    before = run.digests([path, twin])
    assert run.digests([path, twin]) == before
    assert run.digests([twin, path]) == before[::-1] != before
    path.write_bytes(b"two!")
    assert run.digests([path, twin])[0] != before[0]
    path.write_bytes(b"one")
    assert run.digests([path, twin]) == before


def test_reports_say_what_was_made_and_what_was_found(tmp_path):
    lines: list[str] = []
    Run(tmp_path, lines.append).stage("a", {}, lambda folder: None)
    Run(tmp_path, lines.append).stage("a", {}, lambda folder: None)
    assert [line.split(" in ")[0] for line in lines] == ["a: working", "a: done", "a: found"]


def a_scene() -> Scene:
    K = torch.tensor([[60.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    cameras = [Camera(torch.eye(4), K, 64, 48, name) for name in ("a.png", "b.png")]
    points = torch.tensor([[0.0, 0, 3], [0, 1, 5]])
    return Scene(cameras, [Path("a.png"), Path("b.png")], points, torch.zeros(2, 3, dtype=torch.uint8))


def with_camera(scene: Scene, **changes: object) -> Scene:
    return replace(scene, cameras=[scene.cameras[0], replace(scene.cameras[1], **changes)])


def test_a_scene_is_told_by_all_that_a_rendering_depends_on() -> None:
    scene = a_scene()
    moved = torch.eye(4)
    moved[0, 3] = 1e-6
    others = [
        with_camera(scene, viewmat=moved),
        with_camera(scene, K=scene.cameras[1].K + torch.diag(torch.tensor([1e-3, 0, 0]))),
        with_camera(scene, width=65),
        with_camera(scene, near=0.1),
        replace(scene, points=scene.points + 1),
    ]
    digests = [digest_scene(one, [0, 1]) for one in (scene, *others)]
    assert len({tuple(one.values()) for one in digests}) == 6
    assert digest_scene(others[3], [0]) == digest_scene(scene, [0])  # of these views alone
    assert digest_scene(with_camera(scene, name="c.png"), [0, 1]) == digests[0]


@pytest.mark.parametrize("text", ["[]", "{}", "{", "", "null", "[1]"])
def test_a_damaged_cache_of_digests_is_made_again(tmp_path, text):
    (tmp_path / "a.npy").write_text("a")
    whole = Run(tmp_path / "run").digests([tmp_path / "a.npy"])
    kept = (tmp_path / "run" / "digests.json").read_text()
    (tmp_path / "run" / "digests.json").write_text(text)
    assert Run(tmp_path / "run").digests([tmp_path / "a.npy"]) == whole
    assert (tmp_path / "run" / "digests.json").read_text() == kept
