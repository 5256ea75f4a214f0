import numpy as np
import pytest
import torch

from kfgs.formats.encodings import fit_codebook, fit_palette, morton_cells, morton_codes, morton_order, nearest_codes


def test_a_grid_is_ordered_by_interleaved_bits():
    cells = torch.cartesian_prod(*[torch.arange(4)] * 3)  # x slowest

    def code(cell):  # 2 bits an axis, x lowest
        x, y, z = (int(v) for v in cell)
        return sum((v >> bit & 1) << (3 * bit + axis) for axis, v in enumerate((x, y, z)) for bit in range(2))

    expected = sorted(range(64), key=lambda i: code(cells[i]))
    grid = cells.double() * 0.25 + torch.tensor([3.0, -7.0, 0.5])  # bit patterns do not depend on place and size
    # 3 of 3 fills all bits; 1 and 2 of 3 lie at one and two thirds, whose leading bits are 01 and 10
    assert morton_order(grid).tolist() == expected


@pytest.mark.parametrize("means", [torch.zeros(0, 3), torch.zeros(1, 3), torch.ones(5, 3, dtype=torch.float64)])
def test_clouds_without_extent(means):
    assert morton_order(means).tolist() == list(range(len(means)))


def test_large_coordinates_do_not_overflow():
    means = torch.tensor([[3e38, -3e38, 0.0], [-3e38, 3e38, 1.0], [-3e38, -3e38, 0.0]])
    assert morton_order(means).tolist() == [2, 0, 1]


def test_codes_interleave_bits_and_cells_take_them_apart():
    assert morton_codes(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 3]], np.uint64)).tolist() == [1, 2, 4, 44]
    cells = np.random.default_rng(0).integers(0, 1 << 21, (200, 3)).astype(np.uint64)
    assert (morton_cells(morton_codes(cells)) == cells).all()


def test_up_to_256_values_are_kept_as_they_are():
    values = np.repeat(np.float32([3.5, -1, 0.25]), 10).astype(np.float64)
    book = fit_codebook(values)
    assert book.shape == (256,)
    assert set(book.tolist()) == {3.5, -1, 0.25}
    np.testing.assert_array_equal(book[nearest_codes(book, values)], values)
    assert fit_codebook(np.zeros(0)).tolist() == [0] * 256


def test_a_codebook_is_where_the_values_are():
    values = np.random.default_rng(0).laplace(size=(5000, 3))
    values[0, 0] = 40  # an outlier gets its own number
    book = fit_codebook(values)
    assert (np.diff(book) >= 0).all()
    error = np.abs(book[nearest_codes(book, values)] - values)
    even = (values.max() - values.min()) / 255 / np.sqrt(12)
    assert (error**2).mean() ** 0.5 < even / 4  # 256 numbers reach even / 4.7 (Panter and Dite)
    assert error.max() < 0.3
    np.testing.assert_array_equal(nearest_codes(book, values[:9]), np.abs(values[:9, :, None] - book).argmin(2))
    np.testing.assert_array_equal(book, fit_codebook(values))


def test_a_small_set_is_its_own_palette():
    rows = torch.randn(20, 9, generator=torch.Generator().manual_seed(0))
    palette, labels = fit_palette(rows, 32)
    assert torch.equal(palette[labels], rows)


def test_clusters_become_rows_of_the_palette():
    g = torch.Generator().manual_seed(1)
    centers = torch.randn(50, 9, generator=g) * 10
    which = torch.arange(50).repeat_interleave(40)
    rows = centers[which] + torch.randn(2000, 9, generator=g) * 0.01
    palette, labels = fit_palette(rows, 128)
    assert len(palette) <= 128
    assert (palette[labels] - rows).abs().max() < 0.2
    assert all(map(torch.equal, (palette, labels), fit_palette(rows, 128)))  # no chance


def test_a_larger_palette_is_nearer_and_beats_picked_rows():
    rows = torch.randn(3000, 24, generator=torch.Generator().manual_seed(2)).cumsum(1)
    rows = rows[rows[:, -1].argsort()]
    errors = []
    for size in (64, 512):
        palette, labels = fit_palette(rows, size)
        assert size / 2 < len(palette) <= size
        errors.append(float((palette[labels] - rows).square().mean()))
        picked = rows[:: len(rows) // size]
        assert errors[-1] < 0.8 * float(torch.cdist(rows, picked).min(1).values.square().mean()) / 24
    assert errors[1] < 0.7 * errors[0]
