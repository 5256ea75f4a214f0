"""Small clouds, cameras and plotters for pictures."""

from contextlib import contextmanager

import pytest
import torch

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.viz import make_plotter
from kfgs.viz.plotter import trouble

C0 = 0.28209479177387814


def some_gaussians(n=60, seed=0, K=1, spread=1.0):
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    sh = torch.cat([(rand(n, 1, 3) - 0.5) / C0, (rand(n, K - 1, 3) - 0.5) * 0.6], dim=1)
    return Gaussians(
        means=(rand(n, 3) * 2 - 1) * spread,
        quats=torch.randn(n, 4, generator=generator) * 3,
        scales=rand(n, 3) * 0.2 + 0.03,
        opacities=rand(n) * 0.8 + 0.1,
        features=rand(n, 4),
        sh=sh,
        labels=torch.arange(n) % 6 - 1,
    )


def some_camera(height=120, width=160):
    """Off-centre, with two focal lengths, turned about all axes."""
    viewmat = torch.eye(4, dtype=torch.float64)
    spin = torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]], dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(spin)
    viewmat[2, 3] = 4
    K = torch.tensor([[150, 0, 85], [0, 165, 55], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)


@contextmanager
def some_plotter(background="black"):
    if trouble():
        pytest.skip(trouble())
    plotter = make_plotter(120, 160, background=background, off_screen=True)
    try:
        yield plotter
    finally:
        plotter.close()


def data(actor):
    return actor.mapper.dataset
