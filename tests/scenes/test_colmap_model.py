import random
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from colmap_models import CAMERAS, IMAGES, POINTS, pycolmap, read_with_pycolmap, write_model, write_text_model
from messages import refused, tells

from kfgs._notes import Repair
from kfgs.scenes import SceneError
from kfgs.scenes.colmap_model import CAMERA_MODELS, ColmapModel, read_model

LAYOUTS = [(text, rigs) for text in (False, True) for rigs in (False, True)]


def _read_alike(folder: Path) -> ColmapModel:
    """Read a model with kfgs and with pycolmap; cameras, poses and points must be the same."""
    ours, theirs = read_model(folder), read_with_pycolmap(folder)
    lenses = {i: (c.model_name, c.width, c.height, tuple(c.params)) for i, c in theirs.cameras.items()}
    assert {i: (c.model, c.width, c.height, c.params) for i, c in ours.cameras.items()} == lenses
    names = [{i: (image.name, image.camera_id) for i, image in m.images.items()} for m in (ours, theirs)]
    assert names[0] == names[1]
    for i, image in theirs.images.items():  # pycolmap does not normalise
        np.testing.assert_allclose(ours.images[i].pose[:3], image.cam_from_world().matrix(), rtol=0, atol=1e-6)
        seen = [point.point3D_id if point.has_point3D() else -1 for point in image.points2D]
        assert ours.images[i].observed.tolist() == seen
    assert ours.point_ids.tolist() == sorted(theirs.points3D)
    points = [theirs.points3D[i] for i in sorted(theirs.points3D)]
    assert np.array_equal(ours.points, np.array([point.xyz for point in points]).reshape(-1, 3))
    assert np.array_equal(ours.colors, np.array([point.color for point in points]).reshape(-1, 3))
    return ours


@pytest.mark.parametrize(("text", "rigs"), LAYOUTS)
def test_models_are_read_as_pycolmap_reads_them(tmp_path: Path, text: bool, rigs: bool) -> None:
    model = _read_alike(write_model(tmp_path / "m", ["a.png", "sub/b.png", "c.png"], text=text, rigs=rigs))
    assert (len(model.cameras), len(model.images), len(model.points)) == (1, 3, 5)


@pytest.mark.parametrize("folder", ["room_0/sparse/0", "lund_door/colmap_ground_truth"])
def test_real_models_are_read_as_pycolmap_reads_them(shared_data: Path, folder: str) -> None:
    model = _read_alike(shared_data / folder)
    facts = len(model.cameras), len(model.images), len(model.points)
    assert facts == {"r": (1, 180, 18543), "l": (1, 12, 11384)}[folder[0]]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("name", list(CAMERA_MODELS))
def test_every_camera_model_is_read(tmp_path: Path, name: str, text: bool) -> None:
    params = [50 + i / 7 for i in range(len(CAMERA_MODELS[name].split()))]
    folder = write_model(tmp_path / "m", ["a.png"], text=text, model=name, params=params)
    assert _read_alike(folder).cameras[1].model == name


@pytest.mark.parametrize("text", [False, True])
def test_rigs_place_their_cameras_as_in_pycolmap(tmp_path: Path, text: bool) -> None:
    rng = np.random.default_rng(3)

    def pose() -> object:
        quaternion = rng.normal(size=4)
        return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), rng.normal(size=3))

    rec, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=4)
    for i in (1, 2, 3):
        rec.add_camera(pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 55, 31, 25], camera_id=i))
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2))
    for i in (1, 3):
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, i), pose())
    rec.add_rig(rig)
    for f in range(4):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=4, rig_from_world=pose())
        images = [pycolmap.Image(name=f"{f}_{c}.png", camera_id=c, image_id=10 * f + c) for c in (1, 2, 3)]
        for image in images:
            frame.add_data_id(image.data_id)
        rec.add_frame(frame)
        for image in images:
            image.frame_id = frame.frame_id
            rec.add_image(image)
        rec.register_frame(frame.frame_id)
    (tmp_path / "m").mkdir()
    rec.write_text(tmp_path / "m") if text else rec.write(tmp_path / "m")
    model, theirs = read_model(tmp_path / "m"), read_with_pycolmap(tmp_path / "m")
    assert len(model.images) == 12
    for i, image in model.images.items():
        assert image.pose is not None
        np.testing.assert_allclose(image.pose[:3], theirs.images[i].cam_from_world().matrix(), rtol=0, atol=1e-14)


def test_camera_models_are_those_of_pycolmap() -> None:
    theirs = {}
    for name, member in pycolmap.CameraModelId.__members__.items():
        if int(member) >= 0:
            camera = pycolmap.Camera.create_from_model_id(1, member, 100.0, 64, 48)
            theirs[int(member)] = (name, [word.strip() for word in camera.params_info.split(",")])
    assert theirs == {i: (name, params.split()) for i, (name, params) in enumerate(CAMERA_MODELS.items())}


def test_every_truncation_of_every_binary_file_is_refused(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "m", ["a.png", "b.png"], rigs=False)
    for file in sorted(folder.iterdir()):
        whole = file.read_bytes()
        for length in range(len(whole)):
            file.write_bytes(whole[:length])
            refused(lambda: read_model(folder), file.name, "truncated or damaged", "copy the model", error=SceneError)
        file.write_bytes(whole + b"\0")
        refused(lambda: read_model(folder), "1 bytes follow", error=SceneError)
        file.write_bytes(whole)
    read_model(folder)


def _mutate(data: bytes, rng: random.Random) -> bytes:
    changed, at = bytearray(data), rng.randrange(len(data))
    kind = rng.choice(["flip", "bytes", "cut", "insert", "zero"])
    if kind == "flip":
        changed[at] ^= 1 << rng.randrange(8)
    elif kind == "bytes":
        for _ in range(8):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    elif kind == "cut":
        del changed[at:]
    elif kind == "insert":
        changed[at:at] = rng.randbytes(rng.randrange(1, 20))
    else:
        changed[at : at + 16] = bytes(len(changed[at : at + 16]))
    return bytes(changed)


@pytest.mark.parametrize("text", [False, True])
def test_corrupt_models_are_refused_or_read_whole(tmp_path: Path, text: bool) -> None:
    folder = write_model(tmp_path / "m", ["a.png", "b.png"], text=text, rigs=False)
    files = {file: file.read_bytes() for file in sorted(folder.iterdir())}
    rng, refused = random.Random(7), 0
    for _ in range(300):
        file = rng.choice(list(files))
        file.write_bytes(_mutate(files[file], rng))
        try:
            model = read_model(folder)
        except SceneError:
            refused += 1
        else:  # numbers may change within their bounds: no check can know better
            assert text or (len(model.cameras), len(model.images), len(model.points) >= 4) == (1, 2, True)
            assert np.isfinite(model.points).all()
        file.write_bytes(files[file])
    assert 100 < refused < 290


def test_a_huge_count_is_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "m", ["a.png"])
    for name in ("cameras", "images", "points3D"):
        file = folder / f"{name}.bin"
        whole = file.read_bytes()
        for count in (2**40, 2**64 - 1):
            file.write_bytes(struct.pack("<Q", count) + whole[8:])
            refused(lambda: read_model(folder), f"{name}.bin:", error=SceneError)
        file.write_bytes(whole)


BAD_TABLES = [
    ({"cameras": CAMERAS.replace("PINHOLE", "BANANA")}, ["cameras.txt", "line 1 ", "'BANANA'"]),
    ({"cameras": CAMERAS.replace("31 25", "31")}, ["cameras.txt", "3 parameters, not 4"]),
    ({"cameras": CAMERAS.replace("50 55", "half 55")}, ["'half'"]),
    ({"cameras": CAMERAS.replace("64 48", "0 48")}, ["(0, 48) pixels"]),
    ({"cameras": "# a comment\n" + CAMERAS + CAMERAS}, ["line 3 ", "id 1 again"]),
    ({"cameras": CAMERAS.replace("1 P", "2 P")}, ["expected cameras for all images", "image 1 (camera 1)"]),
    ({"images": IMAGES.replace("1 2 3 1 b", "1 x 3 1 b")}, ["images.txt", "line 3 ", "'x'"]),
    ({"images": IMAGES.replace("2 0.6", "x 0.6")}, ["images.txt", "line 3 ", "'x'"]),
    ({"images": IMAGES.replace("3 1 b", "3 x b")}, ["images.txt", "line 3 ", "'x'"]),
    (
        {"images": IMAGES.replace("1 2 3 1 b.png", "1 2 1 b.png")},
        ["line 3 ", "6 numbers of its pose", "qw qx qy qz tx"],
    ),
    ({"images": IMAGES.replace("b.png", "../b.png")}, ["line 3 ", "inside the image folder", "'../b.png'", "rename"]),
    ({"images": IMAGES.replace("b.png", "/etc/b.png")}, ["inside the image folder", "'/etc/b.png'", "rename"]),
    ({"images": IMAGES.replace("2 0.6", "1 0.6")}, ["line 3 ", "id 1 again"]),
    ({"images": IMAGES.removesuffix("5 6 7\n")}, ["line 3 ", "no", "2-D points"]),
    ({"images": IMAGES.replace("5 6 7", "5 6")}, ["line 4 ", "2-D points as X Y POINT3D_ID"]),
    ({"images": IMAGES.replace("5 6 7", "5 6 7.5")}, ["line 4 ", "'7.5'"]),
    ({"points3D": "1" * 20 + POINTS[1:]}, ["points3D.txt", "line 1 "]),
    ({"points3D": POINTS.replace("1 0 2 0", "1 0 2")}, ["points3D.txt", "line 1 "]),
    ({"points3D": POINTS.replace("1 0 2 0", "1 0 -2 0")}, ["points3D.txt", "-2"]),
    ({"points3D": POINTS + POINTS}, ["points3D.txt", "id 7 again"]),
    ({"points3D": POINTS.replace("10 20 30", "10 256 30")}, ["points3D.txt", "line 1 ", "256"]),
]


@pytest.mark.parametrize(("tables", "parts"), BAD_TABLES)
def test_bad_tables_are_refused(tmp_path: Path, tables: dict[str, str], parts: list[str]) -> None:
    refused(lambda: read_model(write_text_model(tmp_path, **tables)), *parts, error=SceneError)


BROKEN_TRACKS = [
    ({"images": IMAGES.replace("5 6 7", "")}, "2-D point 0 of image 2"),
    ({"images": IMAGES.replace("5 6 7", "5 6 8")}, "2-D point 0 of image 2"),
    ({"points3D": POINTS.replace("1 0 2 0", "9 0 2 0")}, "images 9 are not in the model"),
    ({"points3D": POINTS.replace("1 0 2 0", "1 99 2 0")}, "2-D point 99 of image 1"),
]


@pytest.mark.parametrize(("tables", "place"), BROKEN_TRACKS)
def test_tracks_that_lead_nowhere_are_noted(tmp_path: Path, tables: dict[str, str], place: str) -> None:
    (note,) = read_model(write_text_model(tmp_path, **tables)).notes
    assert isinstance(note, Repair)
    assert note.startswith("1 of 2 entries of tracks lead to no 2-D point")
    assert place in note


def test_images_and_points_of_two_models_are_refused(tmp_path: Path) -> None:
    other = IMAGES.replace("2 7 3", "2 8 3").replace("5 6 7", "5 6 8")
    with pytest.raises(SceneError, match=tells("points3D.txt", "2 that see other points", "files of one model")):
        read_model(write_text_model(tmp_path, images=other))


@pytest.mark.parametrize("place", ["1 2 1e30", "1 -nan(ind) 3"])
def test_points_without_a_finite_place_are_left_out_and_noted(tmp_path: Path, place: str) -> None:
    model = read_model(write_text_model(tmp_path, points3D=POINTS.replace("1 2 3", place)))
    assert model.notes == ("1 of 1 points have no finite place and were left out (ids 7)",)
    assert len(model.points) == 0


@pytest.mark.parametrize("numbers", ["0 0 0 0 1 2 3", "nan 0.8 0 0 1 2 3", "6 8 0 0 1 2 3", "0.6 0.8 0 0 inf 2 3"])
def test_an_image_whose_pose_is_broken_has_none(tmp_path: Path, numbers: str) -> None:
    folder = write_text_model(tmp_path, images=IMAGES.replace("0.6 0.8 0 0 1 2 3", numbers))
    poses = {image.name: image.pose for image in read_model(folder).images.values()}
    assert poses["b.png"] is None
    assert poses["a.png"] is not None


@pytest.mark.parametrize("focal", ["nan", "1e400", "-50"])
def test_the_images_of_a_broken_camera_have_no_pose(tmp_path: Path, focal: str) -> None:
    model = read_model(write_text_model(tmp_path, cameras=CAMERAS.replace("50 55", f"{focal} 55")))
    assert [image.pose for image in model.images.values()] == [None, None]


def test_names_may_hold_blanks_which_colmap_cuts_in_text_files(tmp_path: Path) -> None:
    folder = write_text_model(tmp_path / "m", images=IMAGES.replace("b.png", " my  shot (1).png"))
    assert [image.name for image in read_model(folder).images.values()] == ["a.png", "my  shot (1).png"]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_files_may_begin_with_a_mark(tmp_path: Path, encoding: str) -> None:
    folder = write_text_model(tmp_path, images=IMAGES.replace("b.png", "K\u00fcche.png"))
    for file in folder.iterdir():
        file.write_bytes(file.read_text(encoding="utf-8").encode(encoding))
    assert [image.name for image in read_model(folder).images.values()] == ["a.png", "K\u00fcche.png"]


def test_honest_variants_pass(tmp_path: Path) -> None:
    variants: list[dict[str, str]] = [
        {},
        {"rigs": "rubbish", "frames": "rubbish"},  # the images file has every pose
        {"cameras": "# comment\n\n" + CAMERAS.replace("\n", "\r\n")},
        {"images": "1 1 0 0 0 0 0 0 1 a.png\n\n", "points3D": ""},
    ]
    for i, tables in enumerate(variants):
        folder = write_text_model(tmp_path / str(i), **tables)
        assert len(read_model(folder).images) in (1, 2)


def test_bad_binary_values_are_refused(tmp_path: Path) -> None:
    def bad(name: str, offset: int, layout: str, value: object, *parts: str) -> None:
        folder = write_model(tmp_path / "m", ["a.png", "b.png"])
        data = bytearray((folder / name).read_bytes())
        struct.pack_into(layout, data, offset, value)
        (folder / name).write_bytes(data)
        refused(lambda: read_model(folder), *parts, error=SceneError)

    bad("cameras.bin", 12, "<i", 99, "record 1", "99")
    bad("cameras.bin", 16, "<Q", 0, "(0, 48) pixels")
    bad("images.bin", 8 + 4 + 56, "<I", 77, "cameras for all images", "camera 77")
    bad("images.bin", 8 + 64, "<B", 0xFF, "utf-8")


def test_missing_folder_and_files_are_named(tmp_path: Path) -> None:
    refused(lambda: read_model(tmp_path), "COLMAP", "points3D", "got none", error=SceneError)
    folder = write_model(tmp_path / "m", ["a.png"])
    shutil.move(folder / "points3D.bin", tmp_path / "elsewhere.bin")
    refused(lambda: read_model(folder), ".bin", ".txt", "got cameras.bin, images.bin", "copy", error=SceneError)
