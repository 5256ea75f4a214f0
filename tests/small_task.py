"""Twelve Gaussians, three views and maps of 8 channels: what every baseline can learn in a second."""

import torch
from baselines.common import Task

from kfgs.cameras import Camera
from kfgs.gaussians import Gaussians
from kfgs.splat import rasterize

MIB = 2**20


def cloud(count=12, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    return Gaussians(
        means=uniform(count, 3, low=-1, high=1),
        quats=uniform(count, 4, low=-1, high=1),
        scales=uniform(count, 3, low=0.3, high=0.6),
        opacities=uniform(count, low=0.5, high=0.9),
    )


def cameras():
    eyes = ([4.0, 0.3, 0.2], [-3.0, 2.0, 0.5], [0.5, -4.0, 1.0])
    return [Camera.look_at(eye, (0.0, 0.0, 0.0), width=24, height=20, fov_degrees=40) for eye in eyes]


def rendered_maps(channels=8):
    """What the cloud shows if the left half has one direction and the right half another, with some scatter."""
    generator = torch.Generator().manual_seed(1)
    one = cloud()
    features = 0.05 * torch.randn(len(one), channels, generator=generator)
    features[one.means[:, 1] < 0, 0] += 1
    features[one.means[:, 1] >= 0, 1] += 1
    return [rasterize(one.replace(features=features), camera.resized(10, 12)).map for camera in cameras()]


def task(**changes):
    return Task(**{"geometry": cloud(), "cameras": cameras(), "maps": rendered_maps()} | changes)
