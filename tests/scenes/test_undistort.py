from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import write_model, write_picture
from messages import tells
from PIL import Image

from kfgs.scenes import SceneError, load_scene, undistort_scene


def test_a_lens_that_kfgs_refuses_is_removed_by_pycolmap(tmp_path: Path) -> None:
    model = write_model(tmp_path / "in/sparse/0", ["a.png", "b.png"], model="FOV", params=[50, 55, 31, 25, 0.3])
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / "in/images" / name)
    with pytest.raises(SceneError, match=tells("got FOV", "undistort")):
        load_scene(tmp_path / "in")
    scene = load_scene(undistort_scene(tmp_path / "in/images", model, tmp_path / "out"))
    assert [c.name for c in scene.cameras] == ["a.png", "b.png"]
    assert not scene.distorted
    image, camera = scene.image(0), scene.cameras[0]
    assert image.shape[:2] == camera.size
    row, column = round(float(camera.K[1, 2]) - 0.5), round(float(camera.K[0, 2]) - 0.5)
    expected = torch.tensor([30.5 * 3, 24.5 * 4, 9]) / 255  # the old picture at its principal point (31, 25)
    torch.testing.assert_close(image[row, column], expected, rtol=0, atol=0.02)
    assert len(scene.points) == 5


def test_masks_go_through_the_same_lens(tmp_path: Path) -> None:
    names = ["a.jpg", "b.png"]
    model = write_model(tmp_path / "in/sparse/0", names, model="FOV", params=[50, 55, 31, 25, 0.3])
    for name in names:
        write_picture(tmp_path / "in/images" / name)
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :31] = 0  # left of the principal point
    (tmp_path / "in/masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "in/masks/a.png")
    out = undistort_scene(tmp_path / "in/images", model, tmp_path / "out")
    scene = load_scene(out)
    assert not {"taken", "straight"} & {file.name for file in out.iterdir()}
    kept, centre = scene.mask(0), round(float(scene.cameras[0].K[0, 2]))
    assert not kept[:, :centre].any()
    assert kept[:, centre + 1 :].all()
    assert scene.mask(1).all()


def test_panoramas_are_no_lens_to_undistort(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sparse/0", ["a.png"], model="EQUIRECTANGULAR", params=[64, 48])
    write_picture(tmp_path / "images/a.png")
    advice = "cut perspective views out of the panoramas"
    with pytest.raises(SceneError, match=advice):
        undistort_scene(tmp_path / "images", model, tmp_path / "out")
    with pytest.raises(SceneError, match=tells("got EQUIRECTANGULAR", advice)):
        load_scene(tmp_path)


def test_wrong_folders_are_refused(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sparse/0", ["a.png"])
    with pytest.raises(FileNotFoundError, match=tells("images:", "no such folder", "sparse/0")):
        undistort_scene(tmp_path / "images", model, tmp_path / "out")
    write_picture(tmp_path / "images/a.png")
    with pytest.raises(SceneError, match=tells("folder", "undistorted", "in use")):
        undistort_scene(tmp_path / "images", model, tmp_path)
    (tmp_path / "images/a.png").rename(tmp_path / "images/b.png")
    with pytest.raises(SceneError, match=tells("images:", "none", "undistorted", "folder")):
        undistort_scene(tmp_path / "images", model, tmp_path / "out")
    assert not (tmp_path / "out").exists()
