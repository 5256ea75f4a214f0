"""The bridge to kornia's cameras against kfgs's own projection, loops, and what kornia does with a grid."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from messages import tells
from oracles_cameras import project_pinhole

from kfgs.cameras import Camera, Distortion, from_kornia, project_points, to_kornia

K = torch.tensor([[70.0, 0.0, 50.0], [0.0, 66.0, 30.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def posed(quat_xyzw, translation, name, width=96, height=64, focal=1.0):
    unit = np.array(quat_xyzw) / np.linalg.norm(quat_xyzw)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(pycolmap.Rigid3d(pycolmap.Rotation3d(unit), np.array(translation)).matrix())
    zoomed = K.clone()
    zoomed[:2, :2] *= focal
    return Camera(viewmat, zoomed, width, height, name, near=0.01)


CAMERAS = [
    posed([0.1, -0.2, 0.3, 0.9], [0.5, -1.0, 2.0], "a.png"),
    posed([-0.3, 0.1, 0.2, 0.8], [-0.4, 0.3, 1.0], "b.png", width=80, focal=1.3),
]


def points_in_front(camera, count=40):
    """World points whose depth in the camera lies in [1, 10]."""
    rng = np.random.default_rng(0)
    cam = np.stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.4, 0.4, count), np.ones(count)], 1)
    cam = torch.from_numpy(cam * rng.uniform(1, 10, (count, 1)))
    return (cam - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def test_project_gives_the_pixels_of_kfgs_and_of_loops():
    pinhole = to_kornia(CAMERAS)
    points = torch.stack([points_in_front(camera) for camera in CAMERAS])
    theirs = pinhole.project(points)
    for camera, world, pixels in zip(CAMERAS, points, theirs, strict=True):
        assert (pixels - project_points(camera, world)[0]).abs().max() <= 1e-9
        loops, _ = project_pinhole(camera.K.numpy(), camera.viewmat.numpy(), world.numpy())
        assert np.abs(pixels.numpy() - loops).max() <= 1e-9
    assert (theirs[0] - project_points(CAMERAS[1], points[0])[0]).norm(dim=1).max() > 1  # the other camera's


def test_unproject_takes_kfgs_pixels_back_to_the_points():
    world = torch.stack([points_in_front(camera) for camera in CAMERAS])
    pixels, depths, _ = (torch.stack(x) for x in zip(*map(project_points, CAMERAS, world), strict=True))
    torch.testing.assert_close(to_kornia(CAMERAS).unproject(pixels, depths[..., None]), world, rtol=0, atol=1e-12)


def test_round_trip():
    back = from_kornia(to_kornia(CAMERAS), [camera.name for camera in CAMERAS])
    for camera, again in zip(CAMERAS, back, strict=True):
        assert torch.equal(again.K, camera.K)
        assert torch.equal(again.viewmat, camera.viewmat)
        assert (again.size, again.name) == (camera.size, camera.name)
        assert again.K.dtype == again.viewmat.dtype == torch.float64


def test_distortion_is_refused():
    bent = replace(CAMERAS[1], distortion=Distortion("kannala_brandt", (0.1, 0, 0, 0)))
    with pytest.raises(ValueError, match=tells("camera:", "got kannala_brandt", "'b.png'")):
        to_kornia([CAMERAS[0], bent])


def test_other_errors_say_what_to_do():
    with pytest.raises(ValueError, match=tells("cameras:", "got none")):
        to_kornia([])
    pinhole = to_kornia(CAMERAS)
    with pytest.raises(ValueError, match=tells("names:", "expected 2", "got 1")):
        from_kornia(pinhole, ["a"])
    stacked = PinholeCamera(pinhole.intrinsics[:, None], pinhole.extrinsics[:, None], pinhole.height, pinhole.width)
    with pytest.raises(ValueError, match=tells("pinhole.intrinsics:", "[2, 4, 4]", "got (2, 1, 4, 4)")):
        from_kornia(stacked)
    with pytest.raises(ValueError, match=tells("width:", "got 28.")):
        from_kornia(to_kornia(CAMERAS[:1]).scale(torch.tensor([0.3], dtype=torch.float64)))
