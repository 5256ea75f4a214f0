import math

import numpy as np
import pytest
import torch
from messages import tells
from oracles_selection import rotation
from scipy.spatial.transform import Rotation

from kfgs.labels import OrientedBox

TURN = torch.from_numpy(rotation([1, -2, 0.5], 37))


def corners(edges):
    signs = torch.cartesian_prod(*([torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3))
    return signs * torch.tensor(edges, dtype=torch.float64)


def test_between_two_corners():
    box = OrientedBox.between([0, 1, 2], [2, 5, 8])
    assert box.center.tolist() == [1, 3, 5]
    assert box.half.tolist() == [1, 2, 3]
    assert box.volume == 48
    assert box.corners.amin(dim=0).tolist() == [0, 1, 2]
    assert box.corners.amax(dim=0).tolist() == [2, 5, 8]


@pytest.mark.parametrize("seed", range(5))
def test_the_box_of_a_turned_box_is_itself(seed):
    """Points inside count less than corners, and the axes come by length; principal axes alone would miss it."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.from_numpy(Rotation.random(rng=seed).as_matrix())
    skewed = torch.rand(400, 3, generator=generator, dtype=torch.float64) ** 3 - 0.5  # most of them in one corner
    points = torch.cat([corners([3, 2, 0.5]), skewed * torch.tensor([3, 2, 0.5])])
    box = OrientedBox.around(points @ turn.T + 4)
    assert (2 * box.half).tolist() == pytest.approx([3, 2, 0.5])
    assert box.center.tolist() == pytest.approx([4, 4, 4])
    torch.testing.assert_close((box.axes @ turn).abs(), torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    assert float(torch.linalg.det(box.axes)) == pytest.approx(1)


@pytest.mark.parametrize("seed", range(6))
def test_it_holds_every_point_and_is_no_larger_than_the_plain_boxes(seed):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 3)) + rng.gamma(1, 1, (200, 1))
    box = OrientedBox.around(torch.from_numpy(cloud))
    assert box.contains(torch.from_numpy(cloud)).all()
    axes = np.linalg.eigh(np.cov(cloud.T))[1]
    plain = min(np.prod(np.ptp(cloud, axis=0)), np.prod(np.ptp(cloud @ axes, axis=0)))
    assert box.volume <= plain * (1 + 1e-9)


def test_flat_thin_and_single_points():
    flat = corners([2, 1, 0]) @ TURN.T
    assert (2 * OrientedBox.around(flat).half).tolist() == pytest.approx([2, 1, 0], abs=1e-12)
    line = torch.tensor([[0.0, 0, 0], [1, 2, 2], [0.5, 1, 1]], dtype=torch.float64)
    assert (2 * OrientedBox.around(line).half).tolist() == pytest.approx([3, 0, 0], abs=1e-12)
    point = OrientedBox.around(torch.tensor([[1.0, 2, 3]]).expand(5, 3))
    assert point.center.tolist() == [1, 2, 3]
    assert point.half.tolist() == [0, 0, 0]
    assert point.volume == 0


def test_an_oriented_box_selects_along_its_axes():
    """A long thin box along the diagonal: (1, 1, 0) / sqrt(2)."""
    s = math.sqrt(0.5)
    box = OrientedBox(torch.zeros(3), torch.tensor([[s, s, 0], [-s, s, 0], [0, 0, 1]]), torch.tensor([2.0, 0.1, 0.1]))
    means = torch.tensor([[1.0, 1, 0], [1, -1, 0], [1.5, 1.5, 0], [1, 1.1, 0], [1, 1.2, 0]])
    assert box.contains(means).tolist() == [True, False, False, True, False]
    by_rows = torch.tensor([[abs(float(m @ a)) for a in box.axes] for m in means])
    assert box.contains(means).equal((by_rows <= box.half).all(dim=1))


def test_json_is_plain():
    box = OrientedBox.between([0, 0, 0], [2, 2, 2])
    assert box.to_json() == {
        "center": [1, 1, 1],
        "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "half": [1, 1, 1],
    }


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=tells("points:", "got none")):
        OrientedBox.around(torch.zeros(0, 3))
    with pytest.raises(ValueError, match=tells("points:", "got NaN", "row 1")):
        OrientedBox.around(torch.tensor([[0.0, 0, 0], [0, math.inf, 0]]))
    with pytest.raises(ValueError, match=tells("axes:", "rotation", "got [[")):
        OrientedBox(torch.zeros(3), 2 * torch.eye(3), torch.ones(3))
    with pytest.raises(ValueError, match=tells("axes:", "rotation", "got [[")):
        OrientedBox(torch.zeros(3), torch.diag(torch.tensor([1.0, 1, -1])), torch.ones(3))
    with pytest.raises(ValueError, match=tells("low:", "[3]", "got (2,)")):
        OrientedBox.between([0, 0], [1, 1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_box_contains_the_points_it_is_around(dtype):
    """All of them, also asked one by one: no point is lost to rounding, and none far outside is let in."""
    generator = torch.Generator().manual_seed(0)
    for place in (0.0, 1.0, 1e5):
        for _ in range(10):
            turn = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
            points = (torch.randn(37, 3, generator=generator) @ turn + place).to(dtype)
            box = OrientedBox.around(points)
            assert box.contains(points).all()
            assert all(box.contains(point[None]).all() for point in points)
            extent = (points.double() - box.center) @ box.axes.T
            torch.testing.assert_close(extent.abs().amax(dim=0), box.half, rtol=1e-9, atol=1e-9)
    assert OrientedBox.around(corners([2, 1, 0]) @ TURN.T).contains(corners([2, 1, 0]) @ TURN.T).all()
