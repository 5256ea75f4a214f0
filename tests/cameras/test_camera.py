from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from messages import refused

from kfgs.cameras import Camera, Distortion, Orbit, Similarity, orbit_cameras, project_points, robust_bounds, undistort
from kfgs.cameras.camera import view_named

K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]])


def changed(matrix, row, column, value):
    matrix = matrix.clone()
    matrix[row, column] = value
    return matrix


def test_center_maps_to_the_origin_of_the_camera():
    rotation = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.3, 0.9]) / np.linalg.norm([0.1, -0.2, 0.3, 0.9]))
    pose = pycolmap.Rigid3d(rotation, np.array([0.5, -1.0, 2.0]))
    camera = Camera(pose, K.double(), 96, 64)
    expected = torch.from_numpy(pose.inverse().translation)
    torch.testing.assert_close(camera.center, expected)
    assert (camera.viewmat[:3, 3] - expected).norm() > 1  # the wrong reading: the translation is not the position


def test_resized_agrees_with_colmap_and_not_with_integer_centers():
    camera = Camera(torch.eye(4), K.double(), 96, 64).resized(48, 48)
    colmap = pycolmap.Camera(model="PINHOLE", width=96, height=64, params=[70, 66, 50, 30.5])
    colmap.rescale(48, 48)
    np.testing.assert_allclose(camera.K.numpy(), colmap.calibration_matrix())
    assert camera.size == (48, 48)
    integer_centers = (50 + 0.5) * 0.5 - 0.5  # how cx scales when centres lie on integers
    assert abs(integer_centers - float(camera.K[0, 2])) > 0.2


def test_fitted_makes_the_longer_edge_no_longer_than_asked():
    camera = Camera(torch.eye(4), K, 96, 64)
    assert (camera.fitted(48).width, camera.fitted(48).height) == (48, 32)
    assert camera.fitted(48).K.equal(camera.resized(32, 48).K)
    assert camera.fitted(500).size == camera.size
    assert Camera(torch.eye(4), K, 96, 1).fitted(10).size == (1, 10)


def test_the_near_plane_stays_with_the_camera():
    lens = Distortion("brown_conrady", (-0.1, 0, 0, 0))
    camera = Camera(torch.eye(4), K, 96, 64, distortion=lens, near=np.float32(0.5))
    assert type(camera.near) is float
    others = camera.resized(32, 48), camera.to(torch.float64), undistort(torch.ones(64, 96, 1), camera)[1]
    assert [other.near for other in (*others, replace(camera, name="b.png"))] == [0.5] * 4
    assert Camera(torch.eye(4), K, 96, 64).near == 0.2


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"K": torch.eye(4)}, ValueError, ("K:", "[3, 3]", "got (4, 4)")),
        ({"viewmat": torch.eye(3)}, ValueError, ("viewmat:", "[4, 4]", "got (3, 3)")),
        ({"K": torch.eye(3, dtype=torch.int64)}, TypeError, ("K:", "got torch.int64", ".float()")),
        ({"width": 0}, ValueError, ("width:", "got 0")),
        ({"height": 3.5}, ValueError, ("height:", "got 3.5")),
        ({"width": float("nan")}, ValueError, ("width:", "got nan")),
        ({"K": changed(K, 0, 0, float("nan"))}, ValueError, ("viewmat, K:", "'a.png'", "got NaN")),
        ({"viewmat": changed(torch.eye(4), 0, 3, float("inf"))}, ValueError, ("viewmat, K:", "got NaN")),
        ({"K": changed(K, 0, 1, 0.1)}, ValueError, ("K:", "skew")),
        ({"K": changed(K, 2, 2, 2.0)}, ValueError, ("K:", "[[fx", "got [[")),
        ({"K": changed(K, 0, 0, -1.0)}, ValueError, ("K[0, 0] (fx):", "(0, inf)", "got -1.0")),
        ({"viewmat": torch.diag(torch.tensor([2.0, 2, 2, 1]))}, ValueError, ("viewmat:", "rigid", "scale")),
        ({"viewmat": torch.diag(torch.tensor([1.0, 1, -1, 1]))}, ValueError, ("viewmat:", "reflection", "axes")),
        ({"viewmat": changed(torch.eye(4), 3, 0, 1.0)}, ValueError, ("viewmat:", "0 0 0 1")),
        ({"near": True}, TypeError, ("near:", "got True")),
        ({"near": 0.0}, ValueError, ("near:", "(0, inf)", "got 0.0")),
    ],
)
def test_refuses(change, error, match):
    good = {"viewmat": torch.eye(4), "K": K, "width": 96, "height": 64, "name": "a.png"}
    Camera(**good)
    refused(lambda: Camera(**good | change), *match, error=error)


@pytest.mark.parametrize("up", [(0, 0, 1), (0.0, -1.0, 0.0), torch.tensor([3.0, -2.0, 1.0])])
def test_look_at_puts_the_target_in_the_middle_and_up_at_the_top(up):
    eye, target = torch.tensor([1.0, -4.0, 2.5], dtype=torch.float64), torch.tensor([0.5, 1.0, -0.5]).double()
    camera = Camera.look_at(eye, target, up=up, fov_degrees=50, width=120, height=80, name="a", near=0.1)
    assert (camera.size, camera.name, camera.near, camera.K.dtype) == ((80, 120), "a", 0.1, torch.float64)
    torch.testing.assert_close(camera.center, eye)
    above = target + 0.1 * torch.as_tensor(up).double()
    xy, depth, visible = project_points(camera, torch.stack([target, above]))
    assert visible.all()
    torch.testing.assert_close(xy[0], torch.tensor([60.0, 40.0]).double())  # the middle
    assert float(depth[0]) == pytest.approx(float((target - eye).norm()))
    assert float(xy[1, 0]) == pytest.approx(60)  # straight above it ...
    assert float(xy[1, 1]) < 39.5  # ... and y counts downward


def test_what_cannot_be_looked_at_is_refused():
    here, look_at = (0, 0, 0), Camera.look_at
    refused(lambda: look_at((1, 2, 3), (1, 2, 3)), "target - eye", "direction", "[0.0, 0.0, 0.0]")
    refused(lambda: look_at(here, (0, 0, -5)), "up", "direction", "[0.0, 0.0, 1.0]", "(0, 1, 0)")
    refused(lambda: look_at(here, (1, 0, 0), up=here), "up", "direction", "[0.0, 0.0, 0.0]")
    refused(lambda: look_at((0, 0), (1, 0, 0)), "eye", "[3]", "(2,)")
    refused(lambda: look_at(here, (1, 0, 0), fov_degrees=180), "fov_degrees", "180")
    refused(lambda: look_at(here, (1, 0, 0), width=0), "width", "0")


def test_a_camera_shows_itself_in_one_line():
    camera = Camera.look_at((0, -4, 0.5), (0, 0, 0.5), fov_degrees=90, width=64, height=48, name="a.png")
    assert repr(camera) == "Camera('a.png', 64x48, fov 90.0, at (0, -4, 0.5))"
    lens = Distortion("brown_conrady", (-0.1, 0, 0, 0))
    trained = replace(camera, K=camera.K.clone().requires_grad_(), distortion=lens)
    assert repr(trained).endswith("), brown_conrady)")
    assert [getattr(trained, name) for name in ("fx", "fy", "cx", "cy")] == [24, 24, 32, 24]


def test_matrices_may_be_arrays_or_lists():
    camera = Camera(np.eye(4), np.eye(3), 4, 4)
    assert camera.viewmat.dtype == camera.K.dtype == torch.float64
    assert torch.equal(Camera(np.eye(4).tolist(), [[1, 0, 2], [0, 1, 2], [0, 0, 1]], 4, 4).center, torch.zeros(3))
    refused(lambda: Camera(np.eye(4, dtype=np.int64), np.eye(3), 4, 4), "viewmat", "int64", "floating", error=TypeError)
    refused(lambda: Camera(np.eye(4), "pinhole", 4, 4), "K", "str", error=TypeError)


def test_points_and_pictures_may_be_arrays():
    camera = Camera(np.eye(4), K.double(), 96, 64)
    points = torch.tensor([[0.1, 0.2, 3.0], [-0.3, 0.1, 2.0], [0.5, 0.0, 4.0]], dtype=torch.float64)
    turn = Similarity.from_matrix(np.eye(4)[[1, 2, 0, 3]])
    for function in (
        lambda points: project_points(camera, points),
        robust_bounds,
        lambda points: [view.viewmat for view in orbit_cameras(points, Orbit(frames=2))],
        turn.apply,
        lambda points: [Similarity(2.0, np.eye(3), points[0]).matrix()],
        lambda points: [undistort(points[None], replace(camera, width=3, height=1))[0]],
    ):
        assert all(map(torch.equal, function(points.numpy()), function(points)))


def test_an_unknown_name_does_not_mean_the_view_without_a_name():
    nameless = Camera(torch.eye(4), K, 96, 64)
    refused(lambda: view_named([nameless], "b", "examples"), "examples:", "name of a view", "got 'b'")


def test_a_camera_has_what_others_call_its_parts():
    camera = Camera.look_at((1.0, 2.0, 3.0), (0.0, 0.5, 0.0), width=96, height=64)
    point = torch.tensor([0.3, -0.2, 0.1])
    seen = camera.R @ point + camera.t
    torch.testing.assert_close(camera.c2w @ torch.cat([seen, torch.ones(1)]), torch.cat([point, torch.ones(1)]))
    torch.testing.assert_close(camera.c2w[:3, 3], camera.center)
    pixel = torch.tensor([camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy])
    torch.testing.assert_close(project_points(camera, point[None])[0][0], pixel)
