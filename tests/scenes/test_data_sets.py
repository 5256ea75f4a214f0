"""Scenes in the layouts of data sets, written here as those data sets have them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import write_model, write_picture
from messages import refused, tells
from PIL import Image

from kfgs.cameras.projection import project_points
from kfgs.formats.ply import write_ply
from kfgs.scenes import SceneError, load_scene

# Camera at (1, 2, 3), looking along world +x, world +z up: right = -y, down = -z, forward = +x
POSE = np.array([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]])
CAMERA = {"w": 64, "h": 48, "fx": 50.0, "fy": 55.0, "cx": 31.5, "cy": 23.5, "scale": 6553.5}


def _line(pose: np.ndarray) -> str:
    return " ".join(f"{value:.8e}" for value in pose.reshape(-1))


def _depth(path: Path, value: int, size: tuple[int, int] = (48, 64)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full(size, value, np.uint16)).save(path)


def _nice_slam(folder: Path, count: int = 3) -> Path:
    scene = folder / "room0"
    (scene / "results").mkdir(parents=True)
    for i in range(count):
        write_picture(scene / f"results/frame{i:06d}.jpg")
        _depth(scene / f"results/depth{i:06d}.png", 13107)  # 2 metres
    (scene / "traj.txt").write_text("".join(_line(POSE) + "\n" for _ in range(count)))
    (folder / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    return scene


def _looks_along_x(scene, K: tuple[float, float, float, float]) -> None:
    fx, fy, cx, cy = K
    points = torch.tensor([[6.0, 2.0, 3.0], [6.0, 1.0, 3.0], [6.0, 2.0, 4.0]])  # ahead; to the right; above
    xy, depth, _ = project_points(scene.cameras[0], points)
    torch.testing.assert_close(xy, torch.tensor([[cx, cy], [cx + fx / 5, cy], [cx, cy - fy / 5]]))
    torch.testing.assert_close(depth, torch.tensor([5.0, 5.0, 5.0]))


def test_replica_of_nice_slam(tmp_path: Path) -> None:
    scene = load_scene(_nice_slam(tmp_path))
    _looks_along_x(scene, (50, 55, 32, 24))  # their centres of pixels are whole numbers, ours are halves
    assert [camera.name for camera in scene.cameras] == ["frame000000.jpg", "frame000001.jpg", "frame000002.jpg"]
    assert scene.image(1).shape == (48, 64, 3)
    assert scene.cameras[0].size == (48, 64)
    torch.testing.assert_close(scene.points[:, 0], torch.full((len(scene.points),), 3.0), atol=1e-4, rtol=0)
    xy, _, _ = project_points(scene.cameras[0], scene.points[:1])
    torch.testing.assert_close(xy, torch.tensor([[0.5, 0.5]]), atol=1e-3, rtol=0)
    assert scene.colors.shape == (3 * 48 * 64, 3)


def test_a_long_video_of_replica_is_split_as_in_the_paper_and_many_photos_are_not(tmp_path: Path) -> None:
    scene = load_scene(_nice_slam(tmp_path / "replica", 200))
    assert (scene.splits["train"][:2], scene.splits["test"][:2], len(scene.splits["train"])) == ([5, 15], [0, 10], 20)
    assert any(note.startswith("split df3dgs: 20 of 200 views train") for note in scene.notes)
    names = [f"{i}.png" for i in range(200)]
    write_model(tmp_path / "photos/sparse/0", names)
    for name in names:
        write_picture(tmp_path / "photos/images" / name)
    assert len(load_scene(tmp_path / "photos").splits["train"]) == 175


def test_a_subset_of_the_frames_keeps_its_poses(tmp_path: Path) -> None:
    folder = _nice_slam(tmp_path)
    far = POSE.copy()
    far[0, 3] = 9
    (folder / "traj.txt").write_text("".join(_line(pose) + "\n" for pose in (POSE, POSE, far, POSE)))
    (folder / "results/frame000001.jpg").unlink()
    scene = load_scene(folder)
    assert [float(camera.center[0]) for camera in scene.cameras] == pytest.approx([1, 9])
    assert any("2 of 4 poses" in note for note in scene.notes)


def test_replica_that_is_not_whole(tmp_path: Path) -> None:
    refused(lambda: load_scene(_nice_slam(tmp_path).parent), "it holds scenes (room0)", "room0", error=SceneError)
    folder = tmp_path / "room0"
    refused(lambda: load_scene(folder / "results"), "results", "the folder above is a scene", folder, error=SceneError)
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join(lines[:2]))
    refused(lambda: load_scene(folder), "traj.txt", "numbers up to 2", "copy the whole folder", error=SceneError)
    (folder / "traj.txt").write_text("1 2 3\n")
    refused(lambda: load_scene(folder), "traj.txt", "16 numbers", "1 rows of [3]", error=SceneError)
    (folder / "traj.txt").write_text("1 2 3\n1 2\n")
    refused(lambda: load_scene(folder), "traj.txt", "2 rows of [2, 3] numbers", error=SceneError)
    (folder / "traj.txt").write_text("\n".join([_line(2 * POSE), *lines[1:]]))
    refused(lambda: load_scene(folder), "traj.txt, line 1", "0 0 0 1", "correct this pose", error=SceneError)
    (folder / "traj.txt").write_text("\n".join(lines))
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": CAMERA | {"w": 48, "h": 64}}))
    refused(lambda: load_scene(folder), "frame000000.jpg", "48x64", "64x48", error=SceneError)
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": CAMERA | {"fx": "fifty"}}))
    refused(lambda: load_scene(folder), "cam_params.json", "fx", "copy it again", error=SceneError)
    for wrong in ({"scale": math.nan}, {"fx": math.nan}, {"cx": math.nan}, {"w": 64.7}, {"h": "48"}, {"fy": True}):
        (tmp_path / "cam_params.json").write_text(json.dumps({"camera": CAMERA | wrong}))
        refused(lambda: load_scene(folder), "cam_params.json", *wrong, "copy it again", error=SceneError)
    (tmp_path / "cam_params.json").unlink()
    refused(lambda: load_scene(folder), "cam_params.json", '"scale": 6553.5', error=FileNotFoundError)
    (folder / "traj.txt").unlink()
    with pytest.raises(SceneError, match=tells("there is results, but not all of Replica", "results and traj.txt")):
        load_scene(folder)


def test_replica_of_semantic_nerf(tmp_path: Path) -> None:
    for i in (0, 2):
        write_picture(tmp_path / f"rgb/rgb_{i}.png")
        _depth(tmp_path / f"depth/depth_{i}.png", 2000)
    (tmp_path / "traj_w_c.txt").write_text("".join(_line(POSE) + "\n" for _ in range(3)))
    scene = load_scene(tmp_path)
    _looks_along_x(scene, (32, 32, 32, 24))  # 90 degrees across 64 pixels
    assert [scene.stem(i) for i in range(2)] == ["rgb_0", "rgb_2"]
    assert any("90 degrees" in note for note in scene.notes)
    assert float(scene.points[:, 0].mean()) == pytest.approx(3.0)
    (tmp_path / "rgb/rgb_0.png").rename(tmp_path / "rgb/a.png")
    (tmp_path / "rgb/rgb_2.png").unlink()
    refused(lambda: load_scene(tmp_path), "rgb", "pictures named rgb_NUMBER", "none", error=SceneError)


def _scannet(folder: Path) -> Path:
    for i in range(3):
        write_picture(folder / f"color/{i}.jpg")
        _depth(folder / f"depth/{i}.png", 2000, (24, 32))
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/{i}.txt").write_text("\n".join(" ".join(map(str, row)) for row in POSE))
    (folder / "intrinsic").mkdir()
    for name, K in (("color", (50, 55, 32, 24)), ("depth", (25, 27.5, 16, 12))):
        rows = [[K[0], 0, K[2], 0], [0, K[1], K[3], 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    return folder


def test_scannet(tmp_path: Path) -> None:
    folder = _scannet(tmp_path)
    (folder / "pose/1.txt").write_text("\n".join(["-inf nan -nan(ind) -1.#IND00"] * 4))
    write_picture(folder / "color/7.jpg")
    scene = load_scene(folder)
    _looks_along_x(scene, (50, 55, 32, 24))
    assert [camera.name for camera in scene.cameras] == ["0.jpg", "2.jpg"]
    assert any("1 views have no pose" in note and "1.jpg" in note for note in scene.notes)
    assert any("no file in pose/" in note and "7.jpg" in note for note in scene.notes)
    assert float(scene.points[:, 0].mean()) == pytest.approx(3.0)
    xyz = {name: np.array([1.0, 2.0], np.float32) for name in "xyz"}
    write_ply(folder / "scene0000_00_vh_clean_2.ply", xyz | {"red": np.array([5, 6], np.uint8)})
    scene = load_scene(folder)
    assert scene.points.tolist() == [[1, 1, 1], [2, 2, 2]]  # every vertex, in the order of the mesh
    assert scene.colors.tolist() == [[5, 128, 128], [6, 128, 128]]


def test_scannet_that_is_not_whole(tmp_path: Path) -> None:
    folder = _scannet(tmp_path)
    (folder / "pose/0.txt").write_text("1 2 3\n")
    refused(lambda: load_scene(folder), "0.txt", "4 rows of 4 numbers", "1 rows of [3]", error=SceneError)
    (folder / "pose/0.txt").write_text("one two")
    refused(lambda: load_scene(folder), "0.txt", "4 rows of 4 numbers", "'one'", error=SceneError)
    (folder / "pose/0.txt").unlink()
    (folder / "scene_vh_clean_2.ply").write_text("no mesh")
    refused(lambda: load_scene(folder), "scene_vh_clean_2.ply", "PLY", "copy the mesh again", error=SceneError)
    (folder / "intrinsic/intrinsic_color.txt").write_text("1170 0 647 0\n0 1170 483 0\n0 0 1 0\n0 0 0 1")
    refused(lambda: load_scene(folder), "intrinsic_color.txt", "64x48", "(647, 483)", error=SceneError)
    (folder / "intrinsic/intrinsic_color.txt").unlink()
    refused(lambda: load_scene(folder), "intrinsic_color.txt", "no such file", error=FileNotFoundError)
    for name in "12":
        (folder / f"pose/{name}.txt").unlink()
    refused(lambda: load_scene(folder), "pose", "0.jpg", "SensReader", error=SceneError)


def test_mip_nerf_360_with_smaller_pictures(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse/0", ["a.png", "b.png"])  # 64x48, f = 50, 55, c = 31, 25
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / "images" / name)
        write_picture(tmp_path / "images_4" / name, 12, 16)
    assert load_scene(tmp_path).cameras[0].size == (48, 64)
    scene = load_scene(tmp_path, images="images_4")
    assert scene.image(0).shape == (12, 16, 3)
    torch.testing.assert_close(scene.cameras[0].K, torch.tensor([[12.5, 0, 7.75], [0, 13.75, 6.25], [0, 0, 1]]))
    assert any("4 times smaller" in note for note in scene.notes)
    (tmp_path / "images").rename(tmp_path / "originals")
    assert load_scene(tmp_path).cameras[0].size == (12, 16)  # what there is


def test_every_picture_has_its_own_size(tmp_path: Path) -> None:
    """In each layout one picture is a smaller copy, and the last is the only one that differs."""
    write_model(tmp_path / "colmap/sparse/0", ["a.png", "b.png"])  # 64x48, fx 50
    write_picture(tmp_path / "colmap/images/a.png")
    _nice_slam(tmp_path / "replica")
    _scannet(tmp_path / "scannet")
    for i in range(3):
        write_picture(tmp_path / f"nerf/rgb/rgb_{i}.png")
    (tmp_path / "nerf/traj_w_c.txt").write_text("".join(_line(POSE) + "\n" for _ in range(3)))
    last = ("colmap/images/b.png", "replica/room0/results/frame000002.jpg", "scannet/color/2.jpg")
    for name in (*last, "nerf/rgb/rgb_2.png"):
        write_picture(tmp_path / name, 24, 32)
    for folder, fx in (("colmap", 50), ("replica/room0", 50), ("scannet", 50), ("nerf", 32)):
        scene = load_scene(tmp_path / folder)
        assert [camera.size for camera in scene.cameras][-2:] == [(48, 64), (24, 32)]
        assert [float(camera.K[0, 0]) for camera in scene.cameras][-2:] == pytest.approx([fx, fx / 2])
        assert scene.image(len(scene) - 1).shape == (24, 32, 3)
        notes = scene.notes
        noted = any(
            f"1 of {len(scene)} pictures have other sizes" in note and "2 times smaller" in note for note in notes
        )
        assert noted == (folder != "nerf")  # whose file says no size
    write_picture(tmp_path / last[0], 96, 128)
    assert any("b.png is 2 times larger" in note for note in load_scene(tmp_path / "colmap").notes)
    write_picture(tmp_path / last[1], 64, 48)  # turned
    refused(lambda: load_scene(tmp_path / "replica/room0"), "frame000002.jpg", "64x48", "got 48x64", error=SceneError)


def test_scannet_as_opengaussian_has_it(tmp_path: Path) -> None:
    opengl = (POSE @ np.diag([1.0, -1, -1, 1])).tolist()
    lens = {"w": 64, "h": 48, "fl_x": 50, "fl_y": 55, "cx": 32, "cy": 24}
    for split, numbers in (("train", (0, 20)), ("test", (10,))):
        frames = []
        for i in numbers:
            write_picture(tmp_path / f"color/{i}.jpg")
            frames.append({"file_path": f"color/{i}", "transform_matrix": opengl})
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({**lens, "frames": frames}))
    write_ply(tmp_path / "points3d.ply", {name: np.array([1.0, 2.0], np.float32) for name in "xyz"})
    scene = load_scene(tmp_path)
    _looks_along_x(scene, (50, 55, 32, 24))
    assert [camera.name for camera in scene.cameras] == ["color/0.jpg", "color/10.jpg", "color/20.jpg"]
    assert scene.splits == {"train": [0, 2], "test": [1]}
    assert len(scene.points) == 2
    assert any("points3d.ply" in note for note in scene.notes)
