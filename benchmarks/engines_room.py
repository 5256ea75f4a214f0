"""What the engines' benchmark renders: a furnished room of Gaussians, made from a seed, and a camera inside of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kfgs import Gaussians
from kfgs.cameras import Camera

ROOM = (6.0, 5.0, 3.0)  # metres; z is up
SURFACE = 150.0  # square metres of walls and furniture, about


def room(count: int, channels: int, seed: int = 0) -> Gaussians:
    """`count` Gaussians on walls, floor, ceiling and 14 boxes.

    Six of ten lie on the room's faces, by area; sizes are log-normal around half the spacing that so many Gaussians
    have, two axes of three times longer than wide now and then; opacities are the logistic of a normal of deviation 2,
    so that many are almost clear and many almost opaque, as in trained scenes.
    """
    g = torch.Generator().manual_seed(seed)
    size = torch.tensor(ROOM)
    on_room = int(0.6 * count)
    areas = torch.stack([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    walls = _on_boxes(torch.zeros(1, 3), size[None], areas, on_room, g) + 0.01 * torch.randn(on_room, 3, generator=g)
    extent = 0.25 + torch.rand(14, 3, generator=g) * torch.tensor([1.4, 1.4, 0.9])
    corner = torch.rand(14, 3, generator=g) * (size - extent)
    corner[:, 2] = 0
    furniture = _on_boxes(corner, extent, torch.ones(3), count - on_room, g)
    means = torch.cat([walls, furniture])[torch.randperm(count, generator=g)]

    spacing = math.sqrt(SURFACE / count)
    spread = 0.55 * torch.randn(count, 1, generator=g) + 0.45 * torch.randn(count, 3, generator=g)
    return Gaussians(
        means=means,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1),
        scales=0.55 * spacing * spread.exp(),
        opacities=torch.sigmoid(2 * torch.randn(count, generator=g)),
        features=torch.randn(count, channels, generator=g),
    )


def _on_boxes(corners: Tensor, extents: Tensor, areas: Tensor, count: int, g: torch.Generator) -> Tensor:  # [count, 3]
    """Points on the faces of boxes, any box as likely as another; `areas` weighs the three axes across a face."""
    box = torch.randint(len(corners), (count,), generator=g)
    within = torch.rand(count, 3, generator=g)
    across = torch.multinomial(areas, count, replacement=True, generator=g)
    within[torch.arange(count), across] = torch.randint(2, (count,), generator=g).float()
    return corners[box] + within * extents[box]


def view(width: int, height: int) -> Camera:
    """A camera in a corner of the room that looks across it, 90 degrees wide."""
    eye, target = torch.tensor([0.7, 0.8, 1.5]), torch.tensor([4.6, 3.6, 0.9])
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    focal = width / 2  # tan(45 degrees) = 1
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat, K, width, height)
