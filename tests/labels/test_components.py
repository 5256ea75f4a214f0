import math
import tracemalloc

import numpy as np
import pytest
import torch
from cases_clouds import balls
from oracles_selection import components as oracle

from kfgs.labels.components import number_parts, part_distance, radius_components, spacing


def clumps(n, heaps, spread, seed):
    """Heaps of points of very different density, as densification leaves them, some rounded onto each other."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(heaps, 3)) * 2
    points = centres[rng.integers(0, heaps, n)] + rng.normal(size=(n, 3)) * rng.gamma(1, spread, n)[:, None]
    return np.round(points, 2) if seed % 3 == 0 else points


@pytest.mark.parametrize("distance", [0.02, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_the_same_parts_as_a_flood_fill(distance, seed):
    """What lies in one cube with edges of a quarter of the distance counts as one place, at its mean."""
    points = clumps(160, 12, (0.02, 0.2)[seed % 2], seed)
    cubes = [tuple(cube) for cube in np.floor((points - points.min(axis=0)) / (distance / 4))]
    points = np.array([np.mean([p for p, c in zip(points, cubes, strict=True) if c == cube], axis=0) for cube in cubes])
    expected = oracle(points, distance)
    numbers = radius_components(points, distance)
    assert [np.flatnonzero(numbers == i).tolist() for i in range(numbers.max() + 1)] == expected


def test_memory_stays_bounded_where_thousands_lie_in_range():
    """10,000 points, all pairs in range: 50 million pairs would take 800 MB."""
    points = np.random.default_rng(0).uniform(0, 1, (10_000, 3))
    tracemalloc.start()
    try:
        assert radius_components(points, 2.0).max() == 0
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()


def grid(origin, n=5, step=0.1):
    x, y = torch.meshgrid(torch.arange(n) * step, torch.arange(n) * step, indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3) + torch.tensor(origin)


def test_default_distance_follows_the_selection():
    """On a grid, 90 % have their fourth neighbour within sqrt(2) steps: a corner's is (1, 1), an edge's (1, 1) too."""
    dense, sparse = grid([0.0, 0, 0], n=20, step=0.1), grid([100.0, 0, 0], n=20, step=0.3)
    means = torch.cat([dense, sparse]).double().numpy()
    first, whole = np.arange(800) < 400, spacing(means)
    step = part_distance(means[first], whole)
    assert step == pytest.approx(1.5 * 0.1 * math.sqrt(2), rel=1e-4)
    assert part_distance(means[~first], whole) == pytest.approx(3 * step, rel=1e-4)
    assert part_distance(7 * means[first], spacing(7 * means)) == pytest.approx(7 * step, rel=1e-4)
    specks = means[[0, 399, 799]]
    assert part_distance(specks, whole) <= 4 * 0.3 * math.sqrt(2) + 1e-6  # not the hundred between the sheets
    assert number_parts(balls(torch.ones(3, 3)), torch.ones(3, dtype=torch.bool)).tolist() == [0, 0, 0]


@pytest.mark.parametrize(("gap", "parts"), [(0.2, [800]), (0.22, [400, 400])])
def test_default_distance_parts_things_that_stand_close(gap, parts):
    """1.5 spacings of 0.141 are 0.212; twice the spacing joined the two chairs of room_0."""
    means = torch.cat([grid([0.0, 0, 0], n=20, step=0.1), grid([1.9 + gap, 0, 0], n=20, step=0.1)])
    numbers = number_parts(balls(means), torch.ones(800, dtype=torch.bool))
    assert numbers.bincount().tolist() == parts
