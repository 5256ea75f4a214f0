import oracles_quant as oracle
import pytest
import torch
from messages import tells

from kfgs.quant import paper, sample_grid
from kfgs.quant.paper import farthest_points
from kfgs.quant.sampling import grid_slices


def test_grid_of_the_paper_is_rows_1_2_columns_1_3():
    feature_map = torch.arange(360 * 480, dtype=torch.float32).reshape(360, 480, 1)
    samples = sample_grid(feature_map)
    assert samples.shape == (28_800, 1)
    assert torch.equal(samples, feature_map[1::2, 1::3].reshape(-1, 1))


@pytest.mark.parametrize(
    ("size", "samples", "step"),
    [
        ((90, 120), 28_800, (1, 1)),
        ((360, 480), 100_000, (1, 2)),
        ((360, 480), 43_200, (2, 2)),
        ((1, 10), 3, (2, 3)),
        ((1, 10), 2, (3, 4)),
    ],
)
def test_step_is_the_finest_within_the_limit(size, samples, step):
    slices = grid_slices(*size, samples)
    assert tuple(part.step for part in slices) == step
    assert [part.start for part in slices] == [min(n // 2, length - 1) for n, length in zip(step, size, strict=True)]
    assert 1 <= len(sample_grid(torch.zeros(*size, 1), samples=samples)) <= samples


def test_farthest_points_closed_form():
    angles = torch.tensor([0.0, 10.0, 170.0, 90.0, 20.0]).deg2rad()
    points = torch.stack([angles.cos(), angles.sin()], dim=1) * torch.tensor([[1.0], [9.0], [2.0], [0.1], [5.0]])
    # 0 and 170 degrees are the least similar pair; then 90 (80 away from both sides), then 20.
    assert farthest_points(points, 4).tolist() == [0, 2, 3, 4]


@pytest.mark.parametrize("block", [1, 5, 64])
def test_farthest_points_against_loops(block, monkeypatch):
    monkeypatch.setattr(paper, "BLOCK", block)
    features = torch.randn(17, 4, generator=torch.Generator().manual_seed(block), dtype=torch.float64)
    assert farthest_points(features, 6).tolist() == oracle.farthest_points(features.numpy(), 6)


def test_first_pair_tie_goes_to_lowest_rows_and_equal_rows_are_picked_once_each():
    axes = torch.eye(3)[[0, 1, 2, 0]]  # all pairs but (0, 3) are equally dissimilar
    assert farthest_points(axes, 4).tolist() == [0, 1, 2, 3]


def test_bad_input():
    with pytest.raises(ValueError, match=tells("feature_map:", "[h, w, D]", "got (3, 2)")):
        sample_grid(torch.zeros(3, 2))
    with pytest.raises(ValueError, match=tells("samples:", "[1, inf)", "got 0")):
        sample_grid(torch.zeros(3, 3, 1), samples=0)
