import random
import shutil
import struct
from collections import Counter
from pathlib import Path

import pytest
from colmap_models import CAMERAS, FRAMES, IMAGES, POINTS, RIGS, write_model, write_text_model

from kfgs.scenes import SceneError, check_model
from kfgs.scenes.colmap import read_reconstruction
from kfgs.scenes.colmap_tables import CAMERA_MODELS

LAYOUTS = [(text, rigs) for text in (False, True) for rigs in (False, True)]


def _shape(folder: Path) -> tuple[int, ...]:
    rec = read_reconstruction(folder)
    sizes = sorted(len(image.points2D) for image in rec.images.values())
    return len(rec.cameras), len(rec.images), len(rec.points3D), *sizes


@pytest.mark.parametrize(("text", "rigs"), LAYOUTS)
def test_models_written_by_pycolmap_pass(tmp_path: Path, text: bool, rigs: bool) -> None:
    summary = check_model(write_model(tmp_path / "m", ["a.png", "sub/b.png", "c.png"], text=text, rigs=rigs))
    assert (summary.layout, summary.cameras, summary.images, summary.points) == ("text" if text else "binary", 1, 3, 5)
    assert summary.rigs == (1 if rigs else 0)


def test_camera_models_are_those_of_pycolmap() -> None:
    from colmap_models import pycolmap

    theirs = {}
    for name, member in pycolmap.CameraModelId.__members__.items():
        if int(member) >= 0:
            camera = pycolmap.Camera.create_from_model_id(1, member, 100.0, 64, 48)
            focal = sum(word.strip().startswith("f") for word in camera.params_info.split(","))
            theirs[int(member)] = (name, len(camera.params), focal)
    assert theirs == CAMERA_MODELS


def test_real_models_pass(shared_data: Path) -> None:
    room = check_model(shared_data / "room_0/sparse/0")
    assert (room.layout, room.cameras, room.images, room.points, room.rigs) == ("binary", 1, 180, 18543, 0)
    door = check_model(shared_data / "lund_door/colmap_ground_truth")
    assert (door.layout, door.cameras, door.images, door.points) == ("text", 1, 12, 11384)


@pytest.mark.parametrize("rigs", [False, True])
def test_every_truncation_of_every_binary_file_is_refused(tmp_path: Path, rigs: bool) -> None:
    folder = write_model(tmp_path / "m", ["a.png", "b.png"], rigs=rigs)
    for file in sorted(folder.iterdir()):
        whole = file.read_bytes()
        for length in range(len(whole)):
            file.write_bytes(whole[:length])
            with pytest.raises(SceneError, match=file.name):
                check_model(folder)
        file.write_bytes(whole + b"\0")
        with pytest.raises(SceneError, match="expected the end of the file"):
            check_model(folder)
        file.write_bytes(whole)
    check_model(folder)


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


@pytest.mark.parametrize(("text", "rigs"), LAYOUTS)
def test_corrupt_models_are_refused_or_load_with_equal_shapes(tmp_path: Path, text: bool, rigs: bool) -> None:
    folder = write_model(tmp_path / "m", ["a.png", "b.png"], text=text, rigs=rigs)
    expected = _shape(folder)
    files = {file: file.read_bytes() for file in sorted(folder.iterdir())}
    rng, outcome = random.Random(7), Counter[str]()
    for trial in range(300):
        file = rng.choice(list(files))
        file.write_bytes(_mutate(files[file], rng))
        try:
            found = _shape(folder)  # what passes the check goes to pycolmap: it must neither hang nor eat all memory
        except SceneError:
            outcome["refused"] += 1
        else:
            # a digit or letter lost from a text file can leave a shorter, still consistent model
            assert text or found == expected, f"trial {trial}, {file.name}: {found}"
            outcome["loaded"] += 1
        file.write_bytes(files[file])
    assert outcome["refused"] > 100
    assert outcome["loaded"] > 10  # numbers may change within their bounds: no check can know better


def test_a_huge_count_is_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "m", ["a.png"])
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        file = folder / f"{name}.bin"
        whole = file.read_bytes()
        for count in (2**40, 2**64 - 1):
            file.write_bytes(struct.pack("<Q", count) + whole[8:])
            with pytest.raises(SceneError, match=rf"{name}.bin: expected at most \d+ .*, got {count}"):
                check_model(folder)
        file.write_bytes(whole)


def test_the_message_names_file_place_and_cure(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "m", ["a.png"])
    file = folder / "cameras.bin"
    file.write_bytes(file.read_bytes()[:-5])
    message = r"cameras.bin: expected 32 bytes of parameters of camera 0 \(PINHOLE\) at byte 32, got .* after 27.*copy"
    with pytest.raises(SceneError, match=message):
        check_model(folder)


BAD_TABLES = [
    ({"cameras": CAMERAS.replace("PINHOLE", "BANANA")}, r"cameras.txt, line 1: expected a camera model of .*'BANANA'"),
    ({"cameras": CAMERAS.replace("31 25", "31")}, "line 1: expected parameter 3 of PINHOLE"),
    ({"cameras": CAMERAS.replace("31 25", "31 25 9")}, "expected a line of 8 words, got 9"),
    ({"cameras": CAMERAS.replace("50 55", "-50 55")}, "expected a focal length above 0"),
    ({"cameras": CAMERAS.replace("50 55", "nan 55")}, "finite number, got 'nan'"),
    ({"cameras": CAMERAS.replace("50 55", "1e400 55")}, "finite number, got '1e400'"),
    ({"cameras": CAMERAS.replace("64 48", "0 48")}, "an image of 1 to 100000 pixels a side, got 0 x 48"),
    ({"cameras": CAMERAS.replace("64 48", "64 4800000")}, "got 64 x 4800000"),
    ({"cameras": CAMERAS.replace("64 48", "-64 48")}, r"WIDTH: an integer in \[0, .*, got '-64'"),
    ({"cameras": CAMERAS + CAMERAS}, "line 2: expected an id of its own, got 1 again"),
    ({"cameras": CAMERAS.replace("1 P", "2 P")}, r"image 1: expected a camera of the model \(2\), got camera 1"),
    ({"cameras": ""}, "expected a camera of the model .it has none."),
    ({"images": IMAGES.replace("0.6 0.8", "0 0")}, "line 3: expected a unit quaternion, got .* of length 0"),
    ({"images": IMAGES.replace("0.6 0.8", "6 8")}, "of length 10"),
    ({"images": IMAGES.replace("1 2 3 1 b", "1 x 3 1 b")}, "TY: a finite number, got 'x'"),
    ({"images": IMAGES.replace("b.png", "b c.png")}, r"without spaces, got 'b c.png'.*write the model as binary"),
    ({"images": IMAGES.replace("b.png", "../b.png")}, r"file name inside the image folder, got '../b.png'"),
    ({"images": IMAGES.replace("b.png", "/etc/b.png")}, "inside the image folder, got '/etc/b.png'"),
    (
        {"images": IMAGES.replace("b.png", "a.png")},
        r"image 2: expected a name of its own, got 'a.png' again .as image 1",
    ),
    ({"images": IMAGES.replace("2 0.6", "1 0.6")}, "line 3: expected an id of its own"),
    ({"images": IMAGES.removesuffix("5 6 7\n")}, "line 3: expected a line of 2-D points"),
    ({"images": IMAGES.replace("5 6 7", "5 6")}, "line 4: expected 2-D points as X Y POINT3D_ID, got 2 words"),
    ({"images": IMAGES.replace("5 6 7", "5 six 7")}, "line 4: expected 2-D points as X Y POINT3D_ID"),
    (
        {"images": IMAGES.replace("5 6 7", "")},
        "point 7: expected a track .*2-D point 0 of image 2, an image that has 0",
    ),
    ({"images": IMAGES.replace("5 6 7", "5 6 8")}, "2-D point 0 of image 2, which sees point 8"),
    ({"points3D": POINTS.replace("1 0 2 0", "9 0 2 0")}, "2-D point 0 of image 9, an image that is not in the model"),
    ({"points3D": POINTS.replace("1 0 2 0", "1 99 2 0")}, "2-D point 99 of image 1, an image that has 2 2-D points"),
    ({"points3D": POINTS + POINTS}, "expected each point id once"),
    ({"points3D": POINTS.replace("10 20 30", "10 256 30")}, r"G: an integer in \[0, 255\], got '256'"),
    ({"points3D": POINTS.replace("1 2 3", "1 2 1e30")}, "Z: a finite number"),
    ({"points3D": POINTS.replace("1 0 2 0", "1 0 2")}, "expected a track as IMAGE_ID POINT2D_IDX, got 3 words"),
    ({"rigs": RIGS}, "expected rigs.txt and frames.txt together, got 1 rigs and 0 frames"),
    ({"rigs": RIGS.replace("CAMERA 1", "CAMERA 5"), "frames": FRAMES}, "rig 1: expected a camera of the model"),
    ({"rigs": RIGS.replace("CAMERA", "SONAR"), "frames": FRAMES}, "expected a sensor type of .*'SONAR'"),
    ({"rigs": "1 9999999 CAMERA 1\n", "frames": FRAMES}, "rigs.txt, line 1: expected"),
    ({"rigs": RIGS, "frames": FRAMES.replace("2 1 0.6", "2 5 0.6")}, "frame 2: expected a rig of the model, got rig 5"),
    ({"rigs": RIGS, "frames": FRAMES.replace("A 1 2", "A 3 2")}, "frame 2: expected a sensor of rig 1, got sensor 3"),
    ({"rigs": RIGS, "frames": FRAMES.replace("A 1 2", "A 1 1")}, "images of one frame only, got image 1"),
    ({"rigs": RIGS, "frames": FRAMES.splitlines()[0]}, "every image in one frame, got 1 images in none"),
]


@pytest.mark.parametrize(("tables", "message"), BAD_TABLES)
def test_bad_tables_are_refused(tmp_path: Path, tables: dict[str, str], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        check_model(write_text_model(tmp_path, **tables))


def test_honest_variants_pass(tmp_path: Path) -> None:
    variants: list[dict[str, str]] = [
        {},
        {"rigs": RIGS, "frames": FRAMES},
        {"rigs": "# none\n", "frames": ""},
        {"cameras": "# comment\n\n" + CAMERAS.replace("\n", "\r\n")},
        {"images": "1 1 0 0 0 0 0 0 1 a.png\n\n", "points3D": ""},
    ]
    for i, tables in enumerate(variants):
        folder = write_text_model(tmp_path / str(i), **tables)
        check_model(folder)
        assert len(read_reconstruction(folder).images) in (1, 2)


def test_bad_binary_values_are_refused(tmp_path: Path) -> None:
    def refused(name: str, offset: int, layout: str, value: object, message: str) -> None:
        folder = write_model(tmp_path / "m", ["a.png", "b.png"])
        data = bytearray((folder / name).read_bytes())
        struct.pack_into(layout, data, offset, value)
        (folder / name).write_bytes(data)
        with pytest.raises(SceneError, match=message):
            check_model(folder)

    refused("cameras.bin", 12, "<i", 99, r"camera 0: expected a camera model id in 0..17, got 99")
    refused("cameras.bin", 16, "<Q", 0, "expected an image of 1 to 100000")
    refused("cameras.bin", 32, "<d", float("inf"), "finite, plausible parameters")
    refused("images.bin", 12, "<d", float("nan"), "expected a finite pose")
    refused("images.bin", 8 + 4 + 56, "<I", 77, r"image 1: expected a camera of the model \(1\), got camera 77")
    refused("images.bin", 8 + 64, "<B", 0xFF, "UTF-8 name")
    refused("points3D.bin", 16, "<d", float("nan"), "point 0: expected finite coordinates")
    refused("rigs.bin", 16, "<i", 7, r"sensors of type 0 \(camera\) or 1 \(IMU\), got \[7\]")
    refused("frames.bin", 12, "<I", 4, "expected a rig of the model, got rig 4")


def test_missing_folder_and_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such folder; expected a COLMAP model"):
        check_model(tmp_path / "nothing")
    with pytest.raises(SceneError, match="got none of these files"):
        check_model(tmp_path)
    folder = write_model(tmp_path / "m", ["a.png"])
    shutil.move(folder / "points3D.bin", tmp_path / "elsewhere.bin")
    with pytest.raises(SceneError, match=r"all as .bin or all as .txt.*got cameras.bin, images.bin; copy the missing"):
        check_model(folder)


def test_binary_is_read_where_both_are_present(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "m", ["a.png"])
    write_text_model(folder, cameras="rubbish")
    assert check_model(folder).layout == "binary"
