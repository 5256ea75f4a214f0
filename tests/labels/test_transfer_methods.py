import math

import numpy as np
import pytest
import torch
from messages import tells
from oracles_labels import vote as oracle
from oracles_splat import covariance

from kfgs.gaussians import Gaussians
from kfgs.labels import transfer_labels


def cloud(N, seed, size=0.15):
    g = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=g)  # noqa: E731
    return Gaussians(rand(N, 3), rand(N, 4) - 0.5, 0.01 + size * rand(N, 3), 0.05 + 0.9 * rand(N))


def labels_for(N, seed=2):
    return torch.randint(-1, 4, (N,), generator=torch.Generator().manual_seed(seed))


def ball(means, sigma=0.1, opacity=0.5):
    N = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(N, 4)
    return Gaussians(torch.tensor(means), quats, torch.full((N, 3), sigma), torch.full((N,), opacity))


@pytest.mark.parametrize(("distance", "neighbours"), [(0.15, 8), (0.4, 3), (5.0, 16), (5.0, 500)])
@pytest.mark.parametrize("shaped", [True, False])
def test_vote_agrees_with_the_oracle(distance, neighbours, shaped):
    src, dst, labels = cloud(120, 0), cloud(80, 1).means, labels_for(120)

    def weigh(i, j):
        d = float(np.linalg.norm(src.means[i].double().numpy() - dst[j].double().numpy()))
        return (float(src.opacities[i]) if shaped else 1.0) / d, d

    given = src if shaped else src.means
    result = transfer_labels(given, labels, dst, distance, method="vote", neighbours=neighbours)
    expected_labels, shares, sources = oracle(src.means, labels, dst, distance, neighbours, weigh)
    np.testing.assert_array_equal(result.labels, expected_labels)
    np.testing.assert_array_equal(result.sources, sources)
    np.testing.assert_allclose(result.shares, shares, rtol=1e-5)
    assert (result.method, result.labelled) == ("vote", (expected_labels >= 0).sum())


@pytest.mark.parametrize("deviations", [1.0, 5.0, 40.0])
@pytest.mark.parametrize("shaped", [True, False])
def test_mahalanobis_agrees_with_the_oracle(deviations, shaped):
    src, dst, labels = cloud(120, 0), cloud(80, 1), labels_for(120)

    def weigh(i, j):
        sigma = covariance(src.quats[i].numpy(), src.scales[i].numpy())
        if shaped:
            sigma = sigma + covariance(dst.quats[j].numpy(), dst.scales[j].numpy())
        d = src.means[i].double().numpy() - dst.means[j].double().numpy()
        squares = float(d @ np.linalg.inv(sigma) @ d)
        return float(src.opacities[i]) * math.exp(-0.5 * squares), math.sqrt(squares)

    given = dst if shaped else dst.means
    result = transfer_labels(src, labels, given, 0.4, method="mahalanobis", neighbours=12, deviations=deviations)
    expected = oracle(src.means, labels, dst.means, 0.4, 12, weigh, limit=deviations)
    np.testing.assert_array_equal(result.labels, expected[0])
    np.testing.assert_array_equal(result.sources, expected[2])
    np.testing.assert_allclose(result.shares, expected[1], rtol=1e-4, atol=1e-6)
    assert result.orphaned == (expected[0] < 0).sum()


def test_nearest_share_counts_the_four_nearest_in_range():
    src = torch.tensor([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [0.4, 0, 0], [0.5, 0, 0]])
    result = transfer_labels(src, torch.tensor([1, 2, 2, 1, 2]), torch.zeros(1, 3), 1.0)
    assert (result.labels.tolist(), result.shares.tolist()) == ([1], [0.5])
    assert transfer_labels(src, torch.tensor([1, 2, 2, 1, 2]), torch.zeros(1, 3), 0.35).shares.tolist() == [
        pytest.approx(1 / 3)
    ]


def test_opacity_outvotes_distance():
    src = ball([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    src = src.replace(opacities=torch.tensor([0.1, 0.9]))
    labels, dst = torch.tensor([0, 1]), torch.zeros(1, 3)
    assert transfer_labels(src, labels, dst, 1.0).labels.tolist() == [0]
    voted = transfer_labels(src, labels, dst, 1.0, method="vote")
    assert (voted.labels.tolist(), voted.sources.tolist()) == ([1], [1])
    assert voted.shares.tolist() == [pytest.approx(4.5 / 5.5)]  # 0.9 / 0.2 against 0.1 / 0.1
    assert voted.distances.tolist() == [pytest.approx(0.2)]


def test_tied_votes_go_to_the_label_with_the_nearest_voter():
    src = torch.tensor([[2.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]])
    result = transfer_labels(src, torch.tensor([3, 3, 5]), torch.zeros(1, 3), 9.0, method="vote")  # 1/2 + 1/2 = 1
    assert (result.labels.tolist(), result.shares.tolist(), result.sources.tolist()) == ([5], [0.5], [2])


@pytest.mark.parametrize("seed", range(4))
def test_equally_near_voters_are_the_lowest_indices(seed):
    """8 sources exactly 5 away and 3 votes: the first three of the list, wherever the tree keeps them."""
    corners = torch.tensor(
        [(x, y, 0) for x in (-3, 3) for y in (-4, 4)] + [(x, 0, y) for x in (-3, 3) for y in (-4, 4)]
    )
    order = torch.randperm(8, generator=torch.Generator().manual_seed(seed))
    src, labels = corners[order].float(), torch.tensor([7, 4, 4, 7, 7, 7, 7, 7])
    result = transfer_labels(src, labels, torch.zeros(1, 3), 9.0, method="vote", neighbours=3)
    assert (result.labels.tolist(), result.sources.tolist()) == ([4], [1])
    assert result.shares.tolist() == [pytest.approx(2 / 3)]


def test_a_long_gaussian_reaches_along_its_axis_only():
    src = ball([[0.0, 0.0, 0.0], [1.0, 0.6, 0.0]]).replace(scales=torch.tensor([[1.0, 0.05, 0.05], [0.1, 0.1, 0.1]]))
    labels = torch.tensor([0, 1])
    along, beside = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 0.4, 0.0]])
    kind = {"method": "mahalanobis", "distance": 2.0}
    assert transfer_labels(src, labels, along, 2.0).labels.tolist() == [1]  # nearer by its centre, 6 deviations away
    assert transfer_labels(src, labels, along, **kind).labels.tolist() == [0]
    assert transfer_labels(src, labels, beside, **kind).labels.tolist() == [
        -1
    ]  # 8 deviations from one, 10 from the other
    assert transfer_labels(src, labels, beside, deviations=9.0, **kind).labels.tolist() == [0]


def test_a_large_destination_reaches_further_than_a_point():
    src, labels = ball([[0.0, 0.0, 0.0]], sigma=0.1), torch.tensor([3])
    for sigma, expected in ((0.01, -1), (0.2, 3)):  # 0.6 is 6.0 and 2.7 standard deviations of the two together
        dst = ball([[0.6, 0.0, 0.0]], sigma=sigma)
        assert transfer_labels(src, labels, dst, 2.0, method="mahalanobis").labels.tolist() == [expected]


def test_both_limits_hold():
    src, labels = ball([[0.0, 0.0, 0.0]], sigma=1.0), torch.tensor([3])
    dst = torch.tensor([[0.9, 0.0, 0.0], [1.1, 0.0, 0.0]])
    assert transfer_labels(src, labels, dst, 1.0, method="mahalanobis").labels.tolist() == [3, -1]
    within = transfer_labels(src, labels, dst, 9.0, method="mahalanobis", deviations=1.0)
    assert within.labels.tolist() == [3, -1]


def test_flat_faint_and_coincident_gaussians_do_no_harm():
    """A disc of no thickness, an opacity of 0 and a source at the destination itself: labels, and no warning."""
    src = ball([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    src = src.replace(scales=torch.tensor([[0.2, 0.2, 0.0], [0.0, 0.0, 0.0]]), opacities=torch.tensor([0.0, 1.0]))
    dst = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.3, 0.0, 0.0]])
    for method in ("vote", "mahalanobis"):
        result = transfer_labels(src, torch.tensor([1, 2]), dst, 0.2, method=method)
        assert result.labels.tolist() == [1, 1, 2]
        assert torch.isfinite(result.shares).all()


@pytest.mark.parametrize("method", ["nearest", "vote", "mahalanobis"])
def test_where_all_agree_the_methods_agree(method):
    src, dst = cloud(200, 4), cloud(300, 5)
    result = transfer_labels(src, torch.full((200,), 6), dst, 0.5, method=method, deviations=1e6)
    assert result.labels.unique().tolist() == [6]
    assert (result.shares == 1).all()
    assert (result.ambiguous, result.orphaned) == (0, 0)
    assert method in repr(result)


@pytest.mark.parametrize("method", ["nearest", "vote", "mahalanobis"])
def test_order_and_scale_of_the_scene_do_not_matter(method):
    src, dst, labels = cloud(150, 6), cloud(120, 7), labels_for(150)
    expected = transfer_labels(src, labels, dst, 0.3, method=method)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(8))
    shuffled = transfer_labels(src.select(order), labels[order], dst, 0.3, method=method)
    assert shuffled.labels.equal(expected.labels)
    assert order[shuffled.sources[shuffled.sources >= 0]].equal(expected.sources[expected.sources >= 0])
    big = [c.replace(means=c.means * 64, scales=c.scales * 64) for c in (src, dst)]
    grown = transfer_labels(big[0], labels, big[1], 0.3 * 64, method=method)
    assert grown.labels.equal(expected.labels)
    assert grown.ambiguous == expected.ambiguous


@pytest.mark.parametrize("method", ["vote", "mahalanobis"])
def test_nothing_in_nothing_out(method):
    src, dst = cloud(5, 0), cloud(6, 1)
    empty = transfer_labels(src, torch.full((5,), -1), dst, method=method)
    assert (empty.labels.tolist(), empty.shares.tolist()) == ([-1] * 6, [0] * 6)
    none = transfer_labels(src, torch.arange(5), dst.select(torch.arange(0)), method=method)
    assert (len(none.labels), none.labelled) == (0, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "average"}, ("method:", "'nearest', 'vote', 'mahalanobis'", "got 'average'")),
        ({"method": "vote", "neighbours": 0}, ("neighbours:", "got 0")),
        ({"method": "vote", "neighbours": 2.5}, ("neighbours:", "got 2.5")),
        ({"method": "mahalanobis", "deviations": 0.0}, ("deviations:", "got 0.0")),
        ({"method": "mahalanobis", "src": torch.ones(4, 3)}, ("src:", "Gaussians", "'mahalanobis'")),
        ({"method": "mahalanobis", "src": ball([[math.nan, 0, 0]] * 4)}, ("src_means:", "row 0", "got NaN")),
        (
            {"method": "mahalanobis", "src": ball([[0.0, 0, 0]] * 4, math.inf)},
            ("src.scales, src.quats:", "row 0", "got NaN"),
        ),
        (
            {"method": "mahalanobis", "dst": ball([[0.0, 0, 0]] * 4, math.nan)},
            ("dst.scales, dst.quats:", "row 0", "got NaN"),
        ),
        ({"method": "vote", "src": ball([[0.0, 0, 0]] * 4, 1.0, math.nan)}, ("src.opacities:", "row 0", "got NaN")),
    ],
)
def test_wrong_options_are_named(options, message):
    options = {"src": cloud(4, 0), "dst": cloud(4, 1), **options}
    with pytest.raises(ValueError, match=tells(*message)):
        transfer_labels(src_labels=torch.arange(4), distance=1.0, **options)
