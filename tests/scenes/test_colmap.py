from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import CAMERAS, IMAGES, pycolmap, read_with_pycolmap, write_model, write_picture, write_text_model
from messages import refused, tells

from kfgs._notes import hear
from kfgs.cameras.projection import camera_to_pixel
from kfgs.scenes import SceneError, load_cameras
from kfgs.scenes.colmap import LENSES, convert_intrinsics, load_colmap

INTRINSICS = {
    "SIMPLE_PINHOLE": [50.0, 31, 25],
    "PINHOLE": [50.0, 55, 31, 25],
    "SIMPLE_RADIAL": [50.0, 31, 25, -0.1],
    "RADIAL": [50.0, 31, 25, -0.1, 0.02],
    "OPENCV": [50.0, 55, 31, 25, -0.1, 0.02, 0.003, -0.004],
    "FULL_OPENCV": [50.0, 55, 31, 25, -0.1, 0.02, 0.003, -0.004, 0.01, 0.02, -0.01, 0.005],
    "OPENCV_FISHEYE": [50.0, 55, 31, 25, -0.1, 0.02, 0.003, -0.004],
    "SIMPLE_RADIAL_FISHEYE": [50.0, 31, 25, -0.1],
    "RADIAL_FISHEYE": [50.0, 31, 25, -0.1, 0.02],
    "SIMPLE_FISHEYE": [50.0, 31, 25],
    "FISHEYE": [50.0, 55, 31, 25],
}


def _scene_folder(tmp_path: Path, names: list[str], **options: object) -> tuple[Path, Path]:
    model = write_model(tmp_path / "sparse/0", names, **options)
    for name in names:
        write_picture(tmp_path / "images" / name)
    return model, tmp_path / "images"


@pytest.mark.parametrize("model", list(LENSES))
def test_pixels_are_those_of_pycolmap(tmp_path: Path, model: str) -> None:
    scene = load_colmap(*_scene_folder(tmp_path, ["a.png"], model=model, params=INTRINSICS[model]))
    camera = scene.cameras[0].to(torch.float64)
    rays = np.array([[0.3, 0.2, 1.0], [-0.4, 0.5, 2.0], [0.0, -0.1, 0.7]])
    theirs = pycolmap.Camera(model=model, width=64, height=48, params=INTRINSICS[model]).img_from_cam(rays)
    ours = camera_to_pixel(camera, torch.from_numpy(rays))
    torch.testing.assert_close(ours, torch.from_numpy(theirs), rtol=0, atol=1e-4)  # K is stored as float32


def test_models_without_exact_form_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=tells("got FOV", "colmap image_undistorter")):
        load_colmap(*_scene_folder(tmp_path, ["a.png"], model="FOV", params=[50, 55, 31, 25, 0.1]))


def test_a_lens_of_zeros_is_a_pinhole_but_a_fisheye_is_not() -> None:
    assert convert_intrinsics("OPENCV", [50, 55, 31, 25, 0, 0, 0, 0])[1] is None
    assert convert_intrinsics("FISHEYE", [50, 55, 31, 25])[1] is not None


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("rigs", [False, True])
def test_poses_points_and_names(tmp_path: Path, text: bool, rigs: bool) -> None:
    scene = load_colmap(*_scene_folder(tmp_path, ["rgb_10.png", "rgb_5.png", "sub/c.png"], text=text, rigs=rigs))
    assert [camera.name for camera in scene.cameras] == ["rgb_5.png", "rgb_10.png", "sub/c.png"]
    assert [scene.stem(i) for i in range(3)] == ["rgb_5", "rgb_10", "sub/c"]
    i = 2  # image ids follow the order of writing: rgb_5 is the second
    expected = torch.eye(4)
    c, s = np.cos(0.2 * i), np.sin(0.2 * i)
    expected[:3] = torch.tensor([[1, 0, 0, 0.5 * i], [0, c, -s, -0.25], [0, s, c, 2.0]])
    torch.testing.assert_close(scene.cameras[0].viewmat, expected, rtol=1e-5, atol=1e-6)
    k = torch.arange(5.0)
    torch.testing.assert_close(scene.points, torch.stack([k, 0.5 * k, torch.full((5,), 4.0)], 1))
    assert scene.colors.tolist() == [[10 * j, 20, 30] for j in range(5)]
    assert scene.splits == {"train": [0, 1, 2], "test": []}
    assert scene.notes == ()


def test_an_image_without_pose_is_left_out_and_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = write_text_model(tmp_path / "sparse", images=IMAGES.replace("0.6 0.8 0 0", "nan 0.8 0 0"))
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / "images" / name)
    note = "1 views have no pose or lens of finite numbers and were left out: b.png"
    scene = load_colmap(model, tmp_path / "images")
    assert [camera.name for camera in scene.cameras] == ["a.png"]
    assert note in scene.notes
    with hear(print):
        assert [camera.name for camera in load_cameras(model)] == ["a.png"]
    assert note in capsys.readouterr().out


def test_missing_files_and_unposed_files_are_noted(tmp_path: Path) -> None:
    model, images = _scene_folder(tmp_path, ["a.png", "b.png", "c.png"])
    (images / "b.png").unlink()
    write_picture(images / "extra.png")
    scene = load_colmap(model, images)
    assert [camera.name for camera in scene.cameras] == ["a.png", "c.png"]
    assert "1 of 3 posed images have no file" in scene.notes[0]
    assert "b.png" in scene.notes[0]
    assert "1 image files" in scene.notes[1]
    assert "extra.png" in scene.notes[1]


def test_a_lens_of_a_picture_that_is_not_there_may_be_any(tmp_path: Path) -> None:
    cameras = CAMERAS + "2 FOV 64 48 50 55 31 25 0.1\n"
    folder = write_text_model(tmp_path / "m", cameras=cameras, images=IMAGES.replace("1 2 3 1 b", "1 2 3 2 b"))
    write_picture(tmp_path / "images/a.png")
    assert "1 of 2 posed images have no file" in load_colmap(folder, tmp_path / "images").notes[0]
    write_picture(tmp_path / "images/b.png")
    refused(lambda: load_colmap(folder, tmp_path / "images"), "b.png", "FOV", error=SceneError)


def test_the_wrong_image_folder_is_an_error(tmp_path: Path) -> None:
    model, _ = _scene_folder(tmp_path, ["a.png"])
    (tmp_path / "other").mkdir()
    refused(lambda: load_colmap(model, tmp_path / "other"), "other:", "1 posed", "(a.png)", "folder", error=SceneError)
    refused(lambda: load_colmap(model, tmp_path / "nowhere"), "nowhere:", "no such folder", error=FileNotFoundError)


def test_a_quaternion_that_is_not_of_length_1_is_normalised(tmp_path: Path) -> None:
    model = write_text_model(tmp_path / "sparse", images="1 0.6006 0.8008 0 0 1 2 3 1 a.png\n\n", points3D="")
    write_picture(tmp_path / "images/a.png")
    scene = load_colmap(model, tmp_path / "images")
    turned = torch.tensor([[1, 0, 0, 1], [0, -0.28, -0.96, 2], [0, 0.96, -0.28, 3], [0, 0, 0, 1]])  # cos = 2 * 0.36 - 1
    torch.testing.assert_close(scene.cameras[0].viewmat, turned)
    assert "1 quaternions have a length of 1.001 to 1.001, not 1: a.png" in scene.notes


def test_a_name_too_long_for_the_disk_is_a_missing_file(tmp_path: Path) -> None:
    images = IMAGES.replace("b.png", "b" * 300 + ".png")
    write_picture(tmp_path / "images/a.png")
    scene = load_colmap(write_text_model(tmp_path / "sparse", images=images), tmp_path / "images")
    assert [camera.name for camera in scene.cameras] == ["a.png"]


def test_room_0_projects_its_points_where_they_were_seen(shared_data: Path) -> None:
    folder = shared_data / "room_0"
    scene, model = load_colmap(folder / "sparse/0", folder / "images"), read_with_pycolmap(folder / "sparse/0")
    assert len(scene.cameras) == 180
    assert scene.points.shape == (18543, 3)
    image = next(image for image in model.images.values() if image.name == "rgb_100.png")
    camera = scene.cameras[[c.name for c in scene.cameras].index("rgb_100.png")].to(torch.float64)
    seen = [(point.xy, model.points3D[point.point3D_id].xyz) for point in image.points2D if point.has_point3D()]
    world = torch.tensor(np.array([xyz for _, xyz in seen]))
    pixels = camera_to_pixel(camera, world @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])
    error = (pixels - torch.tensor(np.array([xy for xy, _ in seen]))).norm(dim=1)
    assert float(error.median()) < 0.5  # the model says 0.37 px on average
    half = replace(camera, K=camera.K + torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], dtype=torch.float64))
    wrong = camera_to_pixel(half, world @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])
    bias = (wrong - torch.tensor(np.array([xy for xy, _ in seen]))).mean(0)
    assert float(bias.norm()) > 0.6  # the other reading of pixel centres is visibly off: sqrt(2) / 2
