"""The output folder of 3DGS, written here from its description: a scene and a splat at once."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_color import make_splat
from messages import tells
from small_room import make_room

from kfgs import load_scene, read_splats
from kfgs.cli import main
from kfgs.fields import SemanticField
from kfgs.formats import write_splats
from kfgs.formats.ply import write_ply
from kfgs.pipeline import fit
from kfgs.scenes import FeatureFolder, SceneError, is_scene
from kfgs.scenes.scene import Scene


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_room(tmp_path_factory.mktemp("inria") / "room")


def write_inria(folder: Path, scene: Scene, source: Path, *, tests: int = 0, ending: bool = False) -> Path:
    """What 3DGS writes beside its splat: test views first, names with or without their ending."""
    names = sorted(camera.name for camera in scene.cameras)
    listed = [*names[::4][:tests], *(name for name in names if name not in names[::4][:tests])]
    entries = []
    for number, name in enumerate(listed):
        camera = next(camera for camera in scene.cameras if camera.name == name)
        world = np.linalg.inv(camera.viewmat.double().numpy())
        entries.append(
            {
                "id": number,
                "img_name": name if ending else Path(name).stem,
                "width": camera.width,
                "height": camera.height,
                "position": world[:3, 3].tolist(),
                "rotation": world[:3, :3].tolist(),
                "fy": float(camera.K[1, 1]),
                "fx": float(camera.K[0, 0]),
            }
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.json").write_text(json.dumps(entries))
    values = f"data_device='cuda', eval={tests > 0}, images='images', model_path='./out', resolution=-1, sh_degree=3"
    (folder / "cfg_args").write_text(f"Namespace({values}, source_path={str(source)!r}, white_background=False)")
    points = {axis: np.array([0.0, 1.0, i], np.float32) for i, axis in enumerate("xyz")}
    points |= {name: np.array([10 * i, 20, 30], np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    write_ply(folder / "input.ply", points)
    return folder


def write_iterations(folder: Path, splat: Path) -> None:
    """The splat as iteration 30000, and its first five Gaussians as iteration 7000, which has the later name."""
    cloud = read_splats(splat)
    for step, kept in ((7000, cloud[:5]), (30000, cloud)):
        place = folder / f"point_cloud/iteration_{step}/point_cloud.ply"
        place.parent.mkdir(parents=True)
        write_splats(kept, place)


@pytest.fixture(scope="module")
def output(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_inria(tmp_path_factory.mktemp("output") / "out", load_scene(room), room, tests=2)
    write_iterations(folder, make_splat(room, folder / "labelled.ply"))
    return folder


def test_an_output_folder_is_a_scene(room: Path, output: Path) -> None:
    truth, scene = load_scene(room), load_scene(output)
    assert is_scene(output)
    assert [camera.name for camera in scene.cameras] == [camera.name for camera in truth.cameras]
    for found, true in zip(scene.cameras, truth.cameras, strict=True):
        torch.testing.assert_close(found.viewmat, true.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(found.K[:2, :2], true.K[:2, :2])
        assert found.K[:2, 2].tolist() == [true.width / 2, true.height / 2]
    assert torch.equal(scene.image(3), truth.image(3))
    assert scene.points.tolist() == [[0, 0, 0], [1, 1, 1], [0, 1, 2]]
    assert scene.colors.tolist() == [[0, 10, 20], [20, 20, 20], [30, 30, 30]]
    assert [scene.cameras[i].name for i in scene.splits["test"]] == sorted(c.name for c in truth.cameras)[::4][:2]
    assert scene.splat == output / "point_cloud/iteration_30000/point_cloud.ply"
    assert any("iteration_30000" in note for note in scene.notes)


def test_it_is_a_splat_too(output: Path) -> None:
    newest = read_splats(output / "point_cloud/iteration_30000/point_cloud.ply")
    assert torch.equal(read_splats(output).means, newest.means)
    assert len(newest) > 5
    with pytest.raises(ValueError, match=tells("known format", "point_cloud/iteration_*")):
        read_splats(output / "point_cloud")


def test_fit_averages_onto_its_gaussians(room: Path, output: Path, tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    maps = ["--features", str(room / "features")]
    assert main(["fit", str(output), *maps, "--out", str(run)]) == 0
    said = capsys.readouterr().out
    assert "iteration_30000" in said
    field = SemanticField.load(run / "field.kfgs")
    assert field.info["geometry"].endswith("iteration_30000/point_cloud.ply")
    assert not (run / "color.ply").exists()


def test_a_splat_needs_no_points(room: Path, output: Path, tmp_path: Path) -> None:
    scene = load_scene(output)
    bare = dataclasses.replace(scene, points=torch.zeros(0, 3), colors=torch.zeros(0, 3, dtype=torch.uint8))
    maps = FeatureFolder(room / "features").of(bare, "train")
    assert list(fit(bare, maps).info["seconds"]) == ["uplift"]


@pytest.mark.parametrize("ending", [False, True])
def test_pictures_beside_the_output_or_named(room: Path, output: Path, tmp_path: Path, ending: bool) -> None:
    folder = write_inria(tmp_path / "out", load_scene(room), Path("/gone") / "room", ending=ending)
    (folder / "point_cloud").symlink_to(output / "point_cloud")
    with pytest.raises(FileNotFoundError, match=tells("/gone/room", "--images")):
        load_scene(folder)
    assert len(load_scene(folder, images=room / "images")) == len(load_scene(room))
    (tmp_path / "room").symlink_to(room)  # source_path moved with the output
    scene = load_scene(folder, split="all")
    assert scene.image_paths[0].is_relative_to(tmp_path / "room")
    assert (folder / "input.ply").is_file()
    (folder / "input.ply").unlink()
    scene = load_scene(folder)
    cloud = read_splats(output)
    assert torch.equal(scene.points, cloud.means)
    expected = ((0.5 + 0.28209479177387814 * cloud.sh[:, 0]).clamp(0, 1) * 255).round().to(torch.uint8)
    assert torch.equal(scene.colors, expected)


def test_damaged_cameras(room: Path, output: Path, tmp_path: Path) -> None:
    folder = write_inria(tmp_path / "out", load_scene(room), room)
    (folder / "point_cloud").symlink_to(output / "point_cloud")
    entries = json.loads((folder / "cameras.json").read_text())
    for change, part in (
        ({"fx": 0}, "fx, fy, cx, cy as positive numbers"),
        ({"width": 1.5}, "width, height"),
        ({"rotation": [1, 0]}, "rotation [3][3]"),
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "rotation"),
    ):
        (folder / "cameras.json").write_text(json.dumps([entries[0] | change, *entries[1:]]))
        with pytest.raises(SceneError, match=tells("cameras.json, camera 0", part)):
            load_scene(folder)
    (folder / "cameras.json").write_text(json.dumps([*entries, entries[0] | {"img_name": "other"}]))
    assert any("other" in note for note in load_scene(folder).notes)


def test_a_source_path_makes_nobody_search_the_whole_disk(room: Path, output: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    shutil.copytree(room / "images", disk / "home/me/photos")
    folder = write_inria(tmp_path / "somewhere/out", load_scene(room), disk)
    (folder / "point_cloud").symlink_to(output / "point_cloud")
    with pytest.raises(FileNotFoundError, match=tells("disk", "--images")):
        load_scene(folder)
    (disk / "transforms_train.json").write_text("{}")  # a scene of Blender: its pictures lie in the folder itself
    assert len(load_scene(folder)) == len(load_scene(room))


def test_a_checkpoint_in_a_scene_is_not_used_by_itself(room: Path, output: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(room, scene)
    (scene / "ckpts").mkdir()
    (scene / "ckpts/ckpt_29999_rank0.pt").write_bytes(b"its frame is gsplat's own")
    loaded = load_scene(scene)
    assert loaded.splat is None
    assert any("ckpt_29999_rank0.pt is not used" in note and "--splat" in note for note in loaded.notes)
    (scene / "point_cloud").symlink_to(output / "point_cloud")
    assert load_scene(scene).splat == scene / "point_cloud/iteration_30000/point_cloud.ply"
