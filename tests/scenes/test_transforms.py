import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from colmap_models import write_picture
from messages import refused, tells

from kfgs.cameras.projection import project_points
from kfgs.formats.ply import write_ply
from kfgs.scenes import SceneError, load_cameras, load_scene
from kfgs.scenes.transforms import load_transforms

TOP = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 55.0, "cx": 31.0, "cy": 25.0}
# camera at (1, 2, 3), looking along world +x with world +z up: OpenGL axes right = -y, up = +z, back = -x
LOOK_X = [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]


def _write(folder: Path, frames: list[dict[str, Any]] | None = None, name: str = "transforms.json", **top: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    frames = [{"file_path": "images/a.png", "transform_matrix": LOOK_X}] if frames is None else frames
    for frame in frames:
        if isinstance(frame, dict) and str(frame.get("file_path", "")).startswith("images/"):
            write_picture(folder / frame["file_path"])
    values = {key: value for key, value in {**TOP, **top}.items() if value is not None}
    (folder / name).write_text(json.dumps({**values, "frames": frames}))
    return folder / name


def test_opengl_poses_become_colmap_cameras(tmp_path: Path) -> None:
    scene = load_transforms(_write(tmp_path))
    camera = scene.cameras[0]
    torch.testing.assert_close(camera.center, torch.tensor([1.0, 2.0, 3.0]))
    # 5 units ahead (+x): on the principal point; 1 to the right (-y): fx / 5 further; 1 up (+z): fy / 5 higher
    points = torch.tensor([[6.0, 2.0, 3.0], [6.0, 1.0, 3.0], [6.0, 2.0, 4.0], [-4.0, 2.0, 3.0]])
    xy, depth, visible = project_points(camera, points)
    torch.testing.assert_close(xy[:3], torch.tensor([[31.0, 25.0], [41.0, 25.0], [31.0, 14.0]]))
    torch.testing.assert_close(depth, torch.tensor([5.0, 5.0, 5.0, -5.0]))
    assert visible.tolist() == [True, True, True, False]
    assert (camera.name, scene.stem(0), scene.points.shape) == ("a.png", "a", (0, 3))
    assert any(note.startswith("no points") for note in scene.notes)


def test_intrinsics_of_a_frame_count_over_those_at_the_top(tmp_path: Path) -> None:
    frames = [
        {"file_path": "images/a.png", "transform_matrix": LOOK_X},
        {"file_path": "images/b.png", "transform_matrix": LOOK_X[:3], "fl_x": 70.0, "cx": 30.0, "k1": 0.1},
    ]
    scene = load_transforms(_write(tmp_path, frames))
    assert [float(c.K[0, 0]) for c in scene.cameras] == [50, 70]
    assert [float(c.K[0, 2]) for c in scene.cameras] == [31, 30]
    assert scene.cameras[0].distortion is None
    assert scene.cameras[1].distortion is not None
    torch.testing.assert_close(scene.cameras[0].viewmat, scene.cameras[1].viewmat)


def test_blender_scenes(tmp_path: Path) -> None:
    angle = 2 * math.atan(0.5)  # half the width over the focal length is 0.5
    for split, number in (("train", 2), ("test", 1)):
        frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": LOOK_X} for i in range(number)]
        for i in range(number):
            write_picture(tmp_path / split / f"r_{i}.png", 40, 60)
        file = tmp_path / f"transforms_{split}.json"
        file.write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    scene = load_transforms(tmp_path)
    assert [c.name for c in scene.cameras] == ["test/r_0.png", "train/r_0.png", "train/r_1.png"]
    assert scene.splits == {"train": [1, 2], "test": [0]}
    camera = scene.cameras[0]
    assert camera.size == (40, 60)
    torch.testing.assert_close(camera.K, torch.tensor([[60.0, 0, 30], [0, 60, 20], [0, 0, 1]]))
    assert scene.image(1).shape == (40, 60, 3)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"k1": 0, "k2": 0.0, "p1": 0, "p2": 0}, None),
        ({"camera_model": "PINHOLE", "k1": 0.0}, None),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, ("brown_conrady", (0.1, 0.2, 0.3, 0.4))),
        ({"k1": 0.1, "k3": 0.5, "k4": 0}, ("brown_conrady", (0.1, 0.0, 0.0, 0.0, 0.5))),
        (
            {
                "camera_model": "FULL_OPENCV",
                "k1": 0.1,
                "k2": 0.2,
                "p1": 0.3,
                "p2": 0.4,
                "k3": 0.5,
                "k4": 0.6,
                "k6": 0.8,
            },
            ("brown_conrady", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.8)),
        ),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, ("kannala_brandt", (0.1, 0.0, 0.0, 0.4))),
        ({"is_fisheye": True, "k2": 0.2}, ("kannala_brandt", (0.0, 0.2, 0.0, 0.0))),
    ],
)
def test_lenses(tmp_path: Path, values: dict[str, Any], expected: tuple[str, tuple[float, ...]] | None) -> None:
    lens = load_transforms(_write(tmp_path, **values)).cameras[0].distortion
    assert (None if lens is None else (lens.model, lens.coefficients)) == expected


def test_missing_files_are_skipped_and_counted(tmp_path: Path) -> None:
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": LOOK_X} for i in range(4)]
    file = _write(tmp_path, frames)
    (tmp_path / "images/1.png").unlink()
    (tmp_path / "images/3.png").unlink()
    scene = load_transforms(file)
    assert [c.name for c in scene.cameras] == ["0.png", "2.png"]
    assert "2 of 4 frames have no image file: images/1.png, images/3.png" in scene.notes
    for i in (0, 2):
        (tmp_path / f"images/{i}.png").unlink()
    refused(lambda: load_transforms(file), "transforms.json:", "none of 4", "images", "folder", error=SceneError)


def test_images_are_looked_up_in_the_given_folder_first(tmp_path: Path) -> None:
    file = _write(tmp_path / "scene")
    write_picture(tmp_path / "small/a.png")
    assert load_transforms(file, tmp_path / "small").image_paths[0].parent.name == "small"
    assert load_transforms(file, tmp_path / "empty").image_paths[0].parent.name == "images"


def test_without_a_size_every_frame_has_that_of_its_own_picture(tmp_path: Path) -> None:
    """camera_angle_x is across each picture: f = width / 2 / tan(angle / 2)."""
    sizes = [(64, 48), (48, 64), (96, 72)]
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": LOOK_X} for i in range(3)]
    nothing = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy"))
    file = _write(tmp_path, frames, camera_angle_x=0.9, **nothing)
    for i, (width, height) in enumerate(sizes):
        write_picture(tmp_path / f"images/{i}.png", height, width)
    for camera, (width, height) in zip(load_transforms(file).cameras, sizes, strict=True):
        f = width / 2 / math.tan(0.45)
        assert camera.size == (height, width)
        torch.testing.assert_close(camera.K, torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]))
    frames[1]["w"], frames[1]["h"] = 96, 128  # twice as large as its picture
    file = _write(tmp_path / "stated", frames, fl_x=50, **{k: None for k in nothing if k != "fl_x"})
    for i, (width, height) in enumerate(sizes):
        write_picture(tmp_path / f"stated/images/{i}.png", height, width)
        write_picture(tmp_path / f"half/{i}.png", height // 2, width // 2)
    assert [float(camera.K[0, 0]) for camera in load_transforms(file).cameras] == [50, 25, 50]
    halved = load_transforms(file, tmp_path / "half")  # fl_x is about the pictures that the file names
    assert [float(camera.K[0, 0]) for camera in halved.cameras] == [25, 12.5, 25]
    (tmp_path / "stated/images/2.png").unlink()
    assert any("1 of 3 frames have no image file" in note for note in load_transforms(file).notes)


HOSTILE = ("../secret.txt", "/etc/passwd", "x\0y", "x" * 5000, "/", ".")


def test_paths_out_of_the_folder_must_be_images(tmp_path: Path) -> None:
    write_picture(tmp_path / "elsewhere/b.png")
    (tmp_path / "secret.txt").write_text("secret")
    frames = [
        {"file_path": name, "transform_matrix": LOOK_X}
        for name in ("images/a.png", "../elsewhere/b.png", "images\\c.png", *HOSTILE)
    ]
    file = _write(tmp_path / "scene", frames, ply_file_path="y" * 5000)
    write_picture(tmp_path / "scene/images/c.png")
    scene = load_transforms(file)
    assert [c.name for c in scene.cameras] == ["a.png", "b.png", "c.png"]
    assert any("6 of 9 frames have no image file" in note for note in scene.notes)


def test_the_point_cloud_comes_along(tmp_path: Path) -> None:
    columns = {name: np.arange(3, dtype=np.float32) + i for i, name in enumerate("xyz")}
    columns |= {name: np.array([i, 100, 255], dtype=np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    write_ply(tmp_path / "sparse_pc.ply", columns)
    matrix = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    scene = load_transforms(_write(tmp_path, ply_file_path="sparse_pc.ply", applied_transform=matrix))
    assert scene.points.tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]  # in the frame of the poses: nothing is undone
    assert scene.colors.tolist() == [[0, 1, 2], [100, 100, 100], [255, 255, 255]]
    assert scene.notes == ()


def test_point_clouds_elsewhere_or_broken(tmp_path: Path) -> None:
    write_ply(tmp_path / "out.ply", {name: np.zeros(1, np.float32) for name in "xyz"})
    for listed in ("../out.ply", "gone.ply", 7, "a\0b"):
        scene = load_transforms(_write(tmp_path / "scene", ply_file_path=listed))
        assert len(scene.points) == 0
        assert any("is not a file inside" in note for note in scene.notes)
    (tmp_path / "scene/bad.ply").write_bytes(b"ply\nrubbish")
    with pytest.raises(SceneError, match=tells("bad.ply:", "ply_file_path")):
        load_transforms(_write(tmp_path / "scene", ply_file_path="bad.ply"))
    write_ply(tmp_path / "scene/nan.ply", {name: np.full(1, np.nan, np.float32) for name in "xyz"})
    scene = load_transforms(_write(tmp_path / "scene", ply_file_path="nan.ply"))
    assert len(scene.points) == 0
    assert "1 of 1 points of nan.ply are not finite and were left out" in scene.notes


def test_splits_and_masks_of_nerfstudio(tmp_path: Path) -> None:
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": LOOK_X, "mask_path": "m.png"} for i in range(3)]
    names = {"train_filenames": ["images/2.png", "./images/0.png"], "test_filenames": ["images/1.png"]}
    scene = load_transforms(_write(tmp_path, frames, **names))
    assert scene.splits == {"train": [0, 2], "test": [1]}
    assert scene.masks is None
    assert "3 files of mask_path are missing, and those frames have no mask: 'm.png', 'm.png', 'm.png'" in scene.notes


@pytest.mark.parametrize("listed", ["masks/A0.PNG", "masks/a0.jpg", "../masks/a0.png"])
def test_masks_are_found_by_the_rule_of_names(tmp_path: Path, listed: str) -> None:
    write_picture(tmp_path / "scene/images/0.png")
    mask = tmp_path / ("masks" if listed.startswith("..") else "scene/masks") / "a0.png"
    write_picture(mask)
    frame = {"file_path": "images/0.png", "transform_matrix": LOOK_X, "mask_path": listed}
    (found,) = load_transforms(_write(tmp_path / "scene", [frame])).masks
    assert found.samefile(mask)


def test_a_mask_that_is_missing_is_looked_for_in_its_folder_alone(tmp_path: Path, monkeypatch) -> None:
    write_picture(tmp_path / "home/pictures/a0.png")
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": LOOK_X, "mask_path": f"../home/{i}"} for i in "ab"]
    asked: list[Path] = []
    monkeypatch.setattr("kfgs.scenes.transforms.list_images", lambda folder: asked.append(folder) or [])
    scene = load_transforms(_write(tmp_path / "scene", frames))
    assert (scene.masks, asked) == (None, [])


def _frame(**changes: Any) -> list[dict[str, Any]]:
    return [{"file_path": "images/a.png", "transform_matrix": LOOK_X, **changes}]


BAD = [
    ([], {}, ("'frames'", "transforms.json")),
    ([3], {}, ("frame 0:", "'transform_matrix'", "got 3")),
    (_frame(transform_matrix=None), {}, ("poses and lenses of finite numbers", "none in 1 (a.png)")),
    (_frame(transform_matrix=[[1, 2], [3]]), {}, ("transform_matrix:", "expected 4", "got [[")),
    (_frame(transform_matrix=[[1.0, 2.0]]), {}, ("transform_matrix:", "expected 4", "got [[1.0, 2.0]]")),
    (_frame(transform_matrix=[["a"] * 4] * 4), {}, ("transform_matrix:", "expected 4", "got [[")),
    (_frame(transform_matrix=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), {}, ("viewmat:", "rigid")),
    (_frame(transform_matrix=np.diag([-1, 1, 1, 1]).tolist()), {}, ("viewmat:", "reflection")),
    (_frame(transform_matrix=np.transpose(LOOK_X).tolist()), {}, ("(a.png):", "0 0 0 1 as its last row", "transpose")),
    (_frame(fl_x="wide"), {}, ("fl_x:", "got 'wide'")),
    (_frame(fl_x=True), {}, ("fl_x:", "got True")),
    (_frame(fl_x=-5), {}, ("(a.png):", "K[0, 0] (fx):", "got -5.0")),
    (_frame(cx=1e300), {}, ("poses and lenses of finite numbers", "none in 1 (a.png)")),
    (_frame(), {"fl_x": None}, ("'fl_x'", "'camera_angle_x'")),
    (_frame(), {"fl_x": None, "camera_angle_x": 4.0}, ("camera_angle_x:", "(0, pi)", "got 4.0")),
    (_frame(), {"w": 64.5}, ("w and h", "1 to 100000", "got (64.")),
    (_frame(), {"h": 0}, ("w and h", "1 to 100000", "got (64.")),
    (_frame(), {"camera_model": "EQUIRECTANGULAR"}, ("camera_model:", "EQUIRECTANGULAR", "cut perspective views")),
    (_frame(), {"k4": 0.1}, ("k1 k2 p1 p2 k3", "got {'k4': 0.1}", '"FULL_OPENCV"')),
    (_frame(), {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k5": 0.2}, ("k1 k2 k3 k4", "FISHEYE", "got {'k5': 0.2}")),
    (
        _frame(),
        {"is_fisheye": True, "p1": 0.1, "p2": 0.3},
        ("k1 k2 k3 k4", "got {'p1': 0.1, 'p2': 0.3}", "camera_model"),
    ),
    (_frame(), {"camera_model": "PINHOLE", "k1": 0.1}, ("zeros", "camera_model PINHOLE", "got {'k1': 0.1}")),
    (_frame(), {"camera_model": "SIMPLE_PINHOLE", "p2": 0.1}, ("zeros", "camera_model SIMPLE_PINHOLE")),
]


@pytest.mark.parametrize(("frames", "top", "message"), BAD)
def test_bad_files_are_refused(tmp_path: Path, frames: list[Any], top: dict[str, Any], message: str) -> None:
    refused(lambda: load_transforms(_write(tmp_path, frames, **top)), *message, error=SceneError)


def test_the_fox(shared_data: Path) -> None:
    scene = load_transforms(shared_data / "fox")
    assert len(scene.cameras) == len(list((shared_data / "fox/images").iterdir())) == 50
    assert any(note.startswith("17 of 67 frames have no image file: images/0005.jpg") for note in scene.notes)
    assert scene.cameras[0].name == "0001.jpg"
    assert scene.cameras[0].size == (1920, 1080)
    assert scene.distorted
    centers = torch.stack([c.center for c in scene.cameras])
    forward = torch.stack([c.viewmat[2, :3] for c in scene.cameras])
    # the photos circle the fox: all axes pass close to one point, which lies in front of every camera
    A = torch.eye(3) - forward[:, :, None] * forward[:, None, :]
    focus = torch.linalg.solve(A.sum(0), (A @ centers[:, :, None]).sum(0))[:, 0]
    distance = (focus - centers).norm(dim=1)
    assert (((focus - centers) * forward).sum(1) > 0.5 * distance).all()
    _, _, visible = zip(*(project_points(c, focus[None]) for c in scene.undistorted().cameras), strict=True)
    assert torch.cat(visible).float().mean() > 0.9


def test_a_bad_frame_is_taken_out_as_advised(tmp_path: Path) -> None:
    frames = _ring(2)["frames"]
    for bad in ({"transform_matrix": [[1, 2], [3]]}, {"file_path": 7}):
        with pytest.raises(SceneError, match="take the frame out"):
            load_transforms(_write(tmp_path, [*frames, frames[0] | bad]))
    assert len(load_transforms(_write(tmp_path, frames))) == 2


def _ring(count: int, **top: Any) -> dict[str, Any]:
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": LOOK_X} for i in range(count)]
    return {"frames": frames, **top}


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train": ["images/0.png", "images/2.png"], "val": ["images/3.png"]}, [0, 2], [3]),  # no test: val is tested
        ({"train": ["0.png"], "val": ["1"], "test": ["./images/2.png", "3.JPG"]}, [0], [2, 3]),
        ({"val": ["images/3.png"]}, [0, 1, 2], [3]),  # no list of training views: all that is not held out
        ({"train": ["images/0.png", "images/1.png"], "test": ["images/1.png"]}, [0], [1]),
    ],
)
def test_lists_of_views_are_obeyed(tmp_path: Path, lists: Any, train: list[int], test: list[int]) -> None:
    named = {f"{name}_filenames": words for name, words in lists.items()}
    scene = load_transforms(_write(tmp_path, **_ring(4, **named)))
    assert (scene.splits["train"], scene.splits["test"]) == (train, test)
    assert scene.splits.get("val", test) == ([1] if "3.JPG" in str(lists) else test)


def test_wrong_lists_are_told(tmp_path: Path) -> None:
    unknown = _ring(4, train_filenames=["images/0.png", "images/1_.png"], val_filenames=["images/3.png"])
    (note,) = (note for note in load_transforms(_write(tmp_path, **unknown)).notes if "not in the scene" in note)
    assert note.startswith("1 names in ")
    assert note.endswith("images/1_.png (did you mean '1.png'?)")
    both = _ring(4, train_filenames=["0.png", "1.png"], test_filenames=["1.png"])
    assert any(
        "1 views for training are validation" in note for note in load_transforms(_write(tmp_path, **both)).notes
    )
    every = _ring(2, train_filenames=["0.png", "1.png"], test_filenames=["0.png", "1.png"])
    scene = load_transforms(_write(tmp_path, **every))
    assert scene.splits == {"train": [0, 1], "test": []}
    assert any("none is held out" in note for note in scene.notes)


def test_blender_without_test_views_is_tested_on_validation_views(tmp_path: Path) -> None:
    for name, count in (("train", 3), ("val", 2), ("test", 1)):
        for i in range(count):
            write_picture(tmp_path / name / f"r_{i}.png")
    for name, count in (("train", 3), ("val", 2)):
        frames = [{"file_path": f"./{name}/r_{i}", "transform_matrix": LOOK_X} for i in range(count)]
        _write(tmp_path, frames, f"transforms_{name}.json")
    scene = load_transforms(tmp_path)
    assert [scene.cameras[i].name for i in scene.splits["test"]] == ["val/r_0.png", "val/r_1.png"]
    assert len(scene.splits["train"]) == 3
    _write(tmp_path, [{"file_path": "./test/r_0", "transform_matrix": LOOK_X}], "transforms_test.json")
    names = [camera.name for camera in load_transforms(tmp_path).cameras]
    assert names == ["test/r_0.png", *(f"train/r_{i}.png" for i in range(3))]


@pytest.mark.parametrize("listed", ["images/A.JPG", "images\\A.jpg", "/home/me/room/images/A.png", "A.tif", "images/a"])
def test_a_picture_is_found_by_a_name_that_is_spelled_otherwise(tmp_path: Path, listed: str) -> None:
    file = _write(tmp_path, [{"file_path": "images/A.jpg", "transform_matrix": LOOK_X}])
    content = json.loads(file.read_text())
    content["frames"][0]["file_path"] = listed
    file.write_text(json.dumps(content), encoding="utf-8-sig")
    scene = load_transforms(file)
    assert [camera.name for camera in scene.cameras] == ["A.jpg"]
    assert any("spelled otherwise" in note for note in scene.notes) == (listed != "images\\A.jpg")


def test_broken_frames_are_left_out_and_scales_removed(tmp_path: Path) -> None:
    frames = _ring(5)["frames"]
    matrix = np.array(LOOK_X, float)
    frames[1]["transform_matrix"] = [[float("nan")] * 4] * 4
    frames[2]["fl_x"] = float("inf")
    matrix[:3, :3] *= 1.0005
    matrix[3, 3] = 1 + 1e-8
    frames[3]["transform_matrix"] = matrix.tolist()
    del frames[4]["transform_matrix"]
    file = _write(tmp_path, frames)
    scene = load_scene(file)
    assert [camera.name for camera in scene.cameras] == ["0.png", "3.png"]
    torch.testing.assert_close(scene.cameras[1].viewmat, scene.cameras[0].viewmat)  # the centre stays
    broken = "3 views have no pose or lens of finite numbers and were left out: 1.png, 2.png, 4.png"
    assert broken in scene.notes
    assert "1 poses have a scale (1.0005) or a rounded rotation, which was removed: 3.png" in scene.notes
    assert [camera.name for camera in load_cameras(file)] == ["0.png", "3.png"]
    refused(lambda: load_scene(file, strict=True), file, broken, "without --strict", error=SceneError)
