import filecmp
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from messages import refused
from skimage.io import imread

from kfgs.cameras.camera import Camera
from kfgs.cameras.projection import project_points, unproject_depth
from kfgs.toy import room_folder as toy
from kfgs.toy.render import walk_cameras
from kfgs.toy.room import CLASSES, ROOM
from kfgs.toy.room_folder import ToyConfig, make_toy_room

SIZES = {"size": (72, 96), "feature_size": (18, 24), "feature_dim": 32, "surface_points": 1500, "sparse_points": 300}
SMALL = ToyConfig(train_views=4, test_views=2, **SIZES)
TINY = replace(SMALL, train_views=2, test_views=1, size=(24, 32), feature_size=(12, 16), feature_dim=16)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return make_toy_room(tmp_path_factory.mktemp("toy") / "room", SMALL)


def read_cameras(folder: Path) -> dict[str, Camera]:
    """By stem, from the COLMAP files alone."""
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    cameras = {}
    for image in model.images.values():
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3] = torch.from_numpy(image.cam_from_world().matrix())
        lens = model.cameras[image.camera_id]
        K = torch.from_numpy(lens.calibration_matrix())
        cameras[Path(image.name).stem] = Camera(viewmat, K, lens.width, lens.height, name=image.name)
    return cameras


def shifted(camera: Camera, dx: float, dy: float) -> Camera:
    K = camera.K.clone()
    K[0, 2] += dx
    K[1, 2] += dy
    return replace(camera, K=K)


def plane_error(camera: Camera, depth: np.ndarray, labels: np.ndarray) -> float:
    """Largest distance (metres) of floor, ceiling and wall pixels from the planes of the room."""
    x, y, z = unproject_depth(camera, torch.from_numpy(depth).double()).unbind(-1)
    X, Y, Z = ROOM[0] / 2, ROOM[1] / 2, ROOM[2]
    off = {"floor": z, "ceiling": z - Z, "wall": torch.minimum((x.abs() - X).abs(), (y.abs() - Y).abs())}
    masks = {name: torch.from_numpy(labels == CLASSES.index(name)) for name in off}
    return max(float(off[name][mask].abs().max()) for name, mask in masks.items() if mask.any())


def test_layout_is_that_of_a_real_scene(room):
    split = json.loads((room / "split.json").read_text())
    assert len(split["train"]) == 4
    assert len(split["test"]) == 2
    stems = split["train"] + split["test"]
    assert sorted(stems) == [f"view_{i:03d}" for i in range(6)]
    assert json.loads((room / "classes.json").read_text()) == list(CLASSES)
    assert np.load(room / "text.npy").shape == (len(CLASSES), 32)
    model = pycolmap.Reconstruction(room / "sparse" / "0")
    assert sorted(image.name for image in model.images.values()) == sorted(f"{stem}.png" for stem in stems)
    for stem in stems:
        image, labels = imread(room / "images" / f"{stem}.png"), imread(room / "labels" / f"{stem}.png")
        assert (image.shape, image.dtype) == ((72, 96, 3), np.uint8)
        assert (labels.shape, labels.dtype) == ((72, 96), np.uint8)
        assert labels.max() < len(CLASSES)
        assert image.std() > 20  # a picture, not a grey card
        depth = np.load(room / "depth" / f"{stem}.npy")
        assert (depth.shape, depth.dtype) == ((72, 96), np.float32)
        features = torch.load(room / "features" / f"{stem}_fmap_CxHxW.pt", weights_only=True)
        assert (features.shape, features.dtype) == ((32, 18, 24), torch.float16)
    assert len([p for p in room.rglob("*") if p.is_file()]) == 6 * 4 + 5 + 5


def test_test_cameras_stand_between_training_cameras():
    cameras, testing = walk_cameras(24, 12, (192, 256))
    assert sum(testing) == 12
    assert not testing[0]
    centers = torch.stack([camera.center for camera in cameras])
    for i in np.flatnonzero(testing):
        before, after = (centers[(i + k) % len(cameras)] for k in (-1, 1))
        assert not testing[i - 1]
        assert (centers[i] - (before + after) / 2).norm() < 0.25 * (after - before).norm()
    K = cameras[0].K
    assert abs(float(K[0, 2]) - 128) > 3
    assert abs(float(K[1, 2]) - 96) > 2
    assert float(K[0, 0]) != float(K[1, 1])


def test_depth_and_pixel_convention_are_exact(room):
    for stem, camera in read_cameras(room).items():
        depth, labels = np.load(room / "depth" / f"{stem}.npy"), imread(room / "labels" / f"{stem}.png")
        assert plane_error(camera, depth, labels) < 2e-6  # float32 depth
        assert plane_error(shifted(camera, 0.5, 0.5), depth, labels) > 0.01  # integer pixel centres
        centred = shifted(camera, 48 - float(camera.K[0, 2]), 36 - float(camera.K[1, 2]))
        assert plane_error(centred, depth, labels) > 0.02  # an ignored principal point


def agreement(room: Path, dx: float, dy: float) -> tuple[float, float]:
    """Of the (surface point, training view that sees it) pairs: the share whose pixel shows the point's own tangent
    plane at that place, and the share whose pixel has the point's label."""
    surface = np.load(room / "surface.npz")
    points, outward = (torch.from_numpy(surface[name]).double() for name in ("points", "normals"))
    owner = surface["labels"]
    on_plane = same_label = 0
    cameras = read_cameras(room)
    for stem in json.loads((room / "split.json").read_text())["train"]:
        camera = shifted(cameras[stem], dx, dy)
        facing = ((camera.center - points) * outward).sum(1) > 0
        xy, _, visible = project_points(camera, points)
        rows = (visible & facing).nonzero()[:, 0]
        column, row = xy[rows].floor().long().T.numpy()
        depth = torch.from_numpy(np.load(room / "depth" / f"{stem}.npy")).double()
        gap = unproject_depth(camera, depth)[row, column] - points[rows]
        near = (((gap * outward[rows]).sum(1).abs() < 0.015) & (gap.norm(dim=1) < 0.3)).numpy()
        on_plane += near.sum()
        labels = imread(room / "labels" / f"{stem}.png")
        same_label += (labels[row, column] == owner[rows.numpy()])[near].sum()
    return on_plane / surface["seen"].sum(), same_label / surface["seen"].sum()


def test_surface_points_land_on_their_own_depth_and_label(room):
    surface = np.load(room / "surface.npz")
    assert surface["points"].shape == surface["normals"].shape == (1500, 3)
    assert np.allclose(np.linalg.norm(surface["normals"], axis=1), 1.0, atol=1e-5)
    assert surface["seen"].min() >= 1
    assert surface["seen"].max() <= 4
    plane, label = agreement(room, 0.0, 0.0)
    assert 0.94 < plane < 1.01  # the rest: pixels that an edge cuts
    assert 0.93 < label <= plane
    K = read_cameras(room)["view_000"].K
    assert agreement(room, 0.5, 0.5)[0] < 0.7  # integer pixel centres
    assert agreement(room, 48 - float(K[0, 2]), 36 - float(K[1, 2]))[0] < 0.5  # an ignored principal point


def test_sparse_model_is_near_the_surface_but_for_a_few_outliers(room):
    model = pycolmap.Reconstruction(room / "sparse" / "0")
    assert len(model.points3D) == 300
    xyz = np.array([p.xyz for p in model.points3D.values()])
    outside = (np.abs(xyz) > np.array(ROOM) * [0.5, 0.5, 1.0] + 0.06).any(1)
    assert 1 <= outside.sum() <= 6
    assert np.array([p.color for p in model.points3D.values()]).std() > 20
    cameras = read_cameras(room)
    distances = []
    for image in model.images.values():
        seen = [p for p in image.points2D if p.has_point3D()]
        assert len(seen) == len(image.points2D) > 20
        world = torch.from_numpy(np.array([model.points3D[p.point3D_id].xyz for p in seen]))
        xy, _, visible = project_points(cameras[Path(image.name).stem], world)
        errors = (xy - torch.from_numpy(np.array([p.xy for p in seen]))).norm(dim=1)[visible]
        distances.append(errors.median())
    assert 0.1 < np.median(distances) < 1.0
    assert all(p.track.length() >= 1 for p in model.points3D.values())


def test_same_seed_same_bytes_other_seed_other_room(tmp_path):
    paths = [make_toy_room(tmp_path / name, replace(TINY, seed=seed)) for name, seed in (("a", 5), ("b", 5), ("c", 6))]
    names = sorted(str(p.relative_to(paths[0])) for p in paths[0].rglob("*") if p.is_file())
    _, different, failed = filecmp.cmpfiles(paths[0], paths[1], names, shallow=False)
    assert (different, failed) == ([], [])
    same, _, _ = filecmp.cmpfiles(paths[0], paths[2], names, shallow=False)
    assert {Path(n).name for n in same} <= {"classes.json", "split.json", "cameras.bin", "frames.bin", "rigs.bin"}


def test_an_existing_room_is_reused_or_refused(tmp_path):
    path = make_toy_room(tmp_path / "room", TINY)
    before = (path / "text.npy").stat().st_mtime_ns
    assert make_toy_room(path, TINY) == path
    assert (path / "text.npy").stat().st_mtime_ns == before
    refused(lambda: make_toy_room(path, replace(TINY, seed=1)), "room:", "toy room", "'seed': 1", error=FileExistsError)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("irreplaceable")
    refused(lambda: make_toy_room(tmp_path / "mine", TINY), "mine:", "toy room", "other files", error=FileExistsError)
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "irreplaceable"


def test_a_failed_run_leaves_nothing(tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("disk full")

    monkeypatch.setattr(toy, "_write_geometry", fail)
    with pytest.raises(RuntimeError, match="disk full"):
        make_toy_room(tmp_path / "room", TINY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train_views": 1}, ("train_views:", "got 1")),
        ({"test_views": 0}, ("test_views:", "got 0")),
        ({"test_views": 5}, ("test_views:", "[1, 4]", "got 5")),
        ({"size": (72,)}, ("size:", "(height, width)", "got (72,)")),
        ({"size": (72, 4)}, ("size (width):", "got 4")),
        ({"size": (72.0, 96)}, ("size (height):", "got 72.0")),
        ({"feature_size": (80, 24)}, ("feature_size:", "(72, 96)", "got (80, 24)")),
        ({"feature_dim": 8}, ("feature_dim:", "16", "got 8")),
        ({"sparse_points": 1501}, ("sparse_points:", "[10, 1500]", "got 1501")),
        ({"seed": -1}, ("seed:", "got -1")),
    ],
)
def test_a_bad_configuration_is_refused(change, message):
    refused(lambda: replace(SMALL, **change), *message)
