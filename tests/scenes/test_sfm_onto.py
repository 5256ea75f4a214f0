"""New images in a known scene: placed, without moving the old ones."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from cases_sfm import downsized
from messages import tells
from oracles_cameras import align_similarity
from PIL import Image

from kfgs.cli import main
from kfgs.scenes import SceneError, SfmConfig, extend_sfm, load_scene, read_model, run_sfm

CONFIG = SfmConfig(max_features=2000, num_threads=1)


@pytest.fixture(scope="module")
def door(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of the first 6 of 8 images; the others in new/."""
    root = tmp_path_factory.mktemp("door")
    downsized(shared_data / "lund_door/images", root / "all", 8)
    for i, file in enumerate(sorted((root / "all").iterdir())):
        target = root / ("scene/images" if i < 6 else "new") / file.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, target)
    run_sfm(root / "scene/images", root / "scene", config=CONFIG)
    (root / "scene/classes.json").write_text('["door"]')
    return root


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def test_new_images_are_placed_and_old_ones_stay_bit_for_bit(door: Path, tmp_path: Path) -> None:
    before = files_of(door / "scene")
    report = extend_sfm(door / "new", door / "scene", tmp_path / "larger", config=CONFIG)
    assert files_of(door / "scene") == before
    assert (report.registered, report.total, report.missing) == (8, 8, ())
    assert report.mean_reprojection_error < 0.6
    old, new = read_model(door / "scene/sparse/0"), read_model(tmp_path / "larger/sparse/0")
    poses = {image.name: image for image in new.images.values()}
    for image in old.images.values():
        assert np.array_equal(image.pose, poses[image.name].pose)
        assert new.cameras[poses[image.name].camera_id] == old.cameras[image.camera_id]
    assert len(new.cameras) == 1
    assert len(new.points) > len(old.points)
    scene = load_scene(tmp_path / "larger", split="all")
    assert [camera.name for camera in scene.cameras] == sorted(file.name for file in (door / "all").iterdir())
    assert (tmp_path / "larger/classes.json").read_text() == '["door"]'
    # where a fit of all images at once puts the new ones, in the frame of the old ones
    run_sfm(door / "all", tmp_path / "whole", config=CONFIG)
    whole = load_scene(tmp_path / "whole", images=door / "all", split="all")
    theirs, ours = (np.stack([camera.center.double().numpy() for camera in one.cameras]) for one in (whole, scene))
    scale, rotation, translation = align_similarity(theirs[:6], ours[:6])
    off = np.linalg.norm(scale * theirs @ rotation.T + translation - ours, axis=1)
    assert off[6:].max() < 0.02 * np.linalg.norm(ours - ours.mean(0), axis=1).max()


def test_images_of_another_place_are_refused_and_nothing_is_written(door: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (180, 320, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "other" / "noise.png")
    with pytest.raises(SceneError, match=tells("1 of 1 new images", "got 0", "overlap")):
        extend_sfm(tmp_path / "other", door / "scene", tmp_path / "larger", config=CONFIG)
    assert not (tmp_path / "larger").exists()


def test_what_cannot_be_extended_is_named(door: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError, match=tells("names that the scene does not have", "DSC_0001", "rename")):
        extend_sfm(door / "scene/images", door / "scene", tmp_path / "larger")
    with pytest.raises(SceneError, match=tells("COLMAP model", "kfgs sfm")):
        extend_sfm(door / "new", door / "all", tmp_path / "larger")
    with pytest.raises(FileNotFoundError, match=tells("nothing", "no such folder")):
        extend_sfm(door / "nothing", door / "scene", tmp_path / "larger")
    with pytest.raises(FileExistsError, match=tells("out:", "new folder")):
        extend_sfm(door / "new", door / "scene", door / "all")
    with pytest.raises(ValueError, match=tells("out:", "apart")):
        extend_sfm(door / "new", door / "scene", door / "scene/more")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match=tells("empty", "new images", "none")):
        extend_sfm(tmp_path / "empty", door / "scene", tmp_path / "larger")
    arguments = [
        "sfm",
        str(door / "new"),
        "--out",
        str(tmp_path / "larger"),
        "--onto",
        str(door / "scene"),
        "--replace",
    ]
    assert main(arguments) == 1
    assert "--replace: expected none with --onto" in capsys.readouterr().err
    shutil.copytree(door / "scene", tmp_path / "scene")
    next((tmp_path / "scene/images").iterdir()).unlink()
    with pytest.raises(FileNotFoundError, match=tells("all images of the model", "missing")):
        extend_sfm(door / "new", tmp_path / "scene", tmp_path / "larger")
    assert not (tmp_path / "larger").exists()
