from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_models import write_picture
from messages import refused, tells
from PIL import Image

from kfgs.cameras import Camera, Distortion
from kfgs.cameras.resample import undistort
from kfgs.scenes import Scene, SceneError

K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
LENS = Distortion("brown_conrady", (0.3, 0.0, 0.0, 0.0))  # pincushion: the picture does not fill the pinhole's


def _camera(name: str, x: float = 0.0, distortion: Distortion | None = None) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, K, 64, 48, name, distortion)


def _scene(tmp_path: Path, distortion: Distortion | None = None, positions: tuple[float, ...] = (0, 2, 7)) -> Scene:
    names = [f"rgb_{5 * i}.png" for i in range(len(positions))]
    cameras = [_camera(name, x, distortion) for name, x in zip(names, positions, strict=True)]
    paths = [write_picture(tmp_path / name) for name in names]
    points, colors = torch.tensor([[0.0, 0, 3], [0, 0, 5]]), torch.zeros(2, 3, dtype=torch.uint8)
    return Scene(cameras, paths, points, colors, {"train": [0, 1], "test": [2]})


def test_a_picture_of_another_size_is_an_error(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    write_picture(scene.image_paths[1], 24, 32)
    refused(lambda: scene.image(1), "rgb_5.png:", "64x48", "got 32x24", error=SceneError)


def test_undistorted_scenes_undistort_lazily(tmp_path: Path) -> None:
    scene = _scene(tmp_path, LENS)
    assert scene.distorted
    straight = scene.undistorted()
    assert not straight.distorted
    expected, camera, recorded = undistort(scene.image(1), scene.cameras[1])
    torch.testing.assert_close(straight.image(1), expected)
    assert torch.equal(straight.mask(1), recorded)
    assert not recorded.all()  # the corners
    assert torch.equal(camera.K, straight.cameras[1].K)
    assert camera.size == straight.cameras[1].size
    assert camera.distortion is straight.cameras[1].distortion is None
    assert straight.undistorted() is straight
    assert torch.equal(straight.select([1]).image(0), expected)


@pytest.mark.parametrize(("scale", "near"), [(1.0, 0.2), (0.1, 0.1 * 1.1 * 0.4), (1e-3, 0.1 * 1.1 * 4e-3)])
def test_the_near_plane_follows_a_small_frame_whatever_the_split(tmp_path: Path, scale: float, near: float) -> None:
    scene = _scene(tmp_path, positions=(0, 2 * scale, 7 * scale))  # all views: mean 3, farthest 7
    assert {camera.near for camera in scene.cameras} == {0.2}  # a scene made by hand is left as it is
    assert [camera.near for camera in scene.with_near().cameras] == pytest.approx([near] * 3)
    if scale == 1:
        assert scene.with_near().cameras[0].near == 0.2  # not a rounding away


def test_the_near_plane_of_cameras_in_one_place(tmp_path: Path) -> None:
    alone = _scene(tmp_path).select([0])  # the points' median distance is 3
    scenes = [replace(alone, points=factor * alone.points) for factor in (10, 0.1, 0)]  # 0: every point in the camera
    assert [scene.with_near().cameras[0].near for scene in scenes] == pytest.approx([0.2, 0.03, 0.2])
    assert len(alone.select([]).with_near()) == 0


def test_extent_is_of_the_training_cameras(tmp_path: Path) -> None:
    scene = _scene(tmp_path)  # training cameras at x = 0 and 2
    assert scene.extent == pytest.approx(1.1)
    assert replace(scene, splits={}).extent == pytest.approx(1.1 * 4)  # mean 3, farthest 7
    assert scene.select("test").extent == pytest.approx((7**2 + 9) ** 0.5, rel=1e-6)  # one: lower median distance
    alone = replace(scene.select("test"), points=torch.zeros(0, 3), colors=torch.zeros(0, 3, dtype=torch.uint8))
    assert alone.extent == 1.0
    refused(lambda: scene.select([]).extent, "cameras:", "extent", "got none")


def test_select_by_split_name_stem_and_index(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    assert [c.name for c in scene.select("train").cameras] == ["rgb_0.png", "rgb_5.png"]
    chosen = scene.select(["rgb_10", "rgb_0.png"])
    assert [c.name for c in chosen.cameras] == ["rgb_10.png", "rgb_0.png"]
    assert chosen.splits == {"train": [1], "test": [0]}
    assert chosen.image_paths[0].name == "rgb_10.png"
    assert len(scene.select([2])) == 1
    assert len(scene.select("all")) == 3
    assert [c.name for c in scene.select(["RGB_10.JPG", "images\\rgb_0.png"]).cameras] == ["rgb_10.png", "rgb_0.png"]
    for order in (range(1, 3), torch.tensor([1, 2]), np.array([1, 2])):
        assert scene.select(order).splits == {"train": [0], "test": [1]}
    for which, message in (
        ("rgb_10", ("split:", "train, test, all", "got 'rgb_10'", "split.json", "['rgb_10']")),
        (["rgb_1"], ("view:", "got 'rgb_1'", "did you mean 'rgb_10.png'?")),
        ([1, 1], ("which:", "once", "got one twice")),
        ([2, -1], ("which:", "once", "got one twice")),
    ):
        refused(lambda which=which: scene.select(which), *message)  # type: ignore[misc]


def test_a_view_is_its_name_its_camera_or_its_index(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    Image.new("RGB", (64, 48), "red").save(scene.image_paths[2])
    assert [*scene, *scene[:2]] == [*scene.cameras, *scene.cameras[:2]]
    for view in ("rgb_10", "rgb_10.png", "x/RGB_10.jpg", 2, -1, np.int64(2), torch.tensor(2), scene.cameras[2]):
        assert scene.index(view) == 2
        assert scene.image(view)[0, 0].tolist() == [1, 0, 0]
        assert scene.mask(view).all()
    assert scene["rgb_10"] is scene[-1] is scene.cameras[2]
    for wrong in (3, -4):
        refused(lambda wrong=wrong: scene[wrong], "view:", "3 (the number of views)", f"got {wrong}", error=IndexError)  # type: ignore[misc]
    refused(lambda: scene.image("rgb_2"), "view:", "rgb_0.png, rgb_5.png", "got 'rgb_2'", "did you mean")


def test_scenes_are_checked(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    refused(lambda: replace(scene, image_paths=scene.image_paths[:1]), "image_paths:", "expected 3", "got 1")
    refused(lambda: replace(scene, colors=torch.zeros(3, 3, dtype=torch.uint8)), "colors:", "[P, 3]", "got (3, 3)")
    refused(lambda: replace(scene, splits={"train": [0, 9]}), "splits['train']:", "[0, 3)", "got 9")
    with pytest.raises(SceneError, match=tells("cameras:", "suffix", "got 'a' twice")):
        replace(scene, cameras=[_camera("a.png"), _camera("a.jpg"), _camera("b.png")])
    assert repr(scene) == "Scene(3 views, 2 points, splits: train 2, test 1)"


def test_a_scene_shows_its_facts_in_a_notebook(tmp_path: Path) -> None:
    scene = replace(_scene(tmp_path, LENS), folder=Path("<b>rooms</b>"), notes=("2 images have no pose",))
    card = scene._repr_html_()
    for fact in ("&lt;b&gt;rooms", "split train", "64x48", "distorted", "1.1 world units", "2 images have no pose"):
        assert fact in card
    assert "pinhole" in scene.undistorted()._repr_html_()
    assert "extent" not in scene.select([])._repr_html_()


def test_all_are_all_views_unless_a_split_has_that_name(tmp_path: Path) -> None:
    scene = replace(_scene(tmp_path), splits={"train": [1], "test": [], "night": [0]})
    assert scene.views("all") == list(range(len(scene)))
    assert replace(scene, splits={"all": [1]}).views("all") == [1]
    refused(lambda: scene.views("test"), "split: expected one of train, night, all, got 'test'")
