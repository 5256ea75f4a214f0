import math

import numpy as np
import pytest
import torch
from messages import refused

from kfgs.cameras import Camera, Orbit, estimate_up, orbit_cameras, project_points, robust_bounds

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
