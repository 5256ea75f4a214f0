import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from colmap_models import write_model, write_picture
from messages import tells

from kfgs.scenes import SceneError, list_images, load_cameras, load_scene
from kfgs.scenes.load import picture_folders


def _pictures(folder: Path, names: list[str]) -> None:
    for name in names:
        write_picture(folder / name)


@pytest.mark.parametrize("where", ["sparse/0", "sparse", "colmap/sparse/0", "colmap_ground_truth", "."])
def test_models_are_found_where_programs_put_them(tmp_path: Path, where: str) -> None:
    write_model(tmp_path / where, ["a.png", "b.png"])
    _pictures(tmp_path / "images", ["a.png", "b.png"])
    scene = load_scene(tmp_path)
    assert [c.name for c in scene.cameras] == ["a.png", "b.png"]
    assert scene.splits == {"train": [0, 1], "test": []}
    assert scene.notes == ("split all: 2 of 2 views train, 0 test",)


def test_a_model_folder_or_a_given_image_folder_will_do(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sparse/0", ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    assert len(load_scene(model)) == 1
    shutil.move(tmp_path / "images", tmp_path / "photos")
    assert load_scene(tmp_path, images=tmp_path / "photos").image_paths[0].parent.name == "photos"
    with pytest.raises(SceneError, match=tells("(a.png)", "image folder")):
        load_scene(tmp_path)
    shutil.copy(tmp_path / "photos/a.png", tmp_path / "a.png")
    assert load_scene(tmp_path).image_paths == [tmp_path / "a.png"]  # beside the model, without images/


def test_a_second_model_is_mentioned(tmp_path: Path) -> None:
    for number in "01":
        write_model(tmp_path / "sparse" / number, ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    assert any("holds other models too (1)" in note for note in load_scene(tmp_path).notes)


def test_every_loader_gives_a_near_plane_to_suit_a_small_frame(tmp_path: Path) -> None:
    write_model(tmp_path / "colmap/sparse/0", ["a.png", "b.png"])
    _pictures(tmp_path / "colmap/images", ["a.png", "b.png"])
    frames = []
    for name, x in (("a.png", 0.0), ("b.png", 0.6)):
        pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose})
    _pictures(tmp_path / "nerf/images", ["a.png", "b.png"])
    lens = {"w": 64, "h": 48, "fl_x": 50, "fl_y": 50}
    (tmp_path / "nerf/transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    for folder in ("colmap", "nerf"):
        scene = load_scene(tmp_path / folder)
        assert {camera.near for camera in scene.cameras} == {0.1 * scene.extent}
        assert 0 < scene.extent < 1
    assert load_scene(tmp_path / "nerf").cameras[0].near == pytest.approx(0.1 * 1.1 * 0.3)


def test_real_rooms_keep_the_usual_near_plane(shared_data: Path) -> None:
    for name in ("room_0", "fox"):
        assert {camera.near for camera in load_scene(shared_data / name).cameras} == {0.2}


def test_the_split_file_wins(tmp_path: Path) -> None:
    names = [f"rgb_{i}.png" for i in range(24)]
    write_model(tmp_path / "sparse/0", names)
    _pictures(tmp_path / "images", names)
    assert load_scene(tmp_path).splits["test"] == [0, 8, 16]
    paper = load_scene(tmp_path, split="df3dgs")
    assert paper.splits == {"train": [5, 15], "test": [0, 10, 20]}
    assert any("split df3dgs: 2 of 24 views train, 3 test" in note for note in paper.notes)
    (tmp_path / "split.json").write_text(json.dumps({"train": ["rgb_10", "rgb_2"], "test": ["rgb_0", "rgb_99"]}))
    scene = load_scene(tmp_path)
    assert scene.splits == {"train": [2, 10], "test": [0]}
    assert any("1 names in" in note and "rgb_99" in note for note in scene.notes)
    assert load_scene(tmp_path, split="holdout8").splits["test"] == [0, 8, 16]
    (tmp_path / "split.json").unlink()
    with pytest.raises(FileNotFoundError, match=tells("split.json:")):
        load_scene(tmp_path, split="file")


def test_what_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells("nothing:", "no such folder", "scene")):
        load_scene(tmp_path / "nothing")
    photos = tmp_path / "my photos"
    photos.mkdir()
    advice = f"`kfgs sfm '{photos}' --out scene/` (in Python: run_sfm)"
    with pytest.raises(SceneError, match=tells("COLMAP", "transforms.json", "docs/datasets.md", "none", advice)):
        load_scene(photos)
    with pytest.raises(ValueError, match=tells("split:", "'auto'", "got 'random'")):
        load_scene(tmp_path, split="random")  # type: ignore[arg-type]
    write_model(tmp_path / "sparse/0", ["a.png"])
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(SceneError, match=tells("got cameras.bin, images.bin", "copy")):
        load_scene(tmp_path)
    write_model(tmp_path / "sparse/0", ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    with pytest.raises(SceneError, match=tells("6 views", "'df3dgs'", "got 1")):
        load_scene(tmp_path, split="df3dgs")


def test_images_are_listed_in_natural_order(tmp_path: Path) -> None:
    _pictures(tmp_path, ["b10.png", "b9.png", "sub/a.png", ".hidden/x.png", ".y.png"])
    (tmp_path / "b1.JPG").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("")
    assert list_images(tmp_path) == ["b1.JPG", "b9.png", "b10.png", "sub/a.png"]


def test_the_real_scenes(shared_data: Path) -> None:
    room = load_scene(shared_data / "room_0")
    assert (len(room), len(room.splits["train"]), len(room.splits["test"]), room.notes) == (180, 90, 90, ())
    assert room.stem(room.splits["train"][0]) == "rgb_5"
    assert room.image(0).shape == (479, 639, 3)
    assert room.extent == pytest.approx(2.548, abs=0.01)
    door = load_scene(shared_data / "lund_door")
    assert (len(door), door.distorted, door.splits["test"]) == (12, True, [0, 8])
    fox = load_scene(shared_data / "fox", split="holdout8")
    assert (len(fox), len(fox.points), len(fox.splits["train"])) == (50, 0, 43)
    assert [c.name for c in load_scene(shared_data / "fox/transforms.json").cameras] == [c.name for c in fox.cameras]


@pytest.mark.parametrize(
    ("folder", "given", "found"),
    [
        ("images", None, "images"),
        ("images_4", None, "images_4"),
        ("photos", "photos", "photos"),
        ("images/left", None, "images"),
        (".", None, None),
    ],
)
def test_picture_folders_are_those_that_are_read(
    tmp_path: Path, folder: str, given: str | None, found: str | None
) -> None:
    root = tmp_path / "scene"
    name = "left/a.png" if folder == "images/left" else "a.png"
    write_model(root / "sparse/0", [name])
    _pictures(root / folder, ["a.png"])
    assert [file.is_relative_to(root / (found or ".")) for file in load_scene(root, images=given).image_paths] == [True]
    (root / "sparse/0/images.bin").write_bytes(b"")  # the model is not read for it
    assert picture_folders(root, given) == ([] if found is None else [root / found])
    assert picture_folders(tmp_path) == []  # no scene


def _same(some: list[Any], others: list[Any]) -> bool:
    return [(c.name, c.size, c.near, c.distortion, c.viewmat.tolist(), c.K.tolist()) for c in some] == [
        (c.name, c.size, c.near, c.distortion, c.viewmat.tolist(), c.K.tolist()) for c in others
    ]


def test_cameras_of_a_model_without_its_pictures_are_those_with_them(tmp_path: Path) -> None:
    names = ["a.png", "b_10.png", "b_9.png"]
    write_model(tmp_path / "sparse/0", names)
    _pictures(tmp_path / "images", names)
    expected = load_scene(tmp_path).undistorted().cameras
    shutil.rmtree(tmp_path / "images")
    assert [camera.name for camera in expected] == ["a.png", "b_9.png", "b_10.png"]
    for path in (tmp_path, tmp_path / "sparse/0"):
        assert _same(load_cameras(path), expected)


POSES = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2 * x], [0, 0, 0, 1]] for x in range(3)]
LENS = {"w": 16, "h": 12, "fl_x": 20.0, "k1": 0.01}


def _frames(names: list[Any]) -> list[dict[str, Any]]:
    named = [{} if name is None else {"file_path": name} for name in names]
    return [one | {"transform_matrix": pose} for one, pose in zip(named, POSES, strict=False)]


def _write_transforms(file: Path, names: list[Any]) -> Path:
    file.write_text(json.dumps({**LENS, "frames": _frames(names)}))
    return file


def test_cameras_of_a_transforms_json_without_its_pictures_are_those_with_them(tmp_path: Path) -> None:
    names = ["images/b.png", "images/a.png", "./train/r_0.5"]
    file = _write_transforms(tmp_path / "transforms.json", names)
    for name in [*names[:2], "train/r_0.5.png"]:
        write_picture(tmp_path / name, 12, 16)
    expected = load_scene(tmp_path).undistorted().cameras
    for name in ("images", "train"):
        shutil.rmtree(tmp_path / name)
    assert [camera.name for camera in expected] == ["a.png", "b.png", "train/r_0.5.png"]
    for path in (tmp_path, file):
        assert _same(load_cameras(path), expected)


def test_cameras_need_no_names_and_keep_their_order(tmp_path: Path) -> None:
    file = _write_transforms(tmp_path / "path.json", [None, None, ""])
    cameras = load_cameras(file)
    assert [camera.name for camera in cameras] == ["0000.png", "0001.png", "0002.png"]
    assert [camera.center[0] for camera in cameras] == [0, 1, 2]
    outside = _write_transforms(file, ["../../secret.png", "/etc/b.png", "C:\\c.png"])
    assert [camera.name for camera in load_cameras(outside)] == ["C:/c.png", "b.png", "secret.png"]


def test_without_a_size_cameras_are_as_large_as_their_pictures(tmp_path: Path) -> None:
    file = _write_transforms(tmp_path / "transforms_test.json", ["r_0"])
    values = json.loads(file.read_text())
    file.write_text(json.dumps({key: value for key, value in values.items() if key not in "wh"}))
    with pytest.raises(SceneError, match=tells(file, "frame 0, w:", "a finite number", "got None")):
        load_cameras(file)
    write_picture(tmp_path / "r_0.png", 12, 16)
    assert load_cameras(file)[0].size == (12, 16)


def test_a_frame_that_is_no_object_is_named(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps({**LENS, "frames": [3]}))
    with pytest.raises(SceneError, match=tells("path.json, frame 0: expected an object", "got 3")):
        load_cameras(file)


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        (["a.png", "a.jpg"], ("path.json:", "names that differ", "'a' twice")),
        (["a\0.png"], ("path.json, frame 0, file_path:", "a file's name")),
        (["a.png", "b\n.png"], ("path.json, frame 1, file_path:", "control characters", r"got 'b\n.png'")),
        (["\x1b[2J.png"], ("path.json, frame 0, file_path:", "control characters", "leave it out")),
        (["/"], ("path.json, frame 0, file_path:", "a file's name")),
        ([3], ("path.json, frame 0, file_path:", "a file's name", "got 3")),
        ([], ("path.json, top level:", "'frames'", "is this a transforms.json")),
    ],
)
def test_cameras_that_cannot_be_used_are_named(tmp_path: Path, names: list[Any], parts: tuple[str, ...]) -> None:
    file = _write_transforms(tmp_path / "path.json", names)
    with pytest.raises(SceneError, match=tells(*parts)):
        load_cameras(file)


def test_where_there_are_no_cameras_the_error_is_that_of_a_scene(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells(tmp_path / "none", "no such")):
        load_cameras(tmp_path / "none")
    with pytest.raises(SceneError, match=tells(tmp_path, "COLMAP model", "transforms.json")):
        load_cameras(tmp_path)
