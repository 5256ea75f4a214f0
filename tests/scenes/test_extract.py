"""A teacher's maps on disk: what is written, what is kept, and what is refused."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused, tells
from PIL import Image

import kfgs
from kfgs.cameras import Camera
from kfgs.scenes import FeatureFolder, Scene, extract_features

STEMS = ["a", "b", "sub/c"]


class Counting:
    """A teacher that counts its calls: each cell's mean colour, and its products with a seeded matrix."""

    name = "counting"

    def __init__(self, *, dim: int = 5, weights: str = "w1", cell: int = 2) -> None:
        self.identity = {"name": self.name, "size": (cell, cell), "weights": weights}  # a tuple, which JSON has not
        self.calls = 0
        self.matrix = torch.randn(dim, 3, generator=torch.Generator().manual_seed(int(weights[1:])))
        self.cell = cell

    def encode_image(self, image):
        self.calls += 1
        return torch.einsum("dc,chw->dhw", self.matrix, torch.nn.functional.avg_pool2d(image, self.cell))


def paint(path: Path, seed: int, size: tuple[int, int] = (6, 8)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    values = torch.randint(0, 256, (*size, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8)
    Image.fromarray(values.numpy()).save(path)


def scene_of(paths: dict[str, Path]) -> Scene:
    """Views of 8 x 6 pixels by their stems."""
    cameras = [Camera(torch.eye(4), torch.eye(3), 8, 6, name=f"{stem}.png") for stem in paths]
    nothing, splits = torch.zeros(0, 3), {"train": [0, 2], "test": [1]} if len(paths) == 3 else {}
    return Scene(cameras, list(paths.values()), nothing, nothing.byte(), splits)


@pytest.fixture
def scene(tmp_path):
    paths = {stem: tmp_path / "images" / f"{stem}.png" for stem in STEMS}
    for i, path in enumerate(paths.values()):
        paint(path, i)
    return scene_of(paths)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.npy"))}


def test_a_map_is_the_teachers_with_channels_last_in_half_precision(scene, tmp_path):
    teacher = Counting()
    made = extract_features(teacher, scene, tmp_path / "maps", "all")
    for stem, path in zip(STEMS, scene.image_paths, strict=True):
        cells = np.asarray(Image.open(path), np.float64).reshape(3, 2, 4, 2, 3).mean((1, 3)) / 255
        stored = np.load(tmp_path / "maps" / f"{stem}.npy")
        assert stored.dtype == np.float16
        expected = cells @ teacher.matrix.double().numpy().T
        np.testing.assert_allclose(stored, expected, rtol=1e-3, atol=1e-3)  # half precision has 11 bits
    assert set(made.pictures) == set(STEMS)
    assert FeatureFolder(tmp_path / "maps").identity == made.teacher == {**teacher.identity, "size": [2, 2]}


def test_a_map_that_exists_is_not_made_again_unless_its_picture_changed(scene, tmp_path):
    folder, teacher = tmp_path / "maps", Counting()
    extract_features(teacher, scene, folder, [0, 1])
    whole = contents(folder)
    times = {path: path.stat().st_mtime_ns for path in folder.glob("*.npy")}
    extract_features(teacher, scene, folder, "all")
    assert teacher.calls == 3
    assert {path: path.stat().st_mtime_ns for path in times} == times
    paint(scene.image_paths[0], 100)
    (folder / "sub" / "c.npy").unlink()
    extract_features(teacher, scene, folder, "all")
    assert teacher.calls == 5
    assert contents(folder)["a.npy"] != whole["a.npy"]
    assert contents(folder)["b.npy"] == whole["b.npy"]


@pytest.mark.parametrize("other", [Counting(weights="w2"), Counting(cell=1)])
def test_another_teachers_maps_are_neither_mixed_nor_lost(other, scene, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), scene, folder, "all")
    whole = contents(folder)
    refused(lambda: extract_features(other, scene, folder, [0]), f"{folder}: ", "same teacher", "overwrite")
    assert contents(folder) == whole
    made = extract_features(other, scene, folder, [0], overwrite=True)
    assert set(made.pictures) == {"a"}  # nothing of the first is left
    assert list(contents(folder)) == ["a.npy"]
    assert contents(folder)["a.npy"] != whole["a.npy"]


@pytest.mark.parametrize(("version", "more"), [(None, {}), (2, {"version": "2"})])
def test_a_teacher_is_known_by_its_version_if_it_has_one(version, more, scene, tmp_path):
    teacher = Counting()
    teacher.identity, teacher.version = None, version
    assert extract_features(teacher, scene, tmp_path / "maps").teacher == {"name": "counting"} | more


def test_maps_of_other_programs_are_left_alone(scene, tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    np.save(folder / "a.npy", np.ones((3, 4, 5)))
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=tells(f"{folder}: ", "a.npy", "features.json", "another folder")):
            extract_features(Counting(), scene, folder, "all", overwrite=overwrite)
        assert list(folder.iterdir()) == [folder / "a.npy"]  # no lock file either
        assert np.load(folder / "a.npy").sum() == 60
    (folder / "a.npy").unlink()
    extract_features(Counting(), scene, folder, "all")
    (folder / "b_fmap_CxHxW.pt").touch()
    with pytest.raises(ValueError, match=tells(f"{folder}: ", "b_fmap_CxHxW.pt")):
        extract_features(Counting(), scene, folder, "all", overwrite=True)


CHILD = """
import sys, time
from pathlib import Path
import torch
from kfgs import Camera
from kfgs.scenes import Scene, extract_features

def slow(image):
    with open(sys.argv[2], "a") as log:
        log.write("call\\n")
    if sys.argv[3] == "slow" and sum(1 for _ in open(sys.argv[2])) == 3:
        time.sleep(3600)  # until it is killed
    return image[:, ::2, ::2].repeat(7, 1, 1)

root = Path(sys.argv[1])
paths = sorted((root / "images").glob("*.png"))
cameras = [Camera(torch.eye(4), torch.eye(3), 8, 6, path.name) for path in paths]
extract_features(slow, Scene(cameras, paths, torch.zeros(0, 3), torch.zeros(0, 3)), root / sys.argv[4], "all")
"""


def test_killed_in_the_middle_it_continues_and_redoes_no_picture(tmp_path, monkeypatch):
    for i in range(5):
        paint(tmp_path / "images" / f"{i}.png", i)
    log, folder = tmp_path / "log", tmp_path / "maps"
    env = dict(os.environ, PYTHONPATH=str(Path(kfgs.__file__).parents[1]), OMP_NUM_THREADS="1")
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path), str(log), "slow", "maps"], env=env)
    while not log.exists() or len(log.read_text().split()) < 3:
        assert child.poll() is None
        time.sleep(0.05)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert sorted(contents(folder)) == ["0.npy", "1.npy"]
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path), str(log), "quick", "maps"])
    exec(CHILD, {})
    assert len(log.read_text().split()) == 3 + 3  # the third was in hand
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path), str(tmp_path / "log2"), "quick", "whole"])
    exec(CHILD, {})
    assert contents(folder) == contents(tmp_path / "whole")


class _Broken(Counting):
    def __init__(self, change):
        super().__init__()
        self.change = change

    def encode_image(self, image):
        features = super().encode_image(image)
        return self.change(features) if self.calls == 2 else features


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.index_fill(0, torch.tensor([1]), torch.nan), ("finite", "b.png", "check the weights")),
        (lambda f: f.to_sparse(), ("features: expected a dense tensor", "sparse_coo", "b.png")),
        (lambda f: f * 0 + 70_000, ("65504", "float16", "b.png", "70000", "unit length")),
        (lambda f: f.index_fill(1, torch.tensor([2]), 1e-9), ("6e-8", "float16", "b.png", "unit length")),
        (lambda f: f[:3], ("expected [5, h, w]", "b.png", "got (3, 3, 4)")),
        (lambda f: f[None], ("[5, h, w]", "(1, 5, 3, 4)")),
        (lambda f: f.long(), ("floating-point", "torch.int64")),
    ],
)
def test_what_a_teacher_may_not_return_is_named_and_the_maps_before_stay(change, message, scene, tmp_path):
    with pytest.raises((ValueError, TypeError), match=tells("counting", *message)):
        extract_features(_Broken(change), scene, tmp_path / "maps", "all")
    assert list(contents(tmp_path / "maps")) == ["a.npy"]


def test_features_that_are_all_zero_stay_so_and_small_ones_are_kept(scene, tmp_path):
    teacher = _Broken(lambda f: f.index_fill(2, torch.tensor([1]), 0) * 1e-6)
    extract_features(teacher, scene, tmp_path / "maps", "all")
    stored = np.load(tmp_path / "maps" / "b.npy")
    assert not stored[:, 1].any()
    assert stored[:, [0, 2, 3]].any(-1).all()


def test_pictures_of_other_sizes_may_have_maps_of_other_sizes(scene, tmp_path):
    paint(scene.image_paths[1], 7, (10, 12))
    extract_features(Counting(), scene, tmp_path / "maps", "all")
    assert [tuple(map_.shape) for map_ in FeatureFolder(tmp_path / "maps", STEMS)] == [(3, 4, 5), (5, 6, 5), (3, 4, 5)]


def test_bad_requests_are_refused_before_any_work(scene, tmp_path):
    teacher, folder = Counting(), tmp_path / "maps"
    refused(lambda: extract_features(teacher, scene, folder, []), "split", "at least one", "none")
    for stem in ("../a", "/a"):
        with pytest.raises(ValueError, match=tells("scene:", f"got {stem!r}", "rename")):
            extract_features(teacher, scene_of({stem: scene.image_paths[0]}), folder, "all")
    with pytest.raises(FileNotFoundError, match=tells("gone.png:", "'gone'")):
        extract_features(teacher, scene_of({"gone": tmp_path / "gone.png"}), folder, "all")
    for wrong in ("lseg", Counting):
        with pytest.raises(TypeError, match=tells("teacher:", "encode_image")):
            extract_features(wrong, scene, folder, "all")
    refused(lambda: extract_features(teacher, "scene", folder), "scene:", "Scene", "got str", error=TypeError)
    teacher.identity = {"name": "x", "model": object()}
    refused(lambda: extract_features(teacher, scene, folder, "all"), "teacher.identity:", "JSON", error=TypeError)
    assert teacher.calls == 0
    assert not folder.exists()


def test_a_damaged_manifest_is_named(scene, tmp_path):
    folder = tmp_path / "maps"
    extract_features(Counting(), scene, folder, "all")
    for damaged in ("[]", "{", json.dumps({"format": "kfgs-features/2", "teacher": 3})):
        (folder / "features.json").write_text(damaged)
        refused(lambda: FeatureFolder(folder), folder / "features.json")


@pytest.mark.parametrize(
    ("split", "stems"),
    [
        ({}, ["a", "sub/c"]),
        ({"split": "test"}, ["b"]),
        ({"split": "all"}, STEMS),
        ({"split": [2, 1]}, ["sub/c", "b"]),
        ({"split": ["b", "a.png"]}, ["b", "a"]),
    ],
)
def test_a_scene_and_a_split_name_the_views_to_encode_and_to_read(split, stems, scene, tmp_path):
    made = extract_features(Counting(), scene, tmp_path / "maps", **split)
    assert list(made.pictures) == stems
    maps = FeatureFolder(tmp_path / "maps").of(scene, **split)
    assert (maps.stems, maps.sizes) == (stems, [(6, 8)] * len(stems))


def test_views_that_a_scene_does_not_have_are_named(scene, tmp_path):
    for wrong, error in (("val", ValueError), (["x"], ValueError), ([7], IndexError)):
        part = wrong if isinstance(wrong, str) else wrong[0]
        refused(lambda wrong=wrong: extract_features(Counting(), scene, tmp_path / "maps", wrong), part, error=error)
    extract_features(Counting(), scene, tmp_path / "maps")
    refused(lambda: FeatureFolder(tmp_path / "maps").of(scene, "test"), "b", "kfgs features", error=FileNotFoundError)
