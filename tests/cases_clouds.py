"""Small clouds; and those of a small room without symmetry, sampled as differently as two fields of one scene are."""

import torch

from kfgs.gaussians import Gaussians


def balls(means, labels=None, *, scale=0.05, opacity=0.9, **changes):
    """Small balls at the given places."""
    means = torch.as_tensor(means, dtype=torch.float32)
    n = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), scale),
        opacities=torch.full((n,), opacity),
        labels=None if labels is None else torch.as_tensor(labels, dtype=torch.int64),
    ).replace(**changes)


def random_cloud(n, coefficients=4, seed=0, dtype=torch.float32, **changes):
    """Gaussians of any direction, all of whose numbers lie in [0.1, 0.9]."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: (0.1 + 0.8 * torch.rand(*shape, generator=generator, dtype=torch.float64)).to(dtype)  # noqa: E731
    sh = draw(n, coefficients, 3) if coefficients else None
    return Gaussians(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), sh=sh).replace(**changes)


def surface(count, seed):
    """Points on three walls of a room of 4 x 3 x 2 and on a box in it, with noise of 5 mm."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 3.0, 2.0])
    wall = torch.randint(4, (count,), generator=generator)
    for axis in range(3):
        points[wall == axis, axis] = 0.0
    box = torch.rand(count, 3, generator=generator) * torch.tensor([0.8, 0.5, 0.9])
    box[:, 2] = 0.9
    points[wall == 3] = (box + torch.tensor([2.5, 0.4, 0.0]))[wall == 3]
    return points + 0.005 * torch.randn(count, 3, generator=generator)


def room(count, seed, thinning=0.0, floaters=0.0):
    """The walls and the box of `surface`, a round table; sparser where x is large, with floaters all about."""
    generator = torch.Generator().manual_seed(seed)
    points = surface(2 * count, seed)
    table = torch.rand(count // 4, 3, generator=generator) * torch.tensor([6.2832, 1.0, 0.0])
    radius = 0.6 * table[:, 1].sqrt()
    table = torch.stack([1.2 + radius * table[:, 0].cos(), 1.8 + radius * table[:, 0].sin(), 0.7 + 0 * radius], 1)
    points = torch.cat([points, table + 0.005 * torch.randn(table.shape, generator=generator)])
    points = points[torch.rand(len(points), generator=generator) > thinning * points[:, 0] / 4]
    points = points[torch.randperm(len(points), generator=generator)[:count]]
    air = torch.rand(int(floaters * count), 3, generator=generator) * 6 - 1
    return torch.cat([points, air]).double()
