import numpy as np
import pytest
import torch
from messages import tells
from PIL import Image

from kfgs.cameras import Camera, Orbit
from kfgs.gaussians import Gaussians
from kfgs.viz import palette, save_flythrough, save_turntable


def balls():
    n = 40
    means = (torch.rand(n, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1) * torch.tensor([1.0, 2.0, 3.0])
    means = means + torch.tensor([1.0, 2.0, 3.0])
    return Gaussians(
        means, torch.eye(4)[:1].expand(n, 4), torch.full((n, 3), 0.2), torch.full((n,), 0.9), labels=torch.arange(n) % 3
    )


def test_a_turntable_is_written_and_turns(tmp_path):
    level = [Camera.look_at((0, 0, 0), ahead, up=(0, 1, 0)) for ahead in ((1, 0, 0), (0, 0, 1))]
    seen = []
    path = save_turntable(
        tmp_path / "turn.gif",
        {"labels": balls(), "mine": lambda camera: seen.append(camera) or np.zeros((*camera.size, 3))},
        orbit=Orbit(frames=4, size=(40, 50), elevation_degrees=10),
        cameras=level,
        names=["a", "b", "c"],
    )
    with Image.open(path) as film:
        assert film.n_frames == 4
        frames = []
        for number in range(4):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    assert all((frame[20:50, :50].min() < 200) and np.ptp(frame) > 100 for frame in frames)  # not blank
    assert np.abs(frames[0] - frames[1]).mean() > 1
    heights = [float(camera.center[1]) for camera in seen]
    assert np.ptp(heights) < 1e-6  # round the y axis, which the cameras say is up
    assert heights[0] > 3


def test_functions_alone_have_nothing_to_go_round(tmp_path):
    with pytest.raises(ValueError, match=tells("shows:", "Gaussians", "orbit_cameras(points)")):
        save_turntable(tmp_path / "a.gif", {"mine": lambda camera: np.zeros((*camera.size, 3))})


def test_a_flight_past_labels_and_colours_is_written(tmp_path):
    row = torch.tensor([[0.0, 0, 4], [2, 0, 4], [4, 0, 4]])
    cloud = Gaussians(
        row, torch.eye(4)[:1].expand(3, 4), torch.full((3, 3), 0.6), torch.full((3,), 0.95), labels=torch.arange(3)
    )
    path = save_flythrough(
        tmp_path / "fly.gif",
        {"labels": cloud, "mine": lambda camera: np.full((*camera.size, 3), 77, np.uint8)},
        [Camera.look_at((0.05 * i, 0, 0), (0.05 * i, 0, 1), up=(0, -1, 0), fov_degrees=43.6) for i in range(81)],
        frames=3,
        size=(40, 60),
    )
    with Image.open(path) as film:
        assert film.n_frames == 3
        for label in range(3):  # the frame's own class is in its middle
            film.seek(label)
            frame = np.asarray(film.convert("RGB")).astype(int)
            middle = frame[-6 - 21, 6 + 31]
            assert np.abs(middle - (0.95 * palette(np.array(label)) + 0.05 * 255)).max() < 12
            assert (np.abs(frame - 77).max(axis=-1) <= 8).sum() >= 40 * 60
