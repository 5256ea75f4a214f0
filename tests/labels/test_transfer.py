import math

import numpy as np
import pytest
import torch
from messages import tells
from oracles_labels import transfer as oracle

from kfgs.gaussians import Gaussians
from kfgs.labels import LabelSet, default_distance, label_splats, transfer_labels


def points(n, seed, scale=1.0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) * scale


@pytest.mark.parametrize("distance", [0.05, 0.2, 5.0])
def test_agrees_with_the_oracle(distance):
    src, dst = points(150, 0), points(200, 1)
    labels = torch.randint(-1, 4, (150,), generator=torch.Generator().manual_seed(2))
    result = transfer_labels(src, labels, dst, distance)
    expected_labels, expected_sources, expected_distances = oracle(src, labels, dst, distance)
    np.testing.assert_array_equal(result.labels, expected_labels)
    np.testing.assert_array_equal(result.sources, expected_sources)
    np.testing.assert_allclose(result.distances, expected_distances, rtol=1e-6)
    assert result.labelled == (expected_labels >= 0).sum()
    assert result.labelled + result.orphaned == 200
    assert (result.distance, result.how) == (distance, "given")


def test_distance_is_strict():
    src, dst = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[0.5, 0.0, 0.0]])
    assert transfer_labels(src, torch.tensor([7]), dst, 0.5).labels.tolist() == [-1]
    assert transfer_labels(src, torch.tensor([7]), dst, math.nextafter(0.5, 1)).labels.tolist() == [7]


@pytest.mark.parametrize("seed", range(5))
def test_tie_goes_to_the_lowest_index_in_any_order(seed):
    """12 sources at the corners of an icosahedron-like ring, all exactly 5 away: more equals than neighbours asked for."""
    offsets = [(x, y, 0) for x in (-3, 3) for y in (-4, 4)] + [(x, 0, z) for x in (-3, 3) for z in (-4, 4)]
    offsets += [(0, y, z) for y in (-3, 3) for z in (-4, 4)] + [(6, 0, 0)]
    order = torch.randperm(13, generator=torch.Generator().manual_seed(seed))
    src = torch.tensor(offsets, dtype=torch.float32)[order] + 10
    result = transfer_labels(src, torch.arange(13), torch.full((1, 3), 10.0), 9.0)
    lowest = next(i for i in range(13) if order[i] != 12)
    assert (result.sources.tolist(), result.labels.tolist()) == ([lowest], [lowest])
    assert result.distances.tolist() == [5.0]


def test_lattice_ties_agree_with_the_oracle():
    axis = torch.arange(5.0)
    src = torch.cartesian_prod(axis, axis, axis)[torch.randperm(125, generator=torch.Generator().manual_seed(3))]
    dst = torch.cartesian_prod(axis[:4], axis[:4], axis[:4]) + torch.tensor([0.5, 0.5, 0.0])
    dst = torch.cat([dst, dst + torch.tensor([0.0, 0.0, 0.5])])  # centres of faces and of cubes
    result = transfer_labels(src, torch.arange(125), dst, 2.0)
    np.testing.assert_array_equal(result.sources, oracle(src, np.arange(125), dst, 2.0)[1])


def test_many_sources_at_one_position_are_quick_and_the_first_speaks():
    src = torch.zeros(20000, 3)
    labels = torch.ones(20000, dtype=torch.int64)
    labels[0], labels[1] = -1, 2
    result = transfer_labels(src, labels, torch.full((500, 3), 0.1), 1.0)
    assert (result.labels == 2).all()
    assert (result.sources == 1).all()
    assert result.ambiguous == 500


def test_unlabelled_sources_neither_give_nor_hide():
    src = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    result = transfer_labels(src, torch.tensor([-1, 4]), torch.tensor([[0.1, 0.0, 0.0]]), 2.0)
    assert (result.labels.tolist(), result.sources.tolist()) == ([4], [1])


def test_ambiguous_counts_other_labels_in_range_only():
    src = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    dst = torch.tensor([[0.4, 0.0, 0.0], [-0.5, 0.0, 0.0], [5.2, 0.0, 0.0], [50.0, 0.0, 0.0]])
    result = transfer_labels(src, torch.tensor([0, 1, 0]), dst, 1.0)
    assert (result.labelled, result.orphaned, result.ambiguous) == (3, 1, 1)


@pytest.mark.parametrize("distance", [None, 0.3])
def test_no_labelled_source_orphans_everything(distance):
    dst = points(6, 4)
    for src, labels in ((torch.empty(0, 3), torch.empty(0, dtype=torch.int64)), (points(3, 5), torch.full((3,), -1))):
        result = transfer_labels(src, labels, dst, distance)
        assert result.labels.tolist() == [-1] * 6
        assert result.sources.tolist() == [-1] * 6
        assert result.distances.tolist() == [math.inf] * 6
        assert (result.labelled, result.orphaned, result.ambiguous) == (0, 6, 0)


def test_no_destinations_are_no_trouble():
    result = transfer_labels(points(5, 6), torch.arange(5), torch.empty(0, 3))
    assert (result.labels.shape, result.labelled, result.orphaned) == ((0,), 0, 0)


def test_dtypes_of_the_result():
    result = transfer_labels(points(5, 6), torch.arange(5, dtype=torch.uint8), points(4, 7).double(), 1.0)
    assert (result.labels.dtype, result.sources.dtype, result.distances.dtype) == (
        torch.int64,
        torch.int64,
        torch.float64,
    )


@pytest.mark.parametrize(
    ("src", "labels", "dst", "distance", "error", "message"),
    [
        (
            torch.ones(2, 3),
            torch.zeros(3),
            torch.ones(1, 3),
            1.0,
            ValueError,
            ("src_labels:", "[S]", "S = 2", "got (3,)"),
        ),
        (torch.ones(2, 3), torch.zeros(2), torch.ones(1, 3), 1.0, TypeError, ("src_labels:", "got torch.float32")),
        (torch.ones(2, 3), torch.tensor([0, -5]), torch.ones(1, 3), 1.0, ValueError, ("src_labels:", "-1", "got -5")),
        (
            torch.ones(2, 3),
            torch.tensor([0, 1]),
            torch.ones(1, 3),
            0.0,
            ValueError,
            ("distance:", "got 0.0"),
        ),
        (
            torch.ones(1, 3),
            torch.tensor([0]),
            torch.full((1, 3), math.nan),
            1.0,
            ValueError,
            ("dst_means:", "row 0", "got NaN"),
        ),
        (torch.full((1, 3), math.inf), torch.tensor([0]), torch.ones(1, 3), 1.0, ValueError, ("src_means:", "got NaN")),
    ],
)
def test_wrong_input_is_named(src, labels, dst, distance, error, message):
    with pytest.raises(error, match=tells(*message)):
        transfer_labels(src, labels, dst, distance)


@pytest.mark.parametrize("method", ["nearest", "vote", "mahalanobis"])
def test_parts_of_a_transfer_count_as_much_as_the_whole(method):
    """Sources of two classes lie at one place too: then shares alone do not tell who is ambiguous."""
    src = points(90, 8)
    src[:10] = src[10:20]
    labels = torch.randint(-1, 3, (90,), generator=torch.Generator().manual_seed(9))
    shape = torch.tensor([[1.0, 0, 0, 0]]).expand(90, 4), torch.full((90, 3), 0.03), torch.full((90,), 0.5)
    whole = transfer_labels(Gaussians(src, *shape), labels, points(300, 10), 0.2, method=method)
    counts = [whole.labelled, whole.orphaned, whole.ambiguous]
    assert min(counts) > 10
    number = torch.arange(300) % 3
    parts = [whole.select(number == i) for i in range(3)]
    assert [sum(x) for x in zip(*[(p.labelled, p.orphaned, p.ambiguous) for p in parts], strict=True)] == counts
    for name in ("labels", "distances", "sources", "shares", "disagree"):
        assert torch.equal(getattr(parts[1], name), getattr(whole, name)[1::3])
    assert (parts[0].distance, parts[0].how, parts[0].method) == (0.2, "given", method)
    some = whole.select(torch.tensor([7, 3]))
    assert some.labels.tolist() == [int(whole.labels[7]), int(whole.labels[3])]


def test_a_destination_says_itself_whether_its_sources_disagree():
    src = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [5.5, 0.0, 0.0], [9.0, 0.0, 0.0]])
    dst = torch.tensor([[0.1, 0.0, 0.0], [5.1, 0.0, 0.0], [9.1, 0.0, 0.0], [50.0, 0.0, 0.0]])
    result = transfer_labels(src, torch.tensor([0, 1, 0, 1, 0]), dst, 1.0)
    assert result.disagree.tolist() == [True, True, False, False]
    assert result.shares.tolist() == [
        1,
        0.5,
        1,
        0,
    ]  # of two at one place only the first speaks, but the other is counted


def test_a_mask_of_other_destinations_is_named():
    transfer = transfer_labels(points(5, 6), torch.arange(5), points(4, 7))
    with pytest.raises(ValueError, match=tells("which:", "[N]", "N = 4", "got (5,)")):
        transfer.select(torch.ones(5, dtype=torch.bool))


def gaussians(means, labels=None):
    n = len(means)
    return Gaussians(means, torch.ones(n, 4), torch.full((n, 3), 0.1), torch.full((n,), 0.5), labels=labels)


def test_arrays_gaussians_and_splats_give_the_same():
    src, dst = points(30, 4), points(20, 5)
    labels = torch.arange(30) % 3
    expected = transfer_labels(src, labels, dst, 0.3)
    for one, other in ((src.numpy(), dst.numpy()), (gaussians(src), gaussians(dst))):
        found = transfer_labels(one, labels.numpy(), other, 0.3)
        assert found.labels.equal(expected.labels)
        assert found.distances.equal(expected.distances)
        assert default_distance(one, other) == default_distance(src, dst)
    with pytest.raises(TypeError, match=tells("src", "'chair'")):
        transfer_labels("chair", labels, dst)


def test_a_splat_is_labelled_in_one_call():
    """Sources at 0 and 1; destinations 0.1 and 0.25 from the first, and one out of reach."""
    field = gaussians(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([1, 0]))
    mine = gaussians(torch.tensor([[0.1, 0, 0], [0.25, 0, 0], [9, 0, 0]]), torch.tensor([7, 7, 7]))
    splats = mine.replace(extra={"age": np.arange(3)}, names=("old",))
    made = label_splats(splats, field, LabelSet(("wall", "chair"), torch.eye(2)), 0.5)
    assert made.gaussians.labels.tolist() == [1, 1, -1]
    assert made.scores.tolist() == pytest.approx([0.8, 0.5, 0.0])
    assert made.extra["age"].tolist() == [0, 1, 2]
    assert (made.classes, made.info["format"]) == (("wall", "chair"), "ply")
    assert (made.info["labels"]["lambda"], made.info["labels"]["method"]) == (0.5, "nearest")
    assert splats.labels.tolist() == [7, 7, 7]
    again = label_splats(mine, field.replace(names=("wall", "chair")), distance=0.5, method="vote")
    assert again.names == ("wall", "chair")
    assert again.scores.tolist() == [1.0, 1.0, 0.0]
    with pytest.raises(ValueError, match=tells("labelled", "label")):
        label_splats(splats, gaussians(points(3, 0)))
    assert label_splats(mine, field, distance=0.5).classes == ()
    with pytest.raises(TypeError, match=tells("splats", "str", "read_splats")):
        label_splats("mine.ply", field)
    with pytest.raises(TypeError, match=tells("labelled", "ndarray", "Gaussians", "transfer_labels")):
        label_splats(mine, np.zeros((3, 3)))
