"""Rendered rooms: paths, truth and files in a room of two boxes; and, where there are renderer and data, a real one."""

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import rooms
import rooms_path
from PIL import Image
from rooms_path import CLEARANCE, Lens

from kfgs.evaluation import find_labels
from kfgs.scenes import load_scene

HIGH = np.array([5.0, 4.0, 2.8])  # metres; the room begins at 0
TABLE = np.array([[2.0, 1.6, 0.0], [3.0, 2.4, 1.3]])
CENTRE = np.array([1.0, 1.0, 1.5])
LENS = Lens(64, 48, 40.0)
SOURCES = Path(__file__).resolve().parents[3] / "shared" / "data" / "rooms"
NAMES = [file.stem for file in sorted(Path(rooms.__file__).with_suffix("").glob("*.json"))]


def trace(origins, directions):
    """Distances, and the number of the surface: 0 floor, 1 ceiling, 2 walls, 3 table."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.where(directions > 0, (HIGH - origins) / directions, -origins / directions)
        ends[directions == 0] = np.inf
        enter, leave = np.sort((TABLE[:, None] - origins) / directions, axis=0)
    distance, axis = ends.min(-1), ends.argmin(-1)
    part = np.where(axis < 2, 2, np.where(directions[:, 2] > 0, 1, 0))
    first, last = enter.max(-1), leave.min(-1)
    table = (first < last) & (last > 0)
    return np.where(table, np.where(first > 0, first, last), distance), np.where(table, 3, part)


def distances(origins, directions):
    return trace(origins, directions)[0]


def to_surface(points):
    """The distance to the walls or the table, in closed form."""
    outside = np.maximum(np.maximum(TABLE[0] - points, points - TABLE[1]), 0)
    return np.minimum(np.minimum(points, HIGH - points).min(-1), np.linalg.norm(outside, axis=-1))


def plan(seed=0, train=10, test=4):
    return rooms_path.plan_views(distances, LENS, CENTRE, TABLE.mean(0), train, test, seed)


def test_cameras_stand_free_in_the_room_and_see():
    poses = plan()
    assert [stem.split("_")[0] for stem in poses] == ["train"] * 10 + ["test"] * 4
    eyes = np.stack([pose[:3, 3] for pose in poses.values()])
    assert to_surface(eyes).min() > 0.98 * CLEARANCE  # of 300 rays none is exactly along the shortest way
    assert ((eyes[:, 2] > 0.9) & (eyes[:, 2] < 1.9)).all()
    for pose in poses.values():
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3))
        assert np.linalg.det(pose[:3, :3]) > 0
        assert pose[2, 1] < 0  # the picture is upright: y down
        assert np.median(distances(*LENS.rays(pose)[:2])) > 1.2
    apart = np.linalg.norm(eyes[:10, None] - eyes[None, 10:], axis=-1)
    assert apart.min() > rooms_path.APART


def test_pixels_undo_rays():
    pose = rooms_path.look(CENTRE, np.array([1.0, 0.5, -0.2]))
    origins, directions, lengths = LENS.rays(pose)
    xy, z = LENS.pixels(pose, origins + directions * lengths[:, None] * 3.0)
    rows, columns = np.mgrid[:48, :64].reshape(2, -1)
    assert np.allclose(xy, np.stack([columns, rows], -1) + 0.5)
    assert np.allclose(z, 3.0)
    assert np.isnan(LENS.pixels(pose, CENTRE - pose[:3, 2][None])[0]).all()  # behind
    assert np.allclose(LENS.pixels(pose, (CENTRE + pose[:3, 2])[None])[0], [32, 24])


class TwoBoxes:
    """The room of this test, in place of a rendered one."""

    def trace(self, origins, directions):
        distance, part = trace(origins, directions)
        return distance, 2 * part

    def picture(self, lens, pose):
        return np.full((lens.height, lens.width, 3), 90, np.uint8)


def make_scene(out):
    poses, things = (
        plan(),
        rooms.Things({"floor": [["a"]], "wall": [["b", "c"]], "table": [["d"]]}, ["a", "b", "c", "d"]),
    )
    for stem, pose in poses.items():
        rooms.render_view(TwoBoxes(), things, LENS, pose, out, stem)
    rooms.write_scene(out, LENS, poses, things, seed=0)
    return poses


def test_kfgs_opens_the_scene(tmp_path):
    made = make_scene(tmp_path)
    scene, truth = load_scene(tmp_path), find_labels(tmp_path)
    assert (len(scene.views("train")), len(scene.views("test")), scene.notes) == (10, 4, ())
    assert truth.names == ("floor", "wall", "table")
    for i, camera in enumerate(scene.cameras):
        stem = scene.stem(i)
        pose = made[stem]
        assert np.allclose(np.linalg.inv(camera.viewmat.numpy()), pose, atol=1e-5)
        assert np.allclose(camera.K.numpy(), [[40, 0, 32], [0, 40, 24], [0, 0, 1]])
        origins, directions, lengths = LENS.rays(pose)
        distance, part = trace(origins, directions)
        assert (truth.maps[stem].numpy().ravel() == np.array([0, 1, 1, 2])[part]).all()
        assert np.allclose(np.load(tmp_path / "depth" / f"{stem}.npy").ravel() * lengths, distance, rtol=1e-5)
    away = to_surface(scene.points.numpy().astype(float))
    assert len(scene.points) == rooms.POINTS
    assert np.abs(away).mean() < rooms.POINT_NOISE
    assert not list(tmp_path.rglob("*.part"))


def test_things_name_every_shape():
    table = {"wall": [["a"]], "ceiling": [["a top"]], "chair": [["b"], ["c", "d"]], "void": [["e"]]}
    things = rooms.Things(table, ["a", "b", "c", "d", "e"])
    assert things.instances == ["wall 1", "ceiling 1", "chair 1", "chair 2"]
    assert things.class_ids.tolist() == [0, 1, 2, 2, 2, 2, 2, 2, 255, 255, 255]
    assert things.instance_ids.tolist() == [0, 1, 2, 2, 3, 3, 3, 3, 255, 255, 255]
    assert things.named(["chair 2"]) == ["c", "d"]
    assert things.named(["chair"]) == ["b", "c", "d"]
    with pytest.raises(SystemExit, match="--without: expected things of .*chair 1.*; got sofa"):
        things.named(["sofa"])
    assert (rooms.Things(table, ["a", "b", "e"], ["c", "d"]).class_ids == [0, 1, 2, 2, 255, 255, 255]).all()
    with pytest.raises(SystemExit, match=r"expected its shapes, got \['e'\]"):
        rooms.Things(table, ["a", "b", "c", "d"])
    with pytest.raises(SystemExit, match=r"got no class of \['f'\]"):
        rooms.Things(table, ["a", "b", "c", "d", "e", "f"])


def test_a_folder_without_a_scene_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["rooms.py", str(tmp_path), str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="expected a scene folder with scene.xml, called one of dining-room"):
        rooms.main()


@pytest.mark.parametrize("name", NAMES)
def test_tables_fit_the_published_scenes(name):
    if not (SOURCES / name / "scene.xml").is_file():
        pytest.skip(f"no published scene in {SOURCES / name}")
    about = json.loads((Path(rooms.__file__).with_suffix("") / f"{name}.json").read_text())
    shapes = [e.get("id") for e in rooms.mend(SOURCES / name).iter("shape")]
    things = rooms.Things(about["things"], shapes)
    assert {"wall", "floor", "ceiling"} <= set(things.classes)
    moved = rooms.mend(SOURCES / name, chosen := things.named(about["without"]), (1.0, 0.0, 0.5))
    assert 0 < len(moved.findall("shape/transform/translate[@z='0.5']")) == len(chosen) < len(shapes)


def test_a_room_is_rendered_and_continued(tmp_path, monkeypatch, capsys):
    if find_spec("mitsuba") is None or find_spec("pyoidn") is None:
        pytest.skip("mitsuba and pyoidn are not installed")
    if not (SOURCES / "living-room").is_dir():
        pytest.skip(f"no published scenes in {SOURCES}")
    words = [SOURCES / "living-room", tmp_path, "--train", 12, "--test", 1, "--size", "64x48", "--spp", 1]
    monkeypatch.setattr("sys.argv", ["rooms.py", *map(str, words), "--without", "table"])
    rooms.main()
    assert capsys.readouterr().out.count(" of 14: ") == 14
    picture = tmp_path / "images" / "train_003.png"
    before = picture.read_bytes()
    picture.unlink()
    rooms.main()
    assert capsys.readouterr().out.count(" of 14: ") == 1
    assert picture.read_bytes() == before
    assert len(load_scene(tmp_path).views("test")) == 1
    table = json.loads((tmp_path / "classes.json").read_text()).index("table")
    assert not (np.array(Image.open(tmp_path / "without" / "labels" / "test_000.png")) == table).any()
