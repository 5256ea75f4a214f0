"""Points for scenes that have poses and no points: by triangulation, or from depth."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_sfm import downsized
from messages import refused, tells
from PIL import Image
from safetensors.torch import load_file

from kfgs.cameras import Camera, Distortion
from kfgs.cli import main
from kfgs.formats.ply import write_ply
from kfgs.scenes import Scene, SceneError, SfmConfig, find_points, load_scene
from kfgs.scenes.colmap import import_pycolmap
from kfgs.scenes.known_poses import neighbours

FEW = SfmConfig(max_features=1500, num_threads=1)


@pytest.fixture(scope="module")
def posed(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Six small photographs with true poses, as a transforms.json without points has them."""
    folder = tmp_path_factory.mktemp("posed")
    truth = load_scene(shared_data / "lund_door", split="all").select(range(6))
    files = sorted(downsized(shared_data / "lund_door/images", folder / "images", 6).iterdir())
    files[0] = files[0].rename(files[0].with_name(f"the  door {files[0].name}"))  # COLMAP cuts it in a list of pairs
    with Image.open(files[0]) as picture:
        width, height = picture.size
    frames = []
    for camera, file in zip(truth.cameras, files, strict=True):
        small = camera.resized(height, width)
        pose = np.linalg.inv(small.viewmat.double().numpy()) @ np.diag([1.0, -1, -1, 1])
        fx, fy, cx, cy = (float(small.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "k1": small.distortion.coefficients[0]}
        lens |= {"w": width, "h": height}
        frames.append({"file_path": f"images/{file.name}", "transform_matrix": pose.tolist(), **lens})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return load_scene(folder, split="all")


def reprojection(scene: Scene, truth: Scene) -> float:
    """The median distance of points to the nearest points of the true model, as a share of their depth."""
    nearest = torch.cdist(scene.points.double(), truth.points.double()).min(dim=1).values
    return float((nearest / scene.points[:, 2].double().abs()).median())


def test_points_are_triangulated_from_the_given_poses(posed: Scene, shared_data: Path) -> None:
    assert len(posed.points) == 0
    assert any("triangulate" in note for note in posed.notes)
    found = find_points(posed, config=FEW)
    assert len(found.points) > 300
    assert found.colors.shape == found.points.shape
    assert 20 < float(found.colors.float().mean()) < 235
    truth = load_scene(shared_data / "lund_door", split="all")
    assert reprojection(found, truth) < 0.02  # the frame and the scale are those of the poses
    assert found.cameras == posed.cameras
    straight = find_points(posed.undistorted(), config=FEW)  # the files on disk still have the lens
    assert torch.equal(straight.points, found.points)


@pytest.mark.parametrize("count", [0, 2])
def test_a_field_of_a_scene_with_few_or_no_points_trains(posed: Scene, tmp_path: Path, capsys, count: int) -> None:
    folder, top = posed.folder, json.loads((posed.folder / "transforms.json").read_text())
    if count:
        folder = tmp_path / "scene"
        folder.mkdir()
        for frame in top["frames"]:
            frame["file_path"] = str(posed.folder / frame["file_path"])
        (folder / "transforms.json").write_text(json.dumps(top | {"ply_file_path": "two.ply"}))
        write_ply(folder / "two.ply", {name: np.arange(2, dtype=np.float32) for name in "xyz"})
    arguments = ["color", str(folder), "--out", str(tmp_path / "run"), "--steps", "2", "--preset", "quick"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert f"points: the scene has {2 if count else 0}, and training starts from points" in said
    assert "triangulated from" in said
    assert (tmp_path / "run/color.ply").is_file()
    assert main(arguments) == 0
    assert "points: found in points-" in capsys.readouterr().out
    (tensors,) = (tmp_path / "run/stages").glob("points-*/points.safetensors")
    assert len(load_file(tensors)["points"]) > 300


def test_sfm_leaves_poses_as_they_are(posed: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for given in (posed.folder, posed.folder / "transforms.json"):
        assert main(["sfm", str(given), "--out", str(tmp_path / "out")]) == 1
        assert "--ignore-poses" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_poses_that_do_not_fit_are_refused(posed: Scene) -> None:
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))  # OpenGL axes taken for COLMAP's
    g = torch.Generator().manual_seed(0)
    wrong = []
    for camera in posed.cameras:
        view = turned @ camera.viewmat
        view[:3, 3] += 10 * torch.randn(3, generator=g)
        wrong.append(dataclasses.replace(camera, viewmat=view))
    with pytest.raises(SceneError, match=tells("poses", "--ignore-poses", "axis")):
        find_points(dataclasses.replace(posed, cameras=wrong), config=FEW)
    refused(lambda: find_points(posed.select([0]), config=FEW), "at least 2 views", "got 1", error=SceneError)
    gone = dataclasses.replace(posed, image_paths=[*posed.image_paths[:-1], Path("gone.png")])
    refused(lambda: find_points(gone, config=FEW), "gone.png", error=FileNotFoundError)


def test_each_lens_reaches_pycolmap(posed: Scene) -> None:
    from kfgs.cameras.projection import plane_to_pixel
    from kfgs.scenes.known_poses import _reconstruction

    pycolmap = import_pycolmap()
    rays = np.array([[0.1, -0.2, 1.0], [-0.3, 0.15, 1.0]])
    for model, coefficients in ((None, ()), ("brown_conrady", (0.1, -0.02, 0.01, 0.005)),
                                ("brown_conrady", (0.1, -0.02, 0.01, 0.005, 0.003)),
                                ("brown_conrady", (0.1, -0.02, 0.01, 0.005, 0.003, 0.02, 0.01, 0.004)),
                                ("kannala_brandt", (0.1, -0.02, 0.01, 0.005))):  # fmt: skip
        lens = None if model is None else Distortion(model, coefficients)
        K = torch.tensor([[50.0, 0, 31], [0, 55, 25], [0, 0, 1]])
        camera = Camera(torch.eye(4), K, 64, 48, "a.png", lens)
        scene = Scene([camera], [Path("a.png")], torch.zeros(0, 3), torch.zeros(0, 3))
        theirs = _reconstruction(pycolmap, scene, ["a.png"]).cameras[1].img_from_cam(rays)
        ours = plane_to_pixel(torch.from_numpy(rays[:, :2]), K.double(), lens)
        np.testing.assert_allclose(np.asarray(theirs), ours.numpy(), atol=1e-6)


def test_neighbours_are_near_and_look_the_same_way() -> None:
    K = torch.eye(3)
    views = []
    for i in range(30):
        view = torch.eye(4)
        view[0, 3] = float(i)
        views.append(Camera(view, K, 4, 4, f"{i}.png"))
    pairs = neighbours(views)
    assert all(a < b for a, b in pairs)
    assert (0, 1) in pairs
    assert (0, 29) not in pairs
    assert {b for a, b in pairs if a == 0} >= set(range(1, 21))


# Depth: a wall at z = 4 in front of a camera at (1, 2, 0) that looks along world +z.
OPENGL = [[1.0, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 0], [0, 0, 0, 1]]


def _wall(folder: Path, name: str, size: tuple[int, int] = (24, 32)) -> None:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "depth").mkdir(exist_ok=True)
    Image.new("RGB", (64, 48), (200, 100, 50)).save(folder / f"images/{name}.png")
    Image.fromarray(np.full(size, 4000, np.uint16)).save(folder / f"depth/{name}.png")


def _at_the_wall(scene: Scene) -> None:
    assert len(scene.points) == 24 * 32
    torch.testing.assert_close(scene.points[:, 2], torch.full((768,), 4.0))
    # columns reach from (0.5 - 16) / 25 * 4 to (31.5 - 16) / 25 * 4 around x = 1; rows the same way around y = 2
    torch.testing.assert_close(scene.points[:, 0].aminmax(), (torch.tensor(1 - 2.48), torch.tensor(1 + 2.48)))
    torch.testing.assert_close(scene.points[:, 1].aminmax(), (torch.tensor(2 - 1.84), torch.tensor(2 + 1.84)))
    assert scene.colors[0].tolist() == [200, 100, 50]


@pytest.mark.parametrize("key", ["depth_file_path", "depth_path"])
def test_points_from_the_depth_of_a_transforms_json(tmp_path: Path, key: str) -> None:
    _wall(tmp_path, "a")
    frame = {"file_path": "images/a.png", key: "depth/a.png", "transform_matrix": OPENGL}
    lens = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    scene = load_scene(tmp_path)
    _at_the_wall(scene)
    assert any("depth pictures of 1 views" in note for note in scene.notes)
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "integer_depth_scale": 2e-3, "frames": [frame]}))
    assert float(load_scene(tmp_path).points[0, 2]) == 8
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "integer_depth_scale": 0, "frames": [frame]}))
    refused(lambda: load_scene(tmp_path), "integer_depth_scale", "above 0", error=SceneError)
    for other in ("../depth/a.png", 7, "depth/gone.png", "a\0.png"):
        (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame | {key: other}]}))
        assert len(load_scene(tmp_path).points) == 0
