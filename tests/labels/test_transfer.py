import math

import numpy as np
import pytest
import torch
from cases_clouds import balls
from messages import refused
from oracles_labels import transfer as oracle

from kfgs._notes import hear
from kfgs.labels import nearest_labels, transfer_labels


def points(n, seed, scale=1.0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) * scale


@pytest.mark.parametrize("distance", [0.05, 0.2, 5.0])
def test_agrees_with_the_oracle(distance):
    src, dst = points(150, 0), points(200, 1)
    labels = torch.randint(-1, 4, (150,), generator=torch.Generator().manual_seed(2))
    result = nearest_labels(src, labels, dst, distance)
    expected_labels, expected_sources, expected_distances = oracle(src, labels, dst, distance)
    np.testing.assert_array_equal(result.labels, expected_labels)
    np.testing.assert_array_equal(result.sources, expected_sources)
    np.testing.assert_allclose(result.distances, expected_distances, rtol=1e-6)
    assert result.labelled == (expected_labels >= 0).sum()
    assert result.labelled + result.orphaned == 200
    assert (result.distance, result.how) == (distance, "given")
    assert f"{result.orphaned} orphaned" in repr(result)


def test_many_sources_at_one_position_are_quick_and_the_first_labelled_one_counts():
    labels = torch.ones(20000, dtype=torch.int64)
    labels[0], labels[1] = -1, 2
    result = nearest_labels(torch.zeros(20000, 3), labels, torch.full((500, 3), 0.1), 1.0)
    assert (result.labels == 2).all()
    assert (result.sources == 1).all()


@pytest.mark.parametrize("distance", [None, 0.3])
def test_without_sources_or_destinations(distance):
    dst = points(6, 4)
    for src, labels in ((torch.empty(0, 3), torch.empty(0, dtype=torch.int64)), (points(3, 5), torch.full((3,), -1))):
        result = nearest_labels(src, labels, dst, distance)
        assert result.labels.tolist() == [-1] * 6
        assert result.distances.tolist() == [math.inf] * 6
        assert (result.labelled, result.orphaned) == (0, 6)
    assert nearest_labels(points(5, 6), torch.arange(5), torch.empty(0, 3)).labels.shape == (0,)


@pytest.mark.parametrize(
    ("src", "labels", "dst", "distance", "error", "message"),
    [
        (torch.ones(2, 3), torch.zeros(3), torch.ones(1, 3), 1.0, ValueError, ("src_labels:", "S = 2", "got (3,)")),
        (torch.ones(2, 3), torch.zeros(2), torch.ones(1, 3), 1.0, TypeError, ("src_labels:", "got torch.float32")),
        (torch.ones(2, 3), torch.tensor([0, -5]), torch.ones(1, 3), 1.0, ValueError, ("src_labels:", "got -5")),
        (torch.ones(1, 3), torch.tensor([0]), torch.ones(1, 3), 0.0, ValueError, ("distance:", "got 0.0")),
        (torch.full((1, 3), math.inf), torch.tensor([0]), torch.ones(1, 3), 1.0, ValueError, ("src_means:", "NaN")),
    ],
)
def test_wrong_input_is_named(src, labels, dst, distance, error, message):
    refused(lambda: nearest_labels(src, labels, dst, distance), *message, error=error)


def test_destinations_that_are_not_finite_get_no_label_unless_strict():
    dst, said = torch.tensor([[math.nan, 0, 0], [0.5, 0, 0], [0, 0, math.inf]]), []
    with hear(said.append):
        result = nearest_labels(torch.zeros(1, 3), torch.tensor([4]), dst)
    assert (result.labels.tolist(), result.sources.tolist()) == ([-1, 4, -1], [-1, 0, -1])
    assert result.distances.tolist() == [math.inf, 0.5, math.inf]
    assert said == ["2 of 3 places are not finite: they get no label"]
    with hear(said.append, strict=True):
        refused(lambda: nearest_labels(torch.zeros(1, 3), torch.tensor([4]), dst), "dst_means:", said[0], "--strict")


def test_a_splat_is_labelled_in_one_call():
    """Sources at 0 and 1; destinations 0.1 and 0.25 from the first, and one out of reach."""
    field = balls([[0.0, 0, 0], [1, 0, 0]], [1, 0]).replace(names=("wall", "chair"))
    mine = balls([[0.1, 0, 0], [0.25, 0, 0], [9, 0, 0]], [7, 7, 7])
    mine = mine.replace(extra={"age": np.arange(3)}, names=("old",))
    labelled = transfer_labels(field, mine, 0.5)
    assert labelled.labels.tolist() == [1, 1, -1]
    assert labelled.scores.tolist() == pytest.approx([0.8, 0.5, 0.0])
    assert labelled.names == ("wall", "chair")
    assert labelled.extra["age"].tolist() == [0, 1, 2]
    assert mine.labels.tolist() == [7, 7, 7]
    far = mine.replace(means=mine.means - 1000, origin=(1000.0, 1000.0, 1000.0))
    assert transfer_labels(field, far, 0.5).labels.tolist() == [1, 1, -1]
    refused(lambda: transfer_labels(balls(points(3, 0)), mine), "source", "labels")
    refused(lambda: transfer_labels(field, "mine.ply"), "target", "str", "Gaussians", error=TypeError)


def default_distance(src, dst):
    return nearest_labels(src, torch.zeros(len(src), dtype=torch.int64), dst).distance


def above(height, n=100):
    axis = torch.arange(10.0)
    return torch.cartesian_prod(axis, axis, torch.zeros(1))[:n] + torch.tensor([0.0, 0.0, height])


@pytest.mark.parametrize(("height", "distance"), [(4.0, 4), (0.5, 2), (100.0, 10)])
def test_default_distance_covers_nearly_all_between_its_bounds(height, distance):
    result = nearest_labels(above(0.0), torch.zeros(100, dtype=torch.int64), above(height))
    assert result.distance == pytest.approx(distance)
    assert f"99.5 % of the destinations have a source within {height:g}; the sources' spacings are 1 " in result.how


def test_default_distance_scales_and_moves_with_the_scene():
    tail = torch.cat([above(4.0).repeat(10, 1)[:997], above(1000.0)[:3]])
    assert default_distance(above(0.0), tail) == pytest.approx(4)  # a few floaters do not stretch it
    src, dst = points(400, 8).double(), points(300, 9).double()
    expected = default_distance(src, dst)
    assert default_distance(src * 37, dst * 37) == pytest.approx(37 * expected)
    assert default_distance(src + 5, dst + 5) == pytest.approx(expected)
    assert nearest_labels(torch.ones(3, 3), torch.tensor([5, 5, 5]), torch.ones(2, 3)).labels.tolist() == [5, 5]


def test_a_sparse_wall_does_not_cut_the_reach_short():
    """Most sources crowd a corner; the bound looks at the wide spacings, so that destinations on the wall are reached."""
    axis = torch.arange(10.0)
    corner = torch.cartesian_prod(axis, axis, axis[:4]) * 0.01  # 400 sources, spacing 0.01
    between = above(0.0) + 0.5
    assert default_distance(torch.cat([above(0.0), corner + 20]), between) == pytest.approx(0.75**0.5)
