import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

import kfgs
from kfgs.cameras import Camera
from kfgs.features import FeatureFolder, Picture, discard_maps, extract_features, read_manifest
from kfgs.features.manifest import Manifest
from kfgs.features.writer import LOCK
from kfgs.scenes import Scene

STEMS = ["a", "b", "sub/c"]


class Counting:
    """A teacher that keeps account of its calls: each cell's mean colour, and its products with a seeded matrix."""

    name = "counting"

    def __init__(self, *, dim: int = 5, weights: str = "w1", cell: int = 2) -> None:
        self.identity = {"name": self.name, "options": {"cell": cell}, "weights": weights}
        self.calls: list[float] = []
        self.matrix = torch.randn(dim, 3, generator=torch.Generator().manual_seed(int(weights[1:])))
        self.cell = cell

    def encode_image(self, image):
        assert torch.is_inference_mode_enabled()
        self.calls.append(float(image.mean()))
        return torch.einsum("dc,chw->dhw", self.matrix, torch.nn.functional.avg_pool2d(image, self.cell))

    def encode_text(self, prompts):
        raise NotImplementedError


def paint(path: Path, seed: int, size: tuple[int, int] = (6, 8)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    values = torch.randint(0, 256, (*size, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    Image.fromarray(values.numpy()).save(path)


@pytest.fixture
def pictures(tmp_path):
    found = [Picture(stem, tmp_path / "images" / f"{stem}.png") for stem in STEMS]
    for i, picture in enumerate(found):
        paint(picture.path, i)
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.npy"))}


def test_a_map_is_the_teachers_with_channels_last_in_half_precision(pictures, tmp_path):
    teacher = Counting()
    manifest = extract_features(teacher, pictures, tmp_path / "maps")
    for picture in pictures:
        cells = np.asarray(Image.open(picture.path), np.float64).reshape(3, 2, 4, 2, 3).mean((1, 3)) / 255
        expected = cells @ teacher.matrix.double().numpy().T
        found = np.load(tmp_path / "maps" / f"{picture.stem}.npy", mmap_mode="r")
        assert found.dtype == np.float16
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)  # half precision has 11 bits
    assert set(manifest.maps) == set(STEMS)
    assert manifest == read_manifest(tmp_path / "maps")
    assert manifest.teacher == teacher.identity
    record = manifest.maps["sub/c"]
    assert (record.file, record.image, record.shape) == ("sub/c.npy", "c.png", (3, 4, 5))
    assert record.bytes == (tmp_path / "maps" / "sub" / "c.npy").stat().st_size


def test_what_is_there_is_not_made_again(pictures, tmp_path):
    lines: list[str] = []
    extract_features(Counting(), pictures[:2], tmp_path / "maps")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "maps").glob("*.npy")}
    again = Counting()
    extract_features(again, pictures, tmp_path / "maps", report=lines.append)
    assert len(again.calls) == 1
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert lines[0].startswith("features: 2 maps found, 1 to make by counting (0.0 MB, about ")
    assert len(lines) == 1


def test_a_changed_picture_a_damaged_and_a_missing_map_are_made_again_and_named(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    paint(pictures[0].path, 100)
    (folder / "b.npy").write_bytes(whole["b.npy"][:-7])
    (folder / "sub" / "c.npy").unlink()
    lines: list[str] = []
    again = Counting()
    extract_features(again, pictures, folder, report=lines.append)
    assert len(again.calls) == 3
    assert "a: the picture has changed; making it again" in lines[1]
    assert f"b: its map has changed ({len(whole['b.npy']) - 7} bytes instead of {len(whole['b.npy'])})" in lines[2]
    assert "sub/c: its map is missing" in lines[3]
    found = contents(folder)
    assert found["a.npy"] != whole["a.npy"]
    assert {**found, "a.npy": b""} == {**whole, "a.npy": b""}


def test_a_map_of_the_same_length_that_changed_is_noticed_and_a_copied_one_is_not_redone(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    (folder / "a.npy").write_bytes(whole["a.npy"][:-1] + b"\x01")
    os.utime(folder / "b.npy", (1, 1))
    again = Counting()
    manifest = extract_features(again, pictures, folder)
    assert len(again.calls) == 1
    assert contents(folder) == whole
    assert manifest.maps["b"].mtime_ns == 1_000_000_000


@pytest.mark.parametrize("other", [Counting(weights="w2"), Counting(cell=1)])
def test_another_teachers_maps_are_neither_mixed_nor_lost(other, pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    what = "weights: w1 there, w2 now" if other.identity["weights"] == "w2" else "cell: 2 there, 1 now"
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "same teacher", f"others ({what})")):
        extract_features(other, pictures[:1], folder)
    assert contents(folder) == whole
    manifest = extract_features(other, pictures[:1], folder, overwrite=True)
    assert set(manifest.maps) == {"a"}  # nothing of the first is left
    assert list(contents(folder)) == ["a.npy"]
    assert contents(folder)["a.npy"] != whole["a.npy"]


def test_maps_of_other_programs_are_left_alone(pictures, tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    np.save(folder / "a.npy", np.ones((3, 4, 5)))
    for overwrite in (False, True):
        with pytest.raises(
            ValueError, match=tells(f"{folder}: ", "a.npy", "features.json", "another folder")
        ) as caught:
            extract_features(Counting(), pictures, folder, overwrite=overwrite)
        assert "overwrite" not in str(caught.value)
        assert list(folder.iterdir()) == [folder / "a.npy"]
        assert np.load(folder / "a.npy").sum() == 60
    (folder / "a.npy").unlink()
    extract_features(Counting(), pictures, folder)
    (folder / "a_s.npy").touch()
    extract_features(Counting(), pictures, folder)  # half of what LangSplat writes is nothing
    (folder / "a_f.npy").touch()
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "a_s.npy")):
        extract_features(Counting(), pictures, folder)
    (folder / "a_s.npy").unlink()
    (folder / "b_fmap_CxHxW.pt").touch()
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "b_fmap_CxHxW.pt")):
        extract_features(Counting(), pictures, folder, overwrite=True)


CHILD = """
import os, sys, time, torch
from pathlib import Path
from kfgs.features import Picture, extract_features

class Slow:
    name = "slow"
    identity = {"name": "slow", "weights": "w1"}

    def encode_image(self, image):
        with open(sys.argv[2], "a") as log:
            log.write("call\\n")
        if sys.argv[3] == "slow" and sum(1 for _ in open(sys.argv[2])) == 3:
            time.sleep(3600)  # until it is killed
        return image[:, ::2, ::2].repeat(7, 1, 1)

    def encode_text(self, prompts):
        raise NotImplementedError

root = Path(sys.argv[1])
pictures = [Picture(path.stem, path) for path in sorted((root / "images").glob("*.png"))]
extract_features(Slow(), pictures, root / sys.argv[4])
"""


def start_child(root: Path, log: Path) -> subprocess.Popen[bytes]:
    env = dict(os.environ, PYTHONPATH=str(Path(kfgs.__file__).parents[1]), OMP_NUM_THREADS="1")
    return subprocess.Popen([sys.executable, "-c", CHILD, str(root), str(log), "slow", "maps"], env=env)


def test_killed_in_the_middle_it_goes_on_and_redoes_no_picture(tmp_path, monkeypatch):
    for i in range(5):
        paint(tmp_path / "images" / f"{i}.png", i)
    log, folder = tmp_path / "log", tmp_path / "maps"
    child = start_child(tmp_path, log)
    while not log.exists() or len(log.read_text().split()) < 3:
        assert child.poll() is None
        time.sleep(0.05)
    child.send_signal(signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    assert sorted(contents(folder)) == ["0.npy", "1.npy"]
    assert set(read_manifest(folder).maps) == {"0", "1"}
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path), str(log), "quick", "maps"])
    exec(CHILD, {})
    assert len(log.read_text().split()) == 3 + 3  # the third was in hand
    assert sorted(path.name for path in folder.iterdir()) == [LOCK, *(f"{i}.npy" for i in range(5)), "features.json"]
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path), str(tmp_path / "log2"), "quick", "whole"])
    exec(CHILD, {})
    assert contents(folder) == contents(tmp_path / "whole")


def test_a_map_without_a_record_is_that_of_a_killed_process(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures[:1], folder)
    np.save(folder / "b.npy", np.zeros(3))  # killed between the map and the manifest
    extract_features(Counting(), pictures, folder)
    assert np.load(folder / "b.npy").shape == (3, 4, 5)


def test_discarded_maps_leave_their_records_and_are_made_again(pictures, tmp_path):
    folder = tmp_path / "maps"
    made = extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    assert discard_maps(folder) == sum(record.bytes for record in made.maps.values())
    assert contents(folder) == {}
    assert read_manifest(folder).maps == made.maps
    assert read_manifest(folder).discarded
    assert discard_maps(folder) == 0
    part = extract_features(Counting(), pictures[:1], folder)
    assert part.discarded  # two are still gone
    again = extract_features(Counting(), pictures, folder)
    assert not again.discarded
    assert contents(folder) == whole
    assert {stem: one.digest for stem, one in again.maps.items()} == {s: one.digest for s, one in made.maps.items()}


def test_only_what_kfgs_wrote_is_discarded(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    np.save(folder / "b.npy", np.ones(1000))
    with pytest.raises(ValueError, match=tells("b.npy: ", "another file")):
        discard_maps(folder)
    assert len(contents(folder)) == 3
    (tmp_path / "outside.npy").write_bytes(b"mine")
    whole = (folder / "features.json").read_text()
    for name, said in (("../outside.npy", tells("file", "../outside")), ("b.npy", tells("another file", "b.npy"))):
        about = json.loads(whole)
        about["maps"] = {"a": about["maps"]["a"] | {"file": name, "bytes": 4}}
        (folder / "features.json").write_text(json.dumps(about))
        with pytest.raises(ValueError, match=said):
            discard_maps(folder)
    assert (tmp_path / "outside.npy").exists()
    assert len(contents(folder)) == 3
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match=tells("other: ", "features.json", "got none")):
        discard_maps(tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []  # no lock either


def test_a_map_of_the_same_length_that_changed_stops_the_deletion_and_a_copied_one_does_not(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    (folder / "b.npy").write_bytes(whole["b.npy"][:-1] + b"\x01")
    for dry_run in (False, True):
        with pytest.raises(ValueError, match=tells("b.npy: ", "another file")):
            discard_maps(folder, dry_run=dry_run)
    assert len(contents(folder)) == 3
    (folder / "b.npy").write_bytes(whole["b.npy"])
    os.utime(folder / "b.npy", (1, 1))
    assert discard_maps(folder, dry_run=True) == sum(map(len, whole.values()))
    assert len(contents(folder)) == 3
    assert discard_maps(folder) == sum(map(len, whole.values()))


def test_only_the_maps_of_the_views_that_are_named_are_discarded(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    whole = contents(folder)
    before = FeatureFolder(folder, STEMS).digests()
    (folder / "b.npy").write_bytes(b"changed")  # a view that is not asked about
    assert discard_maps(folder, ["a", "sub/c", "a"]) == len(whole["a.npy"]) + len(whole["sub/c.npy"])
    (folder / "b.npy").write_bytes(whole["b.npy"])
    assert contents(folder) == {"b.npy": whole["b.npy"]}
    extract_features(Counting(), pictures[1:2], folder)  # takes note that b is as it was
    maps = FeatureFolder(folder, STEMS)
    assert maps.digests() == before
    assert maps.shape == (3, 4, 5)
    assert np.array_equal(maps[1].numpy(), np.load(folder / "b.npy"))
    with pytest.raises(FileNotFoundError, match=tells("a.npy:", "discarded")):
        _ = maps[0]
    assert discard_maps(folder, ["a"]) == 0
    again, lines = Counting(), []
    manifest = extract_features(again, pictures, folder, report=lines.append)
    assert contents(folder) == whole
    assert (len(again.calls), manifest.discarded) == (2, False)
    assert lines[1:] == [f"features: {stem}: its map was discarded; making it again" for stem in ("a", "sub/c")]


def test_views_without_a_record_are_named_before_any_is_deleted(pictures, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), pictures, folder)
    for dry_run in (False, True):
        with pytest.raises(ValueError, match=tells("stems", "'x'", "features.json", "(1 of 2)", "by hand")):
            discard_maps(folder, ["a", "x"], dry_run=dry_run)
        with pytest.raises(TypeError, match=tells("stems", "list", "'ab'")):
            discard_maps(folder, "ab", dry_run=dry_run)
        with pytest.raises(ValueError, match=tells(f"{tmp_path / 'images'}: ", "features.json", "got none")):
            discard_maps(tmp_path / "images", ["a"], dry_run=dry_run)
    assert len(contents(folder)) == 3
    assert discard_maps(folder, []) == 0
    assert len(contents(folder)) == 3


def test_foreign_maps_in_our_folder_do_not_pass_for_ours_when_the_call_dies(pictures, tmp_path):
    folder = tmp_path / "maps"
    Manifest(Counting().identity).save(folder)
    for stem in ("a", "b"):
        np.save(folder / f"{stem}.npy", np.full((3, 4, 5), 7, np.float16))

    def dies(image):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_features(_Broken(dies), pictures, folder, overwrite=True)  # at the second
    assert np.load(folder / "b.npy").max() == 7
    with pytest.raises(ValueError, match=tells("b.npy:", "features.json")):
        FeatureFolder(folder, ["a", "b"])
    extract_features(Counting(), pictures, folder)
    assert FeatureFolder(folder, ["a", "b"])[1].max() < 7


def test_what_a_manifest_says_of_its_teacher_is_shown_in_one_line(pictures, tmp_path):
    folder = tmp_path / "maps"
    evil = {"name": "a\n\x1b[31mOK", "k\ney": {"deep": ["b\n\x07"]}, "weights": "\r" + "x" * 100}
    folder.mkdir()
    Manifest(evil).save(folder)
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "same teacher")) as caught:
        extract_features(Counting(), pictures, folder)
    text = str(caught.value)
    assert text.isprintable()
    assert r"name: a\n\x1b[31mOK there, counting now" in text
    assert r"k\ney: " in text
    assert r"weights: \rxxxxxxxxxx... there, w1 now" in text


def test_pictures_called_like_langsplats_files(pictures, tmp_path):
    named = [Picture(stem, pictures[i % 3].path) for i, stem in enumerate(("x_s", "x_f", "x", "y_f", "y"))]
    folder = tmp_path / "maps"
    extract_features(Counting(), named, folder)
    again = Counting()
    extract_features(again, [*named, Picture("y_s", pictures[0].path)], folder)
    assert len(again.calls) == 1
    stems = ["x", "x_f", "x_s", "y", "y_f", "y_s"]
    assert FeatureFolder(folder, stems).digests() == FeatureFolder(folder).digests()
    assert [file.name for file in FeatureFolder(folder, stems).files] == [f"{stem}.npy" for stem in stems]


def test_a_function_is_a_teacher_and_other_things_are_none(pictures, tmp_path):
    def thumbnail(image):
        return image[:, ::2, ::2]

    manifest = extract_features(thumbnail, pictures, tmp_path / "maps")
    assert manifest.teacher["name"] == "thumbnail"
    assert manifest.maps["a"].shape == (3, 4, 3)
    with pytest.raises(TypeError, match=tells("teacher:", "got str")):
        extract_features("lseg", pictures, tmp_path / "other")
    assert not (tmp_path / "other").exists()


class _Broken(Counting):
    def __init__(self, change):
        super().__init__()
        self.change = change

    def encode_image(self, image):
        features = super().encode_image(image)
        return self.change(features) if len(self.calls) == 2 else features


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda f: f.index_fill(0, torch.tensor([1]), torch.nan),
            ("finite", "b.png", "got 12 NaN"),
        ),
        (lambda f: f * 0 + 70_000, ("65504", "float16", "b.png", "70000", "scale")),
        (
            lambda f: f.index_fill(1, torch.tensor([2]), 1e-9),
            ("6e-8", "float16", "b.png", "got 4", "scale"),
        ),
        (lambda f: f[:3], ("expected 5", "b.png", "a.npy", "got 3")),
        (
            lambda f: f[:, 1:],
            ("(h, w, D)", "(3, 4, 5)", "b.png", "got (2, 4, 5)"),
        ),
        (lambda f: f[None], ("[D, h, w]", "got torch.float32", "(1, 5, 3, 4)")),
    ],
)
def test_what_a_teacher_may_not_return_is_named_and_the_maps_before_stay(change, message, pictures, tmp_path):
    with pytest.raises(ValueError, match=tells(*message)):
        extract_features(_Broken(change), pictures, tmp_path / "maps")
    assert list(contents(tmp_path / "maps")) == ["a.npy"]


def test_a_resumed_run_checks_sizes_against_the_maps_that_are_there(pictures, tmp_path):
    extract_features(Counting(), pictures[:1], tmp_path / "maps")
    changed = Counting()
    changed.cell = 1  # its identity does not tell
    with pytest.raises(
        ValueError, match=tells("teacher 'counting':", "(h, w, D)", "(3, 4, 5)", "b.png", "got (6, 8, 5)")
    ):
        extract_features(changed, pictures, tmp_path / "maps")


def test_a_map_that_is_named_after_its_record_is_shown_in_one_line(pictures, tmp_path):
    folder = tmp_path / "maps"
    named = Picture("a\n\x1b[31m", pictures[0].path)  # a name that Linux allows
    extract_features(Counting(dim=5), [named], folder)
    with pytest.raises(ValueError, match=tells("expected 5", "b.png", "a\\n\\x1b[31m.npy", "got 4")) as caught:
        extract_features(Counting(dim=4), [pictures[1]], folder)
    assert str(caught.value).isprintable()


def test_pictures_of_other_sizes_may_have_maps_of_other_sizes(pictures, tmp_path):
    paint(pictures[1].path, 7, (10, 12))
    manifest = extract_features(Counting(), pictures, tmp_path / "maps")
    assert [manifest.maps[stem].shape for stem in STEMS] == [(3, 4, 5), (5, 6, 5), (3, 4, 5)]


def test_a_full_disk_is_refused_before_the_first_map_with_numbers(pictures, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, 300))
    needed = 3 * 3 * 4 * 5 * 2  # maps, cells, channels, bytes
    assert needed > 300
    with pytest.raises(OSError, match=tells("maps: ", "MB", "3 maps", "RecomputedMaps")):
        extract_features(Counting(), pictures, tmp_path / "maps")
    assert contents(tmp_path / "maps") == {}
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, needed))
    extract_features(Counting(), pictures, tmp_path / "maps")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9, 0))
    extract_features(Counting(), pictures, tmp_path / "maps")  # nothing to do needs nothing
    (tmp_path / "maps" / "a.npy").unlink()
    known = Counting()
    with pytest.raises(OSError, match=tells("maps: ", "1 maps")):
        extract_features(known, pictures, tmp_path / "maps")
    assert known.calls == []  # the size was known from the records


def test_two_processes_on_one_folder_are_refused(pictures, tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    with (folder / LOCK).open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match=tells(f"{folder}: ", "process", "in use")):
            extract_features(Counting(), pictures, folder)
    extract_features(Counting(), pictures, folder)


def test_a_folder_that_cannot_be_written_to_is_named(pictures, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=tells("folder: ", "got a file")):
        extract_features(Counting(), pictures, tmp_path / "file")
    with pytest.raises(OSError, match=tells("/sys/maps", "written", "(")):
        extract_features(Counting(), pictures, "/sys/maps")  # where even root may make nothing


def test_bad_requests_are_refused_before_any_work(pictures, tmp_path):
    teacher = Counting()
    with pytest.raises(ValueError, match=tells("pictures", "at least one", "none")):
        extract_features(teacher, [], tmp_path / "maps")
    with pytest.raises(ValueError, match=tells("pictures", "each stem once", "a", "rename")):
        extract_features(teacher, [pictures[0], pictures[0]], tmp_path / "maps")
    for stem in ("../a", "/a", ""):
        with pytest.raises(ValueError, match=tells("stem:", f"got {stem!r}", "rename")):
            extract_features(teacher, [Picture(stem, pictures[0].path)], tmp_path / "maps")
    with pytest.raises(FileNotFoundError, match=tells("gone.png:", "'gone'")):
        extract_features(teacher, [Picture("gone", tmp_path / "gone.png")], tmp_path / "maps")
    assert not (tmp_path / "maps").exists()
    teacher.identity = {"name": "x", "model": object()}
    with pytest.raises(TypeError, match=tells("teacher.identity:", "JSON")):
        extract_features(teacher, pictures, tmp_path / "maps")
    assert teacher.calls == []


def test_an_identity_of_tuples_is_the_same_after_a_round_trip(pictures, tmp_path):
    teacher = Counting()
    teacher.identity = {"name": "x", "size": (360, 480)}
    extract_features(teacher, pictures, tmp_path / "maps")
    extract_features(teacher, pictures, tmp_path / "maps")
    assert len(teacher.calls) == 3


def test_a_bar_shows_each_picture_and_the_time_left(pictures, tmp_path, capsys):
    extract_features(Counting(), pictures, tmp_path / "maps", progress=True)
    shown = capsys.readouterr().err
    assert re.search(r"3/3 \[\d+:\d+<\d+:\d+", shown)  # time taken < time left
    assert "sub/c" in shown


def test_features_that_are_all_zero_stay_so_and_small_ones_are_kept(pictures, tmp_path):
    teacher = _Broken(lambda f: f.index_fill(2, torch.tensor([1]), 0) * 1e-6 + f.index_fill(0, torch.arange(5), 0))
    extract_features(teacher, pictures, tmp_path / "maps")
    found = np.load(tmp_path / "maps" / "b.npy")
    assert not found[:, 1].any()
    assert found[:, [0, 2, 3]].any(-1).all()


@pytest.fixture
def scene(pictures):
    cameras = [Camera(torch.eye(4), torch.eye(3), 8, 6, name=f"{picture.stem}.png") for picture in pictures]
    paths = [picture.path for picture in pictures]
    return Scene(
        cameras, paths, torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8), {"train": [0, 2], "test": [1]}
    )


@pytest.mark.parametrize(
    ("split", "stems"),
    [
        ({}, ["a", "sub/c"]),
        ({"split": "train"}, ["a", "sub/c"]),
        ({"split": "test"}, ["b"]),
        ({"split": "all"}, STEMS),
        ({"split": [2, 1]}, ["sub/c", "b"]),
        ({"split": ["b", "a.png"]}, ["b", "a"]),
    ],
)
def test_a_scene_and_a_split_name_the_views_to_encode_and_to_read(split, stems, scene, pictures, tmp_path):
    manifest = extract_features(Counting(), scene, tmp_path / "maps", **split)
    assert list(manifest.maps) == stems
    maps = FeatureFolder(tmp_path / "maps").of(scene, **split)
    assert (maps.stems, maps.sizes) == (stems, [(6, 8)] * len(stems))
    chosen = [next(picture for picture in pictures if picture.stem == stem) for stem in stems]
    extract_features(Counting(), chosen, tmp_path / "listed")
    assert contents(tmp_path / "maps") == contents(tmp_path / "listed")


def test_views_that_a_scene_does_not_have_are_named(scene, pictures, tmp_path):
    for wrong in ("val", ["x"], [7]):
        with pytest.raises(ValueError, match=tells(wrong if isinstance(wrong, str) else wrong[0])):
            extract_features(Counting(), scene, tmp_path / "maps", split=wrong)
    for wrong in ("scene", tmp_path, ["a"]):
        with pytest.raises(TypeError, match=tells("pictures", "Scene", type(wrong).__name__, "load_scene")):
            extract_features(Counting(), wrong, tmp_path / "maps")
    with pytest.raises(ValueError, match=tells("split", "list of pictures", "'test'")):
        extract_features(Counting(), pictures, tmp_path / "maps", split="test")
    extract_features(Counting(), scene, tmp_path / "maps")
    with pytest.raises(FileNotFoundError, match=tells("1 views", "b.npy", "kfgs features")):
        FeatureFolder(tmp_path / "maps").of(scene, "test")


def test_what_a_notebook_shows_of_a_folder_is_short(scene, tmp_path):
    folder = tmp_path / "maps"
    manifest = extract_features(Counting(), scene, folder)
    assert repr(manifest) == "Manifest(2 maps by counting)"
    assert repr(FeatureFolder(folder)) == f"FeatureFolder({str(folder)!r})"
    assert repr(FeatureFolder(folder).of(scene)) == f"FeatureFolder({str(folder)!r}, 2 views)"
    discard_maps(folder)
    assert repr(read_manifest(folder)) == "Manifest(2 maps by counting, discarded)"
    assert "\n" not in repr(Manifest({"name": "a\nb"}))


def test_a_folder_that_is_refused_stays_as_it_is(pictures, tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    np.save(folder / "a.npy", np.zeros((2, 2, 2), np.float16))
    before = contents(folder)
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "a.npy")):
        extract_features(Counting(), pictures, folder)
    assert [path.name for path in folder.iterdir()] == ["a.npy"]
    assert contents(folder) == before
