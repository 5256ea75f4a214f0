import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from cases_sfm import WIDTH, downsized
from kornia.io import write_image
from messages import refused, tells
from oracles_cameras import align_similarity
from PIL import Image
from small_room import make_room
from tqdm import tqdm

from kfgs.cli import main
from kfgs.scenes import SceneError, SfmConfig, load_scene, run_sfm
from kfgs.scenes.colmap import import_pycolmap
from kfgs.scenes.sfm import SfmReport, SfmRun, sequential_pairs


def test_sfm_finds_the_true_poses(shared_data: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    images = downsized(shared_data / "lund_door/images", tmp_path / "images", 8)
    (images / "notes.txt").write_text("not an image")
    report = run_sfm(images, tmp_path, config=SfmConfig(max_features=3000), progress=True)
    assert (report.registered, report.total, report.missing) == (8, 8, ())
    assert report.points > 500
    assert report.mean_reprojection_error < 0.6
    assert "8 of 8 images registered" in str(report)
    shown = capfd.readouterr().err
    assert all(stage in shown for stage in ("features", "matching", "mapping", "no count until all are done", "8/8"))

    found = load_scene(tmp_path, split="all")
    truth = load_scene(shared_data / "lund_door", split="all").select(range(8))
    assert [found.stem(i) for i in range(8)] == [truth.stem(i) for i in range(8)]
    ours = torch.stack([c.center for c in found.cameras]).double().numpy()
    theirs = torch.stack([c.center for c in truth.cameras]).double().numpy()
    scale, rotation, translation = align_similarity(ours, theirs)
    error = np.linalg.norm(scale * ours @ rotation.T + translation - theirs, axis=1)
    span = np.linalg.norm(theirs - theirs.mean(0), axis=1).max()
    assert error.max() < 0.02 * span
    for mine, other in zip(found.cameras, truth.cameras, strict=True):
        turn = mine.viewmat[:3, :3].double().numpy() @ rotation.T @ other.viewmat[:3, :3].double().numpy().T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1.0
    factor = WIDTH / truth.cameras[0].width
    assert float(found.cameras[0].K[0, 0]) == pytest.approx(float(truth.cameras[0].K[0, 0]) * factor, rel=0.05)


def test_images_that_share_nothing_are_refused(tmp_path: Path) -> None:
    g = torch.Generator().manual_seed(0)
    images = tmp_path / "images"
    images.mkdir()
    for i in range(3):
        write_image(str(images / f"{i}.png"), torch.randint(0, 255, (3, 60, 80), generator=g, dtype=torch.uint8))
    words = "images:", "3 of 3", "min_registered = 0.9", "got 0", "original photos", "enlarge", "(80x60 pixels)"
    refused(lambda: run_sfm(images, tmp_path / "out", config=SfmConfig(num_threads=1)), *words, error=SceneError)
    assert not (tmp_path / "out").exists()


def test_a_capture_that_lost_its_poses_gets_them_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = make_room(tmp_path / "capture")
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    shutil.move(capture / "sparse", tmp_path / "found")

    def found(images: Path, out: Path, **_: object) -> SfmReport:  # what sfm itself does is tested elsewhere
        shutil.copytree(tmp_path / "found", out / "sparse")
        return SfmReport(9, 9, 1500, 0.5)

    monkeypatch.setattr("kfgs.run_sfm", found)
    assert main(["sfm", str(capture / "images"), "--out", str(capture)]) == 0
    assert "note:" not in capsys.readouterr().out
    assert {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()} == before
    assert len(load_scene(capture).views("train")) == 6
    monkeypatch.undo()
    assert main(["sfm", str(capture / "images"), "--out", str(capture)]) == 1  # poses are never replaced unasked
    assert "--replace" in capsys.readouterr().err


def test_folders_without_enough_images(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=tells("nothing:", "no such folder", "images")):
        run_sfm(tmp_path / "nothing", tmp_path / "out")
    (tmp_path / "a.png").write_bytes(b"")
    refused(lambda: run_sfm(tmp_path, tmp_path / "out"), "3 images", "got 1", error=SceneError)


def test_photographs_of_a_phone_count_until_a_jpeg_is_next_to_them(tmp_path: Path) -> None:
    for name in ("a.HEIC", "b.heic", "b.jpg"):
        (tmp_path / name).touch()
    refused(lambda: run_sfm(tmp_path, tmp_path / "out"), "HEIC", "(a.HEIC)", "mogrify", error=SceneError)
    (tmp_path / "a.jpg").touch()
    refused(lambda: run_sfm(tmp_path, tmp_path / "out"), "3 images", "got 2", error=SceneError)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"matching": "vocabulary"}, ("matching:", "'exhaustive', 'sequential'", "got 'vocabulary'")),
        ({"camera_model": "FOV"}, ("camera_model:", "'SIMPLE_PINHOLE'", "got 'FOV'")),
        ({"min_registered": 0.0}, ("min_registered:", "got 0.0")),
        ({"max_features": 5}, ("max_features:", "got 5")),
        ({"num_threads": 0}, ("num_threads:", "got 0")),
    ],
)
def test_config_is_checked(values: dict[str, object], message: str) -> None:
    refused(lambda: SfmConfig(**values), *message)


def test_pairs_of_a_video_follow_the_natural_order() -> None:
    names = [f"{i}.png" for i in range(1, 41)]
    pairs = sequential_pairs(names)
    assert ("9.png", "10.png") in pairs
    assert {int(b[:-4]) for a, b in pairs if a == "8.png"} == {*range(9, 19), 24, 40}  # 8 + 16, 8 + 32
    assert len(pairs) == len(set(pairs))
    assert all(int(a[:-4]) < int(b[:-4]) for a, b in pairs)


def test_nothing_is_found_where_a_photo_is_masked_or_transparent(tmp_path: Path) -> None:
    pycolmap = import_pycolmap()
    g = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 255, (24, 32, 3), generator=g, dtype=torch.uint8)
    photo = noise.repeat_interleave(4, 0).repeat_interleave(4, 1).numpy()
    half = np.full((96, 128), 255, np.uint8)
    half[:, :64] = 0
    (tmp_path / "images").mkdir()
    names = ["masked.png", "clear.png", "whole.png"]
    for name in names:
        Image.fromarray(photo).save(tmp_path / "images" / name)
    Image.fromarray(np.dstack([photo, half])).save(tmp_path / "images/clear.png")
    Image.fromarray(half).save(tmp_path / "masked.png")
    photos = {name: (tmp_path / "images" / name, None) for name in names} | {
        "masked.png": (tmp_path / "images/masked.png", tmp_path / "masked.png")
    }
    with tqdm(disable=True) as bar:
        run = SfmRun(pycolmap, tmp_path / "images", tmp_path, SfmConfig(num_threads=1), bar, photos)
        run.extract()
    with pycolmap.Database.open(run.database) as database:
        leftmost = {one.name: database.read_keypoints(one.image_id)[:, 0].min() for one in database.read_all_images()}
    assert leftmost["whole.png"] < 32
    assert min(leftmost["masked.png"], leftmost["clear.png"]) >= 64


def test_one_camera_for_the_photos_of_each_size(tmp_path: Path) -> None:
    """COLMAP alone leaves out what is not as large as the first photo."""
    pycolmap = import_pycolmap()
    sizes = {"a.png": (96, 128), "b.png": (128, 96), "c.png": (96, 128), "d.png": (128, 96)}
    for name, size in sizes.items():
        noise = torch.randint(0, 255, (3, *size), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
        write_image(str(tmp_path / name), noise)
    for single, count in ((True, 2), (False, 4)):
        config = SfmConfig(single_camera=single, max_features=100, num_threads=1)
        (scratch := tmp_path / str(single)).mkdir()
        with tqdm(disable=True) as bar:
            photos = {name: (tmp_path / name, None) for name in sizes}
            run = SfmRun(pycolmap, tmp_path, scratch, config, bar, photos)
            run.extract()
        with pycolmap.Database.open(run.database) as database:
            lenses = {camera.camera_id: camera for camera in database.read_all_cameras()}
            of = {image.name: lenses[image.camera_id] for image in database.read_all_images()}
        assert {name: (lens.height, lens.width) for name, lens in of.items()} == sizes
        assert len(lenses) == count


class _Placed:
    """A run of pycolmap that finds models of some images."""

    sizes = (3,)

    def __init__(self, *_: object) -> None:
        pass

    def extract(self) -> None: ...

    def match(self, pairs: object) -> None: ...

    def map(self) -> list[object]:
        return [_Model(size) for size in self.sizes]


class _Model:
    images, points3D = {}, {}  # noqa: N815

    def __init__(self, size: int) -> None:
        self.num_reg_images = lambda: size

    def compute_mean_reprojection_error(self) -> float:
        return 0.0

    def write(self, folder: str) -> None:
        for name in ("cameras", "images", "points3D"):
            (Path(folder) / f"{name}.bin").write_bytes(b"new")


def test_a_split_scene_is_refused_with_counts_and_advice(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("kfgs.scenes.sfm.SfmRun", _Placed)
    monkeypatch.setattr(_Placed, "sizes", (19, 72))
    for i in range(90):
        (tmp_path / f"{i}.png").touch()
    message = ("81 of 90", "72, 19", "matching='exhaustive'", "single_camera=False")
    with pytest.raises(SceneError, match=tells(tmp_path, *message)):
        run_sfm(tmp_path, tmp_path / "out", config=SfmConfig(matching="sequential"))
    run_sfm(tmp_path, tmp_path / "out", config=SfmConfig(min_registered=0.8))


def test_a_model_is_replaced_only_when_asked_and_other_files_stay(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("kfgs.scenes.sfm.SfmRun", _Placed)
    (tmp_path / "photos").mkdir()
    for name in "abc":
        (tmp_path / "photos" / f"{name}.png").touch()
    run_sfm(tmp_path / "photos", tmp_path / "scene")
    model = tmp_path / "scene" / "sparse" / "0"
    (model / "cameras.bin").write_bytes(b"old")
    (model / "notes.txt").write_text("mine")
    refused(lambda: run_sfm(tmp_path / "photos", tmp_path / "scene"), "out:", model, "replace", error=FileExistsError)
    assert (model / "cameras.bin").read_bytes() == b"old"
    run_sfm(tmp_path / "photos", tmp_path / "scene", replace=True)
    assert (model / "cameras.bin").read_bytes() == b"new"
    assert (model / "notes.txt").read_text() == "mine"


def test_files_that_are_no_pictures_are_named(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in "abcd":
        (images / f"{name}.png").write_bytes(b"no picture")
    refused(lambda: run_sfm(images, tmp_path / "scene"), "can be decoded", "a.png", "save them again", error=SceneError)
