import dataclasses
from pathlib import Path

import pytest
import torch
from messages import tells
from small_room import CONFIG, make_room

from kfgs.cameras import Camera, Distortion, undistort
from kfgs.pipeline import fit_scene
from kfgs.pipeline.maps import KnownFeatures, maps_of_views
from kfgs.scenes import FeatureFolder, Scene, load_scene

LENS = Distortion("brown_conrady", (0.3, 0.05, 0.001, -0.002))


class _Maps(list):
    files = (Path("a"), Path("b"))


def _lens(width: int, height: int, distortion: Distortion | None = LENS) -> Camera:
    K = torch.tensor([[0.8 * width, 0.0, 0.52 * width], [0.0, 0.8 * width, 0.47 * height], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), K, width, height, distortion=distortion)


def _views(*lenses):
    cameras = [dataclasses.replace(lens, name=f"{i}.png") for i, lens in enumerate(lenses)]
    scene = Scene(cameras, [Path(camera.name) for camera in cameras], torch.zeros(0, 3), torch.zeros(0, 3).byte())
    return dataclasses.replace(scene.undistorted(), lenses=cameras)


def _straight(maps, lenses):
    return maps_of_views(_views(*lenses), range(len(lenses)), maps)


def test_a_map_is_undistorted_as_the_picture_is_at_its_own_size():
    lens = _lens(160, 120)
    features = torch.rand(30, 40, 5, generator=torch.Generator().manual_seed(0)) + 0.5
    maps = _straight(_Maps([features]), [lens])
    expected, _, inside = undistort(features, lens.resized(30, 40))
    torch.testing.assert_close(maps[0][inside], expected[inside])
    assert (maps[0][~inside] == 0).all()
    assert 0 < int((~inside).sum()) < 600
    assert maps.files == _Maps.files


def test_without_distortion_a_map_is_left_alone():
    features = torch.rand(30, 40, 5)
    assert _straight(_Maps([features]), [_lens(160, 120, None)])[0] is features


def test_blocks_are_the_undistorted_map():
    features = torch.rand(70, 40, 5, generator=torch.Generator().manual_seed(0)) + 0.5
    maps = _straight(_Maps([features, features]), [_lens(160, 280), _lens(160, 280, None)])
    for i in range(2):
        blocks = list(maps.blocks(i))
        assert [len(block) for block in blocks] == [32, 32, 6]
        assert torch.equal(torch.cat(blocks), maps[i])


def test_unknown_pixels_become_nan_and_nothing_else_changes():
    features = torch.ones(2, 2, 3)
    features[0, 1] = 0
    features[1, 1, 0] = 0  # one zero channel is a feature like any other
    known = KnownFeatures(_Maps([features]))[0]
    assert known.isnan().all(-1).tolist() == [[False, True], [False, False]]
    assert torch.equal(known[1], features[1])


def test_counts_must_agree():
    with pytest.raises(ValueError, match=tells("maps:", "expected 1", "got 2")):
        _straight(_Maps([torch.ones(2, 2, 1)] * 2), [_lens(4, 4)])


def test_a_distorted_scene_is_fitted_through_its_lens(tmp_path):
    """A field of a scene whose cameras are said to be distorted differs from one of the same scene without a lens."""
    room = make_room(tmp_path / "scene")
    scene = load_scene(room)
    maps = FeatureFolder(room / "features", [scene.stem(i) for i in scene.views("train")])
    quick = dataclasses.replace(CONFIG, field=dataclasses.replace(CONFIG.field, steps=3), mode="adc")
    bent = dataclasses.replace(scene, cameras=[dataclasses.replace(c, distortion=LENS) for c in scene.cameras])
    with pytest.raises(ValueError, match=tells("scene:", "distortion", "scene.undistorted()")):
        fit_scene(bent, maps, tmp_path / "run", quick)
    straightened = fit_scene(bent.undistorted(), maps, tmp_path / "run", quick)
    as_is = fit_scene(bent.undistorted(), maps, tmp_path / "run", dataclasses.replace(quick, undistorted_features=True))
    assert straightened.stages[0].key != as_is.stages[0].key  # the lens is part of what the maps are
    larger = [
        lens.resized(2 * lens.height, 2 * lens.width) for lens in bent.cameras
    ]  # the same K would be another lens
    larger = [dataclasses.replace(big, K=lens.K) for big, lens in zip(larger, bent.cameras, strict=True)]
    other = fit_scene(dataclasses.replace(bent.undistorted(), lenses=larger), maps, tmp_path / "run", quick)
    assert other.stages[0].key != straightened.stages[0].key
    plain = fit_scene(scene, maps, tmp_path / "run", quick)
    assert plain.stages[0].key == as_is.stages[0].key
