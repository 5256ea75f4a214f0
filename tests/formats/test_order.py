import numpy as np
import pytest
import torch
from messages import tells

from kfgs.formats.order import morton_cells, morton_codes, morton_order


def test_a_grid_is_ordered_by_interleaved_bits():
    cells = torch.cartesian_prod(*[torch.arange(4)] * 3)  # x slowest

    def code(cell):  # 2 bits an axis, x lowest
        x, y, z = (int(v) for v in cell)
        return sum((v >> bit & 1) << (3 * bit + axis) for axis, v in enumerate((x, y, z)) for bit in range(2))

    expected = sorted(range(64), key=lambda i: code(cells[i]))
    grid = cells.double() * 0.25 + torch.tensor([3.0, -7.0, 0.5])  # bit patterns do not depend on place and size
    # 3 of 3 fills all bits; 1 and 2 of 3 lie at one and two thirds, whose leading bits are 01 and 10
    assert morton_order(grid).tolist() == expected


def test_order_of_ordered_is_as_it_is():
    means = torch.randn(500, 3, generator=torch.Generator().manual_seed(1))
    means = torch.cat([means, means[:100]])  # ties keep their order
    order = morton_order(means)
    assert sorted(order.tolist()) == list(range(600))
    assert morton_order(means[order]).tolist() == list(range(600))


def test_neighbours_come_close_together():
    means = torch.rand(4096, 3, generator=torch.Generator().manual_seed(2))
    step = means[morton_order(means)].diff(dim=0).norm(dim=1).mean()
    assert step < 0.2 * means.diff(dim=0).norm(dim=1).mean()


@pytest.mark.parametrize("means", [torch.zeros(0, 3), torch.zeros(1, 3), torch.ones(5, 3, dtype=torch.float64)])
def test_clouds_without_extent(means):
    assert morton_order(means).tolist() == list(range(len(means)))


def test_large_coordinates_do_not_overflow():
    means = torch.tensor([[3e38, -3e38, 0.0], [-3e38, 3e38, 1.0], [-3e38, -3e38, 0.0]])
    assert morton_order(means).tolist() == [2, 0, 1]


def test_positions_that_are_no_numbers_are_named():
    means = torch.zeros(3, 3)
    means[1, 2] = np.nan
    with pytest.raises(ValueError, match=tells("means:", "got [0.0, 0.0, nan]")):
        morton_order(means)
    with pytest.raises(ValueError, match=tells("means:", "[N, 3]", "got (3, 2)")):
        morton_order(torch.zeros(3, 2))


def test_codes_interleave_bits_and_cells_take_them_apart():
    assert morton_codes(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 3]], np.uint64)).tolist() == [1, 2, 4, 44]
    cells = np.random.default_rng(0).integers(0, 1 << 21, (200, 3)).astype(np.uint64)
    assert (morton_cells(morton_codes(cells)) == cells).all()
