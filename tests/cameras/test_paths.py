import math

import numpy as np
import torch
from messages import refused

from kfgs.cameras import Camera, Distortion, path_cameras


def camera(center, yaw=0.0, *, focal=50.0, size=(40, 60), near=0.2, distortion=None):
    """Looks along z, turned by yaw about y."""
    c, s = math.cos(yaw), math.sin(yaw)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(center, dtype=torch.float64)
    K = torch.tensor([[focal, 0, 31], [0, focal + 1, 19], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, size[1], size[0], near=near, distortion=distortion)


def yaw_of(view):
    return math.atan2(float(view.viewmat[2, 0]), float(view.viewmat[2, 2]))


def centers(path):
    return torch.stack([view.center for view in path]).numpy()


def test_between_two_views_the_path_is_straight_and_turns_evenly():
    path = path_cameras([camera((0, 1, 2)), camera((4, 1, 0), math.pi / 2)], 5)
    t = np.linspace(0, 1, 5)
    np.testing.assert_allclose(centers(path), np.outer(1 - t, (0, 1, 2)) + np.outer(t, (4, 1, 0)), atol=1e-9)
    np.testing.assert_allclose([yaw_of(view) for view in path], t * math.pi / 2, atol=1e-9)
    assert [view.name for view in path] == [f"path_{i:04d}" for i in range(5)]


def test_every_key_is_passed_and_a_steady_walk_stays_steady():
    keys = [camera((2.0 * i, 0.5, 0), 0.3 * i) for i in range(5)]
    path = path_cameras(keys, 9)
    np.testing.assert_allclose(centers(path), [(i, 0.5, 0) for i in range(9)], atol=1e-9)
    for key, view in zip(keys, path[::2], strict=True):
        np.testing.assert_allclose(view.viewmat, key.viewmat, atol=1e-9)


def test_every_tenth_view_is_a_key_and_the_last_is_too():
    shaky = [camera((i, 0.3 * (-1) ** i, 0)) for i in range(18)]
    path = centers(path_cameras(shaky, 50, every=2))
    assert path[:40, 1].min() > 0.25  # the even ones are all above ...
    np.testing.assert_allclose(path[-1], (17, -0.3, 0), atol=1e-9)  # ... and the last is below


def test_lenses_run_linearly_and_sizes_are_the_askers():
    bent = camera((2, 0, 0), focal=70, near=0.05, distortion=Distortion("brown_conrady", (0.1, 0, 0, 0)))
    path = path_cameras([camera((0, 0, 0), focal=50), bent], 3, size=(20, 120))
    for view, focal in zip(path, (50, 60, 70), strict=True):
        assert view.size == (20, 120)
        expected = [[2 * focal, 0, 62], [0, (focal + 1) / 2, 9.5], [0, 0, 1]]
        np.testing.assert_allclose(view.K, expected, atol=1e-9)
        assert view.near == 0.05
        assert view.distortion is None


def test_a_portrait_among_landscapes_is_not_stretched():
    """60 x 40 (width x height) in a frame of 60 x 40 from 40 x 60: two thirds as large, in the middle."""
    high = Camera(torch.eye(4), torch.tensor([[60.0, 0, 21], [0, 60, 33], [0, 0, 1]]), 40, 60)
    path = path_cameras([camera((-1, 0, 0)), high], 2)
    expected = [[40, 0, 30 + 2 / 3], [0, 40, 20 + 2], [0, 0, 1]]
    np.testing.assert_allclose(path[-1].K, expected, atol=1e-5)
    assert path[-1].size == (40, 60)


def test_what_is_no_walk_is_refused():
    keys = [camera((0, 0, 0)), camera((1, 0, 0))]
    refused(lambda: path_cameras([], every=2), "cameras:", "got none")
    refused(lambda: path_cameras([keys[0]] * 3), "cameras:", "got 1")
    refused(lambda: path_cameras(keys[0]), "cameras: expected at least two different views, got 1")
    refused(lambda: path_cameras(keys, frames=1), "frames:", "got 1")
    refused(lambda: path_cameras(keys, every=0), "every:", "got 0")
    refused(lambda: path_cameras(keys, size=(5, 2.5)), "size (width):", "got 2.5")
