import dataclasses
from pathlib import Path

import torch

from kfgs.cameras import Camera, Distortion, undistort
from kfgs.pipeline.maps import KnownFeatures, map_shape, maps_of_views
from kfgs.scenes import Scene

LENS = Distortion("brown_conrady", (0.3, 0.05, 0.001, -0.002))


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
    maps = _straight([features], [lens])
    expected, _, inside = undistort(features, lens.resized(30, 40))
    torch.testing.assert_close(maps[0][inside], expected[inside])
    assert (maps[0][~inside] == 0).all()
    assert 0 < int((~inside).sum()) < 600


def test_without_distortion_a_map_is_left_alone():
    features = torch.rand(30, 40, 5)
    assert _straight([features], [_lens(160, 120, None)])[0] is features


def test_unknown_pixels_become_nan_and_nothing_else_changes():
    features = torch.ones(2, 2, 3)
    features[0, 1] = 0
    features[1, 1, 0] = 0  # one zero channel is a feature like any other
    known = KnownFeatures([features])[0]
    assert known.isnan().all(-1).tolist() == [[False, True], [False, False]]
    assert torch.equal(known[1], features[1])


class _Known(list):
    shape = (6, 8, 3)


def test_a_lens_passes_on_what_is_known_of_the_maps():
    features = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0)) + 0.5
    lenses = [_lens(8, 6, None), _lens(8, 6)]
    offered = _straight(_Known([features, features]), lenses)
    assert offered.shape == (6, 8, 3)
    assert not torch.equal(offered[1], features)
    bare = _straight([features], lenses[:1])
    assert (bare.shape, map_shape(bare)) == ((6, 8, 3), (6, 8, 3))
