import math

import numpy as np
import pytest
import torch

from kfgs.labels import relevancy, select_by_category, select_by_query, select_by_similarity, select_like
from kfgs.labels.classify import classify


def oracle(similarity, negatives):
    """LERF's rule as it stands in the paper: the least of the pairwise softmaxes at temperature 10."""
    result = np.empty(len(similarity))
    for i, s in enumerate(np.asarray(similarity, np.float64)):
        result[i] = min(math.exp(10 * s) / (math.exp(10 * s) + math.exp(10 * n)) for n in np.asarray(negatives[i]))
    return result


def features(n=200, channels=6, seed=0):
    return torch.randn(n, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_relevancy_is_the_least_pairwise_softmax():
    generator = torch.Generator().manual_seed(3)
    similarity = torch.rand(50, generator=generator, dtype=torch.float64) * 2 - 1
    negatives = torch.rand(50, 4, generator=generator, dtype=torch.float64) * 2 - 1
    np.testing.assert_allclose(relevancy(similarity, negatives), oracle(similarity, negatives), rtol=1e-12)


def test_all_other_classes_as_negatives_are_the_category():
    rows, classes = features(), features(5, seed=1)
    found = classify(rows, classes).labels
    for k in range(5):
        others = torch.cat([classes[:k], classes[k + 1 :]])
        result = select_by_query(rows, classes[k], negatives=others)
        assert result.mask.equal(found == k)
        assert result.mask.equal(select_by_category(rows, classes, k).mask)
        assert (result.threshold, result.how) == (0.5, "more like the query than like any of 4 negatives")


def test_category_scores_are_the_winning_cosine():
    result = select_by_category(torch.tensor([[3.0, 4.0], [4.0, 3.0], [0.0, 0.0]]), torch.eye(2), 1)
    assert result.mask.tolist() == [True, False, False]
    assert result.scores.tolist() == pytest.approx([0.8, 0, 0])


def test_what_knows_nothing_is_not_selected_and_shapes_no_gamma():
    similarity = torch.tensor([0.2] * 30 + [0.8] * 10 + [0.99] * 10)
    valid = torch.tensor([True] * 40 + [False] * 10)
    result = select_by_similarity(similarity, valid=valid)
    assert result.mask.tolist() == [False] * 30 + [True] * 10 + [False] * 10
    assert 0.4 < result.threshold < 0.6
    assert not result.scores[40:].any()


def test_a_threshold_on_the_relevancy_is_strict():
    similarity, negatives = torch.tensor([0.5, 0.6, 0.2]), torch.tensor([[0.5], [0.1], [0.4]])
    assert select_by_similarity(similarity, negatives).mask.tolist() == [False, True, False]  # 0.5 is not above 0.5
    assert select_by_similarity(similarity, negatives, 0.1).mask.tolist() == [True, True, True]


def test_like_an_example_or_the_mean_of_some():
    rows = torch.tensor([[2.0, 0.0], [1.0, 1.0], [0.0, 5.0], [-1.0, 0.0]])
    assert select_like(rows, 0, 0.5).scores.tolist() == pytest.approx([1, math.sqrt(0.5), 0, -1])
    diagonal = select_like(rows, torch.tensor([0, 2]), 0.9)  # lengths do not count: the mean direction is the diagonal
    assert diagonal.mask.tolist() == [False, True, False, False]
    by_mask = select_like(rows, torch.tensor([True, False, True, False]), 0.9)
    assert by_mask.scores.equal(diagonal.scores)


def test_wrong_input_is_named():
    rows = features(4)
    with pytest.raises(ValueError, match="negatives: expected at least one column, got none"):
        relevancy(torch.ones(3), torch.ones(3, 0))
    with pytest.raises(ValueError, match=r"negatives: expected \[N, M\] with N = 3 \(from similarity\)"):
        relevancy(torch.ones(3), torch.ones(4, 1))
    with pytest.raises(ValueError, match="similarity: expected finite numbers, got NaN or infinity in row 1"):
        select_by_similarity(torch.tensor([0.0, math.nan]))
    with pytest.raises(ValueError, match=r"threshold: expected a number in \[0, 1\], got -0.5"):
        select_by_similarity(torch.ones(2), torch.ones(2, 1), -0.5)
    with pytest.raises(ValueError, match="negatives: expected rows with a direction, got all zeros in row 0"):
        select_by_query(rows, rows[0], negatives=torch.zeros(1, 6))
    with pytest.raises(ValueError, match=r"category: expected a number in \[0, 1\], got 2"):
        select_by_category(rows, rows[:2], 2)
    with pytest.raises(ValueError, match="like: expected indices from 0 to 3, got 4 to 4"):
        select_like(rows, 4)
    with pytest.raises(ValueError, match="like: expected at least one index below 4"):
        select_like(rows, torch.zeros(4, dtype=torch.bool))
