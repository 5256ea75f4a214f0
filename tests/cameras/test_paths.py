import math

import numpy as np
import pytest
import torch
from messages import refused

from kfgs.cameras import (
    Camera,
    Distortion,
    Orbit,
    estimate_up,
    orbit_cameras,
    path_cameras,
    project_points,
    robust_bounds,
)


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


ORIGIN, MIDDLE = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype=torch.float64)
TILTED = torch.tensor([1.0, -2.0, 2.0], dtype=torch.float64) / 3


def cloud(n=4000, seed=0):
    """A box of 2 x 4 x 6 about (1, 2, 3), its corners included."""
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    return points * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) + MIDDLE


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), TILTED])
def test_cameras_go_round_the_middle_at_one_height_with_the_world_upright(up):
    zenith = torch.as_tensor(up, dtype=torch.float64)
    cameras = orbit_cameras(cloud(), Orbit(frames=8, elevation_degrees=30), up=up)
    centers = torch.stack([camera.center for camera in cameras])
    target = centers + torch.stack([one.viewmat[2, :3] for one in cameras]) * (centers - MIDDLE).norm(dim=1)[:, None]
    np.testing.assert_allclose(target, target[:1].expand(8, 3), atol=0.02)  # the box is known from samples
    np.testing.assert_allclose(target[0], MIDDLE, atol=0.1)
    rays = centers - target[0]
    np.testing.assert_allclose(rays.norm(dim=1), float(rays[0].norm()), rtol=2e-3)
    np.testing.assert_allclose(rays @ zenith / rays.norm(dim=1), math.sin(math.radians(30)), atol=2e-3)
    for camera in cameras:
        xy, _, _ = project_points(camera, torch.stack([target[0], target[0] + 0.1 * zenith]))
        np.testing.assert_allclose(xy[0], [camera.width / 2, camera.height / 2], atol=0.5)
        np.testing.assert_allclose(xy[1, 0], xy[0, 0], atol=0.1)  # up is up in the picture
        assert xy[1, 1] < xy[0, 1] - 1
    flat = rays - (rays @ zenith)[:, None] * zenith
    turn = torch.linalg.cross(flat, flat.roll(-1, 0)) @ zenith / (flat.norm(dim=1) ** 2)
    np.testing.assert_allclose(turn, math.sin(math.pi / 4), atol=5e-3)  # 45 degrees each, counter-clockwise


def test_the_sphere_about_the_box_touches_the_picture_and_zoom_halves_the_distance():
    orbit = Orbit(frames=1, size=(100, 160), elevation_degrees=0)
    camera = orbit_cameras(cloud(), orbit)[0]
    radius, distance = math.sqrt(1 + 4 + 9) * 0.96, float((camera.center - MIDDLE).norm())
    # a ray that touches the sphere leaves at asin(radius / distance)
    edge = float(camera.K[1, 1]) * math.tan(math.asin(radius / distance))
    assert edge == pytest.approx(50, rel=0.02)
    closer = orbit_cameras(cloud(), Orbit(frames=1, size=(100, 160), elevation_degrees=0, zoom=2))[0]
    assert float((closer.center - MIDDLE).norm()) == pytest.approx(distance / 2, rel=0.02)


def test_a_cut_opens_the_front():
    cut, whole = (orbit_cameras(cloud(), Orbit(frames=1, cut=share))[0] for share in (0.5, 0.0))
    distance = float((whole.center - MIDDLE).norm())
    radius = distance - whole.near
    assert cut.near == pytest.approx(whole.near + radius / 2, rel=1e-3)  # middle known to 1 %
    assert radius == pytest.approx(math.sqrt(14) * 0.96, rel=0.02)


def test_up_is_found_from_level_cameras_however_far_down_they_look():
    east = torch.linalg.cross(TILTED, torch.tensor([1.0, 0, 0], dtype=torch.float64))
    north = torch.linalg.cross(TILTED, east)
    views = [
        Camera.look_at(ORIGIN, math.cos(a) * east + math.sin(a) * north - 0.9 * a / 6 * TILTED, up=TILTED)
        for a in np.arange(0, 3, 0.2)
    ]
    np.testing.assert_allclose(estimate_up(views), TILTED, atol=1e-9)
    mean = -torch.stack([view.viewmat[1, :3] for view in views]).mean(0)
    assert float(mean @ TILTED / mean.norm()) < 0.999  # the pictures' own up, averaged, leans


def test_up_of_cameras_that_look_one_way_is_their_own():
    view = Camera.look_at(ORIGIN, (1, 0, -1))
    np.testing.assert_allclose(estimate_up([view] * 3), np.array([1, 0, 1]) / math.sqrt(2), atol=1e-9)


def test_up_of_nothing_or_of_pictures_upside_down_is_refused():
    refused(lambda: estimate_up([]), "cameras:", "got none")
    views = [Camera.look_at(ORIGIN, (1, 0, 0), up=(0, 0, z)) for z in (1, -1)]
    refused(lambda: estimate_up(views), "cameras:", "upright", "got 2")


def test_what_cannot_be_gone_round_is_refused():
    refused(lambda: orbit_cameras(torch.zeros(0, 3)), "points:", "got none")
    refused(lambda: orbit_cameras(torch.full((4, 3), math.nan)), "points:", "NaN")
    refused(lambda: orbit_cameras(torch.zeros(4, 3), up=(0.0, 0.0, 0.0)), "up:", "got [0.0, 0.0, 0.0]")
    refused(lambda: orbit_cameras(torch.zeros(4, 3), up=(0.0, 1.0)), "up:", "[3]", "got (2,)")


def test_outliers_do_not_move_the_box() -> None:
    g = torch.Generator().manual_seed(3)
    cloud = torch.rand(1000, 3, generator=g) * torch.tensor([4.0, 2.0, 1.0])
    far = torch.tensor([[-139.0, 5.0, 0.5], [2.0, 300.0, 0.5], [2.0, 1.0, -77.0]])
    bounds = robust_bounds(torch.cat([cloud, far]))
    assert bounds.inside[:1000].float().mean() > 0.99
    assert not bounds.inside[1000:].any()
    torch.testing.assert_close(bounds.high - bounds.low, torch.tensor([4.0, 2.0, 1.0]) * 1.2, rtol=0.05, atol=0)


def test_full_coverage_is_the_plain_box() -> None:
    points = torch.tensor([[0.0, 1.0, 2.0], [4.0, -1.0, 2.0], [1.0, 0.0, 5.0]])
    bounds = robust_bounds(points, coverage=1.0, margin=0.0)
    assert bounds.low.tolist() == [0, -1, 2]
    assert bounds.high.tolist() == [4, 1, 5]
    assert bounds.inside.all()
    assert repr(bounds).endswith("inside=[3] bool)")
    refused(lambda: robust_bounds(points, coverage=0.0), "coverage:", "got 0.0")
