import pytest
import torch
from messages import tells

from kfgs.labels import default_distance, transfer_labels


def points(n, seed):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))


def test_default_distance_covers_nearly_all_between_its_bounds():
    axis = torch.arange(10.0)
    grid = torch.cartesian_prod(axis, axis, torch.zeros(1))  # spacing 1
    above = lambda height: grid + torch.tensor([0.0, 0.0, height])  # noqa: E731
    assert default_distance(grid, above(4.0)) == pytest.approx(4)  # as far as the destinations are
    assert default_distance(grid, above(0.5)) == pytest.approx(2)  # no less than 2 spacings
    assert default_distance(grid, above(100.0)) == pytest.approx(10)  # no more than 10
    tail = torch.cat([above(4.0).repeat(10, 1)[:997], above(1000.0)[:3]])  # a few floaters do not stretch it
    assert default_distance(grid, tail) == pytest.approx(4)


def test_default_distance_scales_and_moves_with_the_scene():
    src, dst = points(400, 8).double(), points(300, 9).double()
    expected = default_distance(src, dst)
    assert default_distance(src * 37, dst * 37) == pytest.approx(37 * expected)
    assert default_distance(src + 5, dst + 5) == pytest.approx(expected)


def test_default_distance_is_used_and_explained():
    src, dst = points(400, 8), points(300, 9)
    result = transfer_labels(src, torch.zeros(400, dtype=torch.int64), dst)
    assert result.distance == default_distance(src, dst)
    assert result.labelled >= 0.9 * 300 - 1
    assert "source spacings: " in result.how
    assert "orphaned" in repr(result)


@pytest.mark.parametrize(
    ("height", "words"),
    [
        (4.0, "99.5 % of the destinations have a source within it (source spacings: 1 median, 1 wide)"),
        (0.5, "2 median source spacings of 1 (99.5 % of the destinations need only 0.5)"),
        (100.0, "10 wide source spacings of 1 (99.5 % of the destinations would need 100)"),
    ],
)
def test_the_line_says_which_bound_decided(height, words):
    axis = torch.arange(10.0)
    grid = torch.cartesian_prod(axis, axis, torch.zeros(1))
    result = transfer_labels(grid, torch.zeros(100, dtype=torch.int64), grid + torch.tensor([0.0, 0.0, height]))
    assert words in result.how


def test_one_source_position_has_a_default_distance():
    result = transfer_labels(torch.ones(3, 3), torch.tensor([5, 5, 5]), torch.ones(2, 3))
    assert result.labels.tolist() == [5, 5]
    assert result.distance > 0


def test_a_sparse_wall_does_not_cut_the_reach_short():
    """Most sources crowd a corner; the bound looks at the wide spacings, so that destinations on the wall are reached."""
    axis = torch.arange(10.0)
    wall = torch.cartesian_prod(axis, axis, torch.zeros(1))  # 100 sources, spacing 1
    corner = torch.cartesian_prod(axis, axis, axis[:4]) * 0.01  # 400 sources, spacing 0.01
    between = torch.cartesian_prod(axis, axis, torch.zeros(1)) + 0.5
    assert default_distance(torch.cat([wall, corner + 20]), between) == pytest.approx(0.75**0.5)


def test_default_distance_needs_two_clouds():
    with pytest.raises(ValueError, match=tells("src_means:", "got none")):
        default_distance(torch.empty(0, 3), torch.ones(1, 3))
    with pytest.raises(ValueError, match=tells("dst_means:", "got none")):
        default_distance(torch.ones(1, 3), torch.empty(0, 3))
