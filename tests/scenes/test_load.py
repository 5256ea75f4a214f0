import json
import shutil
from pathlib import Path
from typing import Any

import pycolmap
import pytest
import torch
from colmap_models import write_model, write_picture
from messages import refused, tells

from kfgs.scenes import SceneError, load_cameras, load_scene


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


def test_a_reconstruction_of_pycolmap_is_a_scene(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sparse/0", ["a.png", "b.png"])
    _pictures(tmp_path / "images", ["a.png", "b.png"])
    made = pycolmap.Reconstruction(model)
    scene, same = load_scene(made, images=tmp_path / "images"), load_scene(tmp_path)
    assert _facts(scene.cameras) == _facts(same.cameras)
    assert (scene.points.tolist(), scene.folder) == (same.points.tolist(), None)
    refused(lambda: load_scene(made), "images:", "Reconstruction", "got None")


def test_a_model_folder_or_a_given_image_folder_will_do(tmp_path: Path) -> None:
    model = write_model(tmp_path / "sparse/0", ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    assert len(load_scene(model)) == 1
    shutil.move(tmp_path / "images", tmp_path / "photos")
    assert load_scene(tmp_path, images=tmp_path / "photos").image_paths[0].parent.name == "photos"
    refused(lambda: load_scene(tmp_path), "(a.png)", "image folder", error=SceneError)
    shutil.copy(tmp_path / "photos/a.png", tmp_path / "a.png")
    assert load_scene(tmp_path).image_paths == [tmp_path / "a.png"]  # beside the model, without images/


@pytest.mark.parametrize(
    ("models", "chosen", "other"),
    [
        ({"sparse/0": 1, "sparse/1": 3}, "sparse/1", "sparse/0"),
        ({"sparse/0": 2, "sparse/1": 2}, "sparse/0", "sparse/1"),  # equal: the lowest number
        ({"sparse/1": 3}, "sparse/1", None),
        ({"sparse": 1, "sparse/0": 2}, "sparse/0", "sparse"),
        ({"sparse/0/models/0": 1, "sparse/0/models/1": 3}, "sparse/0/models/1", "sparse/0/models/0"),  # hloc
        ({"sparse/0": 3, "sparse/0/models/1": 1}, "sparse/0", "sparse/0/models/1"),
        ({"sparse/models/0": 1, "sparse": 2}, "sparse", "sparse/models/0"),
        ({"sparse/0": 1, "sparse/merged": 3}, "sparse/0", None),
        ({"sparse/merged": 2}, "sparse/merged", None),
        ({"dense/sparse": 2}, "dense/sparse", None),
        ({"distorted/sparse/0": 1, "distorted/sparse/1": 2}, "distorted/sparse/1", "distorted/sparse/0"),
        ({"colmap/sparse/0": 1, "colmap/sparse/1": 2}, "colmap/sparse/1", "colmap/sparse/0"),
        ({"models/0": 1, ".": 2}, ".", "models/0"),
    ],
)
@pytest.mark.parametrize("text", [False, True])
def test_of_several_models_the_largest_is_used(
    tmp_path: Path, models: dict[str, int], chosen: str, other: str | None, text: bool
) -> None:
    names = [f"{i}.png" for i in range(4)]
    for place, count in models.items():
        write_model(tmp_path / place, names[:count] if place == chosen else names[-count:], text=text)
    _pictures(tmp_path / "images", names)
    (tmp_path / "split.json").write_text(json.dumps({"train": names[:1] + names[-1:]}))
    scene = load_scene(tmp_path)
    assert [c.name for c in scene.cameras] == names[: models[chosen]]
    notes = [note for note in scene.notes if "of several models" in note]
    if other is None:
        assert not notes
        return
    assert f"{chosen} with {models[chosen]} images is used" in notes[0]
    assert f"{other} with {models[other]} images" in notes[0]
    advised = load_scene(notes[0].rpartition("as in ")[2])  # it works, and the lists of the scene hold there, too
    assert advised.folder == tmp_path / other
    assert [c.name for c in advised.cameras] == names[-models[other] :]
    assert advised.image_paths[0].parent == tmp_path / "images"
    assert advised.splits["train"] == [models[other] - 1]


@pytest.mark.parametrize("text", [False, True])
def test_a_damaged_model_among_several_is_told(tmp_path: Path, text: bool) -> None:
    names = [f"{i}.png" for i in range(9)]
    write_model(tmp_path / "sparse/0", names[:2], text=text)
    write_model(tmp_path / "sparse/1", names, text=text)
    file = tmp_path / "sparse/1" / ("images.txt" if text else "images.bin")
    file.write_bytes(b"\xff" * 99 if text else file.read_bytes()[:600])
    _pictures(tmp_path / "images", names)
    (note,) = (note for note in load_scene(tmp_path).notes if "of several models" in note)
    assert "sparse/0 with 2 images is used" in note
    assert "there is sparse/1, which is damaged too" in note
    with pytest.raises(SceneError, match=tells(file.name, "truncated or damaged")):  # the advice leads to the reason
        load_scene(note.rpartition("as in ")[2])


@pytest.mark.parametrize(("count", "rule"), [(7, "all"), (8, "holdout8")])
def test_the_rule_without_a_split_file(tmp_path: Path, count: int, rule: str) -> None:
    names = [f"{i}.png" for i in range(count)]
    write_model(tmp_path / "sparse/0", names)
    _pictures(tmp_path / "images", names)
    assert any(note.startswith(f"split {rule}:") for note in load_scene(tmp_path).notes)


def test_pictures_beside_a_dense_model_are_its_own(tmp_path: Path) -> None:
    write_model(tmp_path / "dense/sparse", ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    assert load_scene(tmp_path).image_paths == [tmp_path / "images/a.png"]
    _pictures(tmp_path / "dense/images", ["a.png"])
    assert load_scene(tmp_path).image_paths == [tmp_path / "dense/images/a.png"]


@pytest.mark.parametrize(
    ("listed", "files"),
    [
        (["A.JPG", "B.JPG"], ["A.jpg", "B.jpg"]),
        (["A.JPG", "B.JPG"], ["A.png", "B.png"]),
        (["K\u00fcche.png", "b.png"], ["Ku\u0308che.png", "b.png"]),
        (["left\\a.png", "right\\a.png"], ["left/a.png", "right/a.png"]),
        (["images/a.png", "images/b.png"], ["a.png", "b.png"]),
        (["a b.png", "a  (2).png"], ["a b.png", "a  (2).png"]),
    ],
)
def test_pictures_are_found_by_names_that_are_spelled_otherwise(
    tmp_path: Path, listed: list[str], files: list[str]
) -> None:
    write_model(tmp_path / "sparse/0", listed)
    _pictures(tmp_path / "images", files)
    scene = load_scene(tmp_path)
    assert sorted(c.name for c in scene.cameras) == sorted(files)
    assert sorted(scene.image_paths) == sorted(tmp_path / "images" / name for name in files)
    assert all(scene.image(i).shape == (48, 64, 3) for i in range(2))
    assert any("spelled otherwise" in note for note in scene.notes) == (listed != files)
    assert not any("no pose in the model" in note for note in scene.notes)


def test_a_file_is_never_two_views_and_the_nearest_name_is_told(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse/0", ["a.JPG", "a.png", "frame_1.png"])
    _pictures(tmp_path / "images", ["a.jpg", "frame1.png"])
    scene = load_scene(tmp_path)
    assert [c.name for c in scene.cameras] == ["a.jpg"]
    (note,) = (note for note in scene.notes if "2 of 3 posed images have no file" in note)
    assert note.endswith("(did you mean 'frame1.png'?)")
    (tmp_path / "images/a.jpg").rename(tmp_path / "images/a.JPG")
    write_picture(tmp_path / "images/a.png")
    refused(lambda: load_scene(tmp_path), "'a' twice", "move one of the two images away", error=SceneError)
    (tmp_path / "images/a.JPG").unlink()
    assert [c.name for c in load_scene(tmp_path).cameras] == ["a.png"]
    (tmp_path / "images/a.png").unlink()
    words = "none of its 3 posed images", "image folder", "did you mean 'frame1.png'?"
    refused(lambda: load_scene(tmp_path), *words, error=SceneError)


def test_deleted_images_and_broken_poses_are_left_out_and_strict_refuses_them(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "sparse/0", ["a.png", "b.png", "c.png", "d.png"], text=True, rigs=False)
    _pictures(tmp_path / "images", ["a.png", "b.png", "c.png", "d.png"])
    lines = (folder / "images.txt").read_text().splitlines()
    at = {line.split()[-1]: i for i, line in enumerate(lines) if line.endswith(".png")}
    words = lines[at["b.png"]].split()
    scaled = [repr(float(word) * 1.01) for word in words[1:5]]
    lines[at["b.png"]] = " ".join([words[0], *scaled, *words[5:]])
    lines[at["c.png"]] = lines[at["c.png"]].replace(lines[at["c.png"]].split()[5], "nan")
    del lines[at["d.png"] : at["d.png"] + 2]
    before = load_scene(tmp_path)
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    scene = load_scene(tmp_path)
    assert [c.name for c in scene.cameras] == ["a.png", "b.png"]
    assert len(scene.points) == len(before.points)
    torch.testing.assert_close(scene.cameras[1].viewmat, before.cameras[1].viewmat)
    told = " ".join(scene.notes)
    assert "1 views have no pose or lens of finite numbers and were left out: c.png" in told
    assert "5 of 20 entries of tracks lead to no 2-D point" in told
    words = tmp_path, "nothing broken (strict)", "images 4 are not", "without --strict"
    refused(lambda: load_scene(tmp_path, strict=True), *words, error=SceneError)


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
    assert load_scene(tmp_path, split="feature3dgs").splits["test"] == [2, 10, 18]
    (tmp_path / "sparse/0/test.txt").write_text("rgb_1\n")
    assert load_scene(tmp_path).splits["test"] == [0]
    (tmp_path / "split.json").unlink()
    assert load_scene(tmp_path).splits["test"] == [1]  # 3DGS and Occam's LGS put it next to the model


def test_what_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    refused(lambda: load_scene(tmp_path / "nothing"), "nothing:", "no such folder", "scene", error=FileNotFoundError)
    photos = tmp_path / "my photos"
    photos.mkdir()
    advice = f"`kfgs sfm '{photos}' --out scene/`, or run_sfm"
    refused(lambda: load_scene(photos), "COLMAP", "transforms.json", "docs/datasets.md", advice, error=SceneError)
    refused(lambda: load_scene(tmp_path, split="random"), "split:", "'auto'", "got 'random'")
    write_model(tmp_path / "sparse/0", ["a.png"])
    (tmp_path / "sparse/0/points3D.bin").unlink()
    refused(lambda: load_scene(tmp_path), "got cameras.bin, images.bin", "copy", error=SceneError)
    write_model(tmp_path / "sparse/0", ["a.png"])
    _pictures(tmp_path / "images", ["a.png"])
    refused(lambda: load_scene(tmp_path, split="df3dgs"), "6 views", "'df3dgs'", "got 1", error=SceneError)


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


def _facts(cameras: list[Any]) -> list[Any]:
    return [(c.name, c.size, c.near, c.distortion, c.viewmat.tolist(), c.K.tolist()) for c in cameras]


POSES = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2 * x], [0, 0, 0, 1]] for x in range(3)]
LENS = {"w": 16, "h": 12, "fl_x": 20.0, "k1": 0.01}


def _frames(names: list[Any]) -> list[dict[str, Any]]:
    named = [{} if name is None else {"file_path": name} for name in names]
    return [one | {"transform_matrix": pose} for one, pose in zip(named, POSES, strict=False)]


def _write_transforms(file: Path, names: list[Any]) -> Path:
    file.write_text(json.dumps({**LENS, "frames": _frames(names)}))
    return file


def test_cameras_without_their_pictures_are_those_with_them(tmp_path: Path) -> None:
    write_model(tmp_path / "a/sparse/0", ["a.png", "b_10.png", "b_9.png"])
    _pictures(tmp_path / "a/images", ["a.png", "b_10.png", "b_9.png"])
    (tmp_path / "b").mkdir()
    file = _write_transforms(tmp_path / "b/transforms.json", ["images/b.png", "images/a.png", "./train/r_0.5"])
    for name in ("images/b.png", "images/a.png", "train/r_0.5.png"):
        write_picture(tmp_path / "b" / name, 12, 16)
    for folder, other, names in (
        (tmp_path / "a", tmp_path / "a/sparse/0", ["a.png", "b_9.png", "b_10.png"]),
        (tmp_path / "b", file, ["a.png", "b.png", "train/r_0.5.png"]),
    ):
        expected = load_scene(folder).undistorted().cameras
        shutil.rmtree(folder / "images")
        shutil.rmtree(folder / "train", ignore_errors=True)
        assert [camera.name for camera in expected] == names
        for path in (folder, other):
            assert _facts(load_cameras(path)) == _facts(expected)


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
    refused(lambda: load_cameras(file), file, "frame 0, w:", "a finite number", "got None", error=SceneError)
    write_picture(tmp_path / "r_0.png", 12, 16)
    assert load_cameras(file)[0].size == (12, 16)


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        (["a.png", "a.jpg"], ("path.json:", "names that differ", "'a' twice")),
        (["a\0.png"], ("path.json, frame 0, file_path:", "a file's name")),
        (["a.png", "b\n.png"], ("path.json, frame 1, file_path:", "control characters", r"got 'b\n.png'")),
        (["\x1b[2J.png"], ("path.json, frame 0, file_path:", "control characters", "take the frame out")),
        (["/"], ("path.json, frame 0, file_path:", "a file's name")),
        ([3], ("path.json, frame 0, file_path:", "a file's name", "got 3")),
        ([], ("path.json, top level:", "'frames'", "is this a transforms.json")),
    ],
)
def test_cameras_that_cannot_be_used_are_named(tmp_path: Path, names: list[Any], parts: tuple[str, ...]) -> None:
    file = _write_transforms(tmp_path / "path.json", names)
    refused(lambda: load_cameras(file), *parts, error=SceneError)
