"""`kfgs segment` for other programs: COCO's JSON with its pictures, and the label pictures of a camera path."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image
from small_room import make_desk

from kfgs.cameras import orbit_cameras
from kfgs.cli import main
from kfgs.cli.render import read_walk, walk_of
from kfgs.evaluation.coco import load_coco_labels
from kfgs.fields import SemanticField
from kfgs.pipeline import segment_cameras, write_coco
from kfgs.scenes import load_cameras, load_scene


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return make_desk(tmp_path_factory.mktemp("desk"))


def segment(desk, out, *words):
    return main(["segment", str(desk / "run" / "field.kfgs"), "--out", str(out), *map(str, words)])


def read(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def as_predicted(labels):
    return torch.where(labels < 0, 255, labels).numpy()


def test_coco_of_the_views_of_a_split_has_their_photographs(desk, tmp_path, capsys):
    assert segment(desk, tmp_path, "--coco") == 0
    assert segment(desk, tmp_path, "--coco") == 0  # its own files may be replaced
    assert str(tmp_path / "coco") in capsys.readouterr().out
    scene = load_scene(desk / "scene")
    truth = load_coco_labels(tmp_path / "coco" / "annotations.json")
    assert truth.names == SemanticField.load(desk / "run" / "field.kfgs").classes.names
    assert set(truth.maps) == {scene.stem(i) for i in scene.views("test")}
    for i in scene.views("test"):
        stem = scene.stem(i)
        assert np.array_equal(as_predicted(truth.maps[stem]), read(tmp_path / "predicted" / f"{stem}.png"))
        assert np.array_equal(read(tmp_path / "coco" / "images" / f"{stem}.png"), read(scene.image_paths[i])[..., :3])


@pytest.mark.parametrize("path", ["orbit", "cameras"])
def test_a_path_is_segmented_with_the_colours_that_it_sees(desk, tmp_path, path, capsys):
    words = ["--path", path, "--frames", 3, "--coco"]
    assert segment(desk, tmp_path, *words) == 0
    said = capsys.readouterr().out
    for name in ("predicted", "colored", "coco"):
        assert str(tmp_path / name) in said
    written = json.loads((tmp_path / "coco" / "annotations.json").read_text())
    assert len(written["images"]) == 3
    truth = load_coco_labels(tmp_path / "coco" / "annotations.json")
    for one in written["images"]:
        seen = read(tmp_path / "predicted" / one["file_name"])
        assert seen.shape == (one["height"], one["width"])
        assert seen.shape[1] == 480
        assert np.array_equal(as_predicted(truth.maps[one["file_name"].removesuffix(".png")]), seen)
        assert len(np.unique(read(tmp_path / "coco" / "images" / one["file_name"]).reshape(-1, 3), axis=0)) > 50
    assert len(np.unique(read(tmp_path / "predicted" / "{}".format(written["images"][0]["file_name"])))) > 2


def test_a_path_alone_gives_label_pictures(desk, tmp_path):
    assert segment(desk, tmp_path, "--path", "cameras", "--frames", 2) == 0
    assert {one.name for one in tmp_path.iterdir()} == {"predicted", "colored"}


def test_cameras_of_your_own(desk, tmp_path):
    field = SemanticField.load(desk / "run" / "field.kfgs")
    orbit = orbit_cameras(field.gaussians.means)[:2]
    cameras = [camera.resized(30, 40) for camera in orbit]
    found = segment_cameras(field, cameras, field.classes, tmp_path)
    assert list(found) == [camera.name for camera in cameras]
    expected = field.segment(cameras[0], field.classes)
    assert torch.equal(found[cameras[0].name], expected)
    assert np.array_equal(read(tmp_path / "predicted" / f"{cameras[0].name}.png"), as_predicted(expected))
    folder = write_coco(tmp_path, found, field.classes.names)
    assert [path.name for path in folder.iterdir()] == ["annotations.json"]
    with pytest.raises(ValueError, match=tells("cameras:", "a name of its own")):
        segment_cameras(field, [cameras[0], cameras[0]], field.classes, tmp_path)


def own_cameras(folder, cameras, name="{}"):
    """A transforms.json without pictures, as another program writes one."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    frames = []
    for i, camera in enumerate(cameras):
        fx, fy, cx, cy = (float(camera.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        pose = (torch.linalg.inv(camera.viewmat) @ flip).tolist()
        lens = {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        frames.append({"file_path": name.format(i), "transform_matrix": pose, **lens})
    folder.mkdir()
    (folder / "path.json").write_text(json.dumps({"frames": frames}))
    return folder / "path.json"


def test_exactly_the_cameras_of_a_file_are_segmented(desk, tmp_path, capsys):
    field = SemanticField.load(desk / "run" / "field.kfgs")
    cameras = [camera.resized(30 + i, 40) for i, camera in enumerate(field.cameras[:3])]
    file = own_cameras(tmp_path / "in", cameras, "views/v_{}.jpg")
    assert segment(desk, tmp_path / "out", "--path", file, "--coco") == 0
    capsys.readouterr()
    for i, camera in enumerate(cameras):
        expected = as_predicted(field.segment(camera, field.classes))
        found = read(tmp_path / "out" / "predicted" / "views" / f"v_{i}.png")
        assert found.shape == camera.size
        assert (found != expected).mean() < 2e-3  # the inverse of a pose is rounded: a pixel or two at an edge
        assert read(tmp_path / "out" / "coco" / "images" / "views" / f"v_{i}.png").shape[:2] == camera.size


def test_own_cameras_draw_from_the_depth_from_which_those_of_the_scene_do(desk, tmp_path):
    cameras = SemanticField.load(desk / "run" / "field.kfgs").cameras
    moved = dataclasses.replace(
        cameras[0], viewmat=cameras[0].viewmat + torch.eye(4)[3] * 1e-3 * torch.tensor([[1], [0], [0], [0]])
    )
    file = own_cameras(tmp_path / "in", [cameras[0], moved])  # a millimetre apart: as a scene, it is a tiny one
    assert load_cameras(file)[0].near < 1e-3
    assert {camera.near for camera in walk_of(read_walk(file, None), None, cameras, None)} == {cameras[0].near}


def test_a_path_through_the_cameras_of_a_scene_without_pictures(desk, tmp_path):
    (tmp_path / "scene").mkdir()
    shutil.copytree(desk / "scene" / "sparse", tmp_path / "scene" / "sparse")
    assert segment(desk, tmp_path / "out", "--path", tmp_path / "scene", "--frames", 4) == 0
    assert sorted(one.name for one in (tmp_path / "out" / "predicted").iterdir()) == [
        f"path_{i:04d}.png" for i in range(4)
    ]
    assert read(tmp_path / "out" / "predicted" / "path_0000.png").shape == (60, 80)


PLACES = ("expected orbit, cameras, a transforms.json (a name that ends in .json), or a folder with a COLMAP model,",)


def test_cameras_of_your_own_are_checked_before_the_field_is_opened(tmp_path, capsys):
    (tmp_path / "broken.json").write_text("{")
    words = ["--path", str(tmp_path / "broken.json"), "--out", str(tmp_path / "o")]
    assert main(["segment", str(tmp_path / "no_field"), *words]) == 1
    assert "broken.json:" in capsys.readouterr().err
    assert main(["render", str(tmp_path / "no_field"), *words[:-1], str(tmp_path / "a.gif")]) == 1
    assert "broken.json:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--path", "orbit", "--frames", "0"], ("--frames:", "got 0")),
        (["--path", "orbitt"], ("--path:", *PLACES, "got orbitt")),
        (
            ["--path", "{scene}/classes.json"],
            ("{scene}/classes.json, top level:", "'frames'", "is this a transforms.json"),
        ),
        (["--path", "{scene}/labels"], ("--path:", *PLACES, "got {scene}/labels")),
        (["--path", "{scene}/../run"], ("--path:", *PLACES, "got {scene}/../run; `--path cameras`")),
        (["--path", "{scene}/../my.ply"], ("--path:", *PLACES, "my.ply")),
        (["--path", "/dev/null"], ("--path:", *PLACES, "got /dev/null")),
        (
            ["--path", "{one}", "--frames", "3"],
            ("--frames:", "two different cameras", "got 1 in {one}", "leave it out"),
        ),
        (["--path", "{same}", "--frames", "3"], ("--frames:", "got 3 that are all at one place and angle in {same}")),
        (["--path", "orbit", "--frames", "99999999999"], ("--frames:", "[2, 100000]", "got 99999999999")),
        (["--path", "{large}"], ("--path:", "16384 x 16384", "got 60000 x 2 in {large}")),
        (["--path", "{huge}"], ("{huge}, frame 0", "got 60,000 x 60,000; give a smaller size")),
    ],
)
def test_options_that_would_have_no_effect_are_named(desk, tmp_path, words, parts, capsys):
    cameras = load_scene(desk / "scene").cameras[:1]
    known = {"scene": desk / "scene", "one": own_cameras(tmp_path / "in", cameras)}
    known |= {"same": own_cameras(tmp_path / "same", cameras * 3)}
    for name, width, height in (("large", 60_000, 2), ("huge", 60_000, 60_000)):
        known[name] = own_cameras(tmp_path / name, cameras)
        frames = json.loads(known[name].read_text())["frames"]
        known[name].write_text(json.dumps({"frames": [frames[0] | {"w": width, "h": height}]}))
    assert segment(desk, tmp_path / "o", *(word.format(**known) for word in words)) == 1
    error = capsys.readouterr().err
    for part in parts:
        assert part.format(**known) in error
    assert not (tmp_path / "o").exists()
