import math

import numpy as np
import pytest
import torch
from messages import refused

from kfgs.labels.scores import similarity_threshold
from kfgs.labels.selection import select_by_similarity


def oracle(similarity, negatives):
    """LERF's rule as it stands in the paper: the least of the pairwise softmaxes at temperature 10."""
    result = np.empty(len(similarity))
    for i, s in enumerate(np.asarray(similarity, np.float64)):
        result[i] = min(math.exp(10 * s) / (math.exp(10 * s) + math.exp(10 * n)) for n in np.asarray(negatives[i]))
    return result


def test_relevancy_is_the_least_pairwise_softmax():
    generator = torch.Generator().manual_seed(3)
    similarity = torch.rand(50, generator=generator, dtype=torch.float64) * 2 - 1
    negatives = torch.rand(50, 4, generator=generator, dtype=torch.float64) * 2 - 1
    scores = select_by_similarity(similarity, negatives).scores
    np.testing.assert_allclose(scores, oracle(similarity, negatives), rtol=1e-12)
    assert select_by_similarity(similarity).scores.equal(similarity)  # without negatives the cosine
    assert select_by_similarity(similarity, negatives, score="cosine").scores.equal(similarity)


def test_what_knows_nothing_is_not_selected_and_shapes_no_gamma():
    similarity = torch.tensor([0.2] * 30 + [0.8] * 10 + [0.99] * 10)
    known = torch.tensor([True] * 40 + [False] * 10)
    result = select_by_similarity(similarity, known=known)
    assert result.mask.tolist() == [False] * 30 + [True] * 10 + [False] * 10
    assert 0.4 < result.threshold < 0.6
    assert not result.scores[40:].any()


def test_a_threshold_on_the_relevancy_is_strict():
    similarity, negatives = torch.tensor([0.5, 0.6, 0.2]), torch.tensor([[0.5], [0.1], [0.4]])
    assert select_by_similarity(similarity, negatives).mask.tolist() == [False, True, False]  # 0.5 is not above 0.5
    assert select_by_similarity(similarity, negatives, 0.1).mask.tolist() == [True, True, True]


def test_wrong_input_is_named():
    similarity, negatives = torch.rand(3), torch.rand(3, 2)
    refused(lambda: select_by_similarity(torch.tensor([0.0, math.nan])), "similarity:", "got NaN", "row 1")
    refused(lambda: select_by_similarity(similarity, negatives, -0.5), "threshold:", "[0, 1]", "got -0.5")
    refused(lambda: select_by_similarity(similarity, threshold=1.5), "threshold:", "[-1, 1]", "got 1.5")
    refused(lambda: select_by_similarity(similarity, score="dot"), "score:", "'cosine', 'relevancy'", "got 'dot'")
    refused(lambda: select_by_similarity(similarity, score="relevancy"), "negatives", "got none")


def mixture(parts, seed=0):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(np.concatenate([rng.normal(mean, std, n) for mean, std, n in parts]))


@pytest.mark.parametrize("targets", [100, 500, 5000, 20000])
def test_gap_lies_below_the_highest_mode_however_rare_it_is(targets):
    rest = [(0.3, 0.03, 15000), (0.5, 0.04, 25000), (0.6, 0.04, 10000)]
    threshold, how = similarity_threshold(mixture([*rest, (0.85, 0.02, targets)]))
    assert 0.68 < threshold < 0.8
    assert how.startswith("gap at")


def test_one_mode_is_cut_in_its_upper_tail_and_says_so():
    """A normal mode N(0.6, 0.05): its 99.9 % quantile is 0.6 + 3.0902 x 0.05, and 70 % of that way is 0.7082."""
    threshold, how = similarity_threshold(mixture([(0.6, 0.05, 20000)]))
    assert threshold == pytest.approx(0.6 + 0.7 * 3.0902 * 0.05, abs=0.004)
    assert "no clear gap" in how


def test_a_gap_within_the_rest_is_no_target():
    """The deepest gap parts the rest in two; most of the scene lies above it, so the shallow gap above is taken."""
    rest = [(0.25, 0.01, 4000), (0.55, 0.06, 14000)]
    threshold, how = similarity_threshold(mixture([*rest, (0.85, 0.02, 400)]))
    assert 0.7 < threshold < 0.82
    assert how.startswith("gap at")
    alone, how = similarity_threshold(mixture(rest))
    assert alone > 0.6
    assert "no clear gap" in how


def test_most_of_the_scene_can_be_the_target_if_it_stands_apart():
    rest = [(0.45, 0.03, 4000), (0.55, 0.03, 4000)]
    threshold, how = similarity_threshold(mixture([*rest, (0.85, 0.02, 12000)]))
    assert 0.64 < threshold < 0.8
    assert how.startswith("gap at")
    too_much = similarity_threshold(mixture([*rest, (0.85, 0.02, 40000)]))[0]
    assert too_much > 0.85  # 83 % are no target, but what the rest is to


def test_equal_or_no_scores_select_nothing():
    equal = torch.full((9,), 0.7) + torch.tensor([0, 1e-8] + [0] * 7)
    threshold, how = similarity_threshold(equal)
    assert not (equal > threshold).any()
    assert "nothing stands out" in how
    assert similarity_threshold(torch.empty(0)) == (1.0, "no scores: nothing to select")
