import math

import pytest
import torch
from messages import tells

from kfgs.cameras import Camera, spiral_cameras

K = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])


def wall():
    y, x = torch.meshgrid(torch.linspace(-1, 1, 9), torch.linspace(-1, 1, 9), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, 4.0)], -1).reshape(-1, 3)


def center(camera):
    return -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]


def test_cameras_go_around_the_view_and_look_at_its_middle():
    view = Camera(torch.eye(4), K, 80, 60, near=0.1)
    points = torch.cat([wall(), torch.tensor([[0.0, 0, -50], [0, 0, 0.05]])])  # behind, and too near
    made = spiral_cameras(view, points, 24, size=(30, 40), radius=0.1)
    assert len(made) == 24
    for camera in made:
        assert camera.size == (30, 40)
        assert camera.near == 0.1
        looked_at = camera.viewmat.double() @ torch.tensor([0, 0, 4.0, 1], dtype=torch.float64)
        assert looked_at[:2].abs().max() < 1e-6
        assert float(center(camera).norm()) <= 0.4 * math.sqrt(2) + 1e-6
        assert float(camera.K[1, 1]) == pytest.approx(40, rel=1e-6)  # the view's field, on half of its pixels
    across = torch.stack([center(camera) for camera in made])
    assert across.mean(dim=0).abs().max() < 1e-6  # two whole turns
    assert float(across[:, 0].max()) == pytest.approx(0.4, rel=1e-6)
    assert float(across[:, 2].max()) == pytest.approx(0.4, rel=1e-6)


def test_moving_the_world_moves_the_spiral():
    move = torch.eye(4, dtype=torch.float64)
    move[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    move[:3, 3] = torch.tensor([3.0, -2, 1])
    view = Camera(torch.eye(4, dtype=torch.float64), K.double(), 80, 60)
    moved = Camera(torch.linalg.inv(move), K.double(), 80, 60)
    points = wall().double()
    there = spiral_cameras(moved, points @ move[:3, :3].T + move[:3, 3], 5)
    for one, other in zip(spiral_cameras(view, points, 5), there, strict=True):
        torch.testing.assert_close(move[:3, :3] @ center(one) + move[:3, 3], center(other))


def test_a_view_of_nothing_is_refused():
    view = Camera(torch.eye(4), K, 80, 60)
    with pytest.raises(ValueError, match=tells("points:", "got none")):
        spiral_cameras(view, torch.tensor([[0.0, 0, -1]]))
    with pytest.raises(ValueError, match="radius"):
        spiral_cameras(view, wall(), radius=0)
