import json
import math

import numpy as np
import pytest
import torch
from messages import tells
from oracles_words import softmax_share

from kfgs.labels import LOGIT_SCALES, relevancy, select_by_category, select_by_query, select_by_similarity, select_like
from kfgs.labels.classify import classify
from kfgs.labels.scores import similarity_threshold, text_scores


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
    with pytest.raises(ValueError, match=tells("negatives:", "got none")):
        relevancy(torch.ones(3), torch.ones(3, 0))
    with pytest.raises(ValueError, match=tells("negatives:", "[N, M]", "N = 3", "got (4, 1)")):
        relevancy(torch.ones(3), torch.ones(4, 1))
    with pytest.raises(ValueError, match=tells("similarity:", "got NaN", "row 1")):
        select_by_similarity(torch.tensor([0.0, math.nan]))
    with pytest.raises(ValueError, match=tells("threshold:", "[0, 1]", "got -0.5")):
        select_by_similarity(torch.ones(2), torch.ones(2, 1), -0.5)
    with pytest.raises(ValueError, match=tells("negatives:", "direction", "row 0")):
        select_by_query(rows, rows[0], negatives=torch.zeros(1, 6))
    with pytest.raises(ValueError, match=tells("category:", "[0, 1]", "got 2")):
        select_by_category(rows, rows[:2], 2)
    with pytest.raises(ValueError, match=tells("like:", "got 4 to 4")):
        select_like(rows, 4)
    with pytest.raises(ValueError, match=tells("like:", "index below 4")):
        select_like(rows, torch.zeros(4, dtype=torch.bool))


def cosines(n=40, m=5, seed=0):
    values = torch.rand(n, 1 + m, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    return values[:, 0], values[:, 1:]


@pytest.mark.parametrize(("named", "scale"), [("raw", 1.0), ("lseg", 1 / 0.07), ("clip", 100.0), (3.5, 3.5)])
def test_softmax_is_the_share_of_the_query(named, scale):
    similarity, negatives = cosines()
    found = text_scores(similarity, negatives, score="softmax", logit_scale=named)
    np.testing.assert_allclose(found, softmax_share(similarity, negatives, scale), rtol=1e-9)


def test_softmax_shares_of_all_words_add_up_and_one_negative_is_a_relevancy():
    similarity, negatives = cosines()
    table = torch.cat([similarity[:, None], negatives], dim=1)
    shares = [
        text_scores(table[:, i], table[:, [j for j in range(6) if j != i]], score="softmax", logit_scale="raw")
        for i in range(6)
    ]
    torch.testing.assert_close(torch.stack(shares).sum(dim=0), torch.ones(40, dtype=torch.float64))
    one = text_scores(similarity, negatives[:, :1], score="softmax", logit_scale=10.0)
    torch.testing.assert_close(one, relevancy(similarity, negatives[:, :1]))


def test_a_raw_softmax_is_nearly_uniform_and_keeps_the_order():
    similarity, negatives = torch.tensor([0.3, 0.25, 0.2]), torch.full((3, 7), 0.2)
    raw = text_scores(similarity, negatives, score="softmax", logit_scale="raw")
    assert raw.tolist() == pytest.approx([0.125] * 3, abs=0.015)
    sharp = text_scores(similarity, negatives, score="softmax", logit_scale="clip")
    assert sharp[0] > 0.99
    assert sharp[2].item() == pytest.approx(0.125)
    assert raw.argsort().equal(sharp.argsort())


def test_defaults_are_the_relevancy_with_negatives_and_the_cosine_without():
    similarity, negatives = cosines()
    assert text_scores(similarity).equal(similarity)
    assert text_scores(similarity, negatives).equal(relevancy(similarity, negatives))
    assert text_scores(similarity, negatives, score="cosine").equal(similarity)


@pytest.mark.parametrize("score", ["cosine", "softmax", "relevancy"])
def test_zero_rows_score_zero_and_are_never_selected(score):
    features = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    found = select_by_query(features, torch.tensor([1.0, 0.0]), 0.0, torch.tensor([[0.0, 1.0]]), score=score)
    assert found.scores[0] == 0
    assert found.scores[1] > found.scores[2] >= 0
    assert not found.mask[0]
    assert found.mask[1]


def test_a_softmax_finds_its_threshold_in_the_scores_and_says_its_scale():
    similarity = torch.cat([torch.full((90,), 0.1), torch.full((10,), 0.4)])
    negatives = torch.full((100, 3), 0.2)
    found = select_by_similarity(similarity, negatives, score="softmax")
    assert found.indices.tolist() == list(range(90, 100))
    assert "softmax over 4 words, logit scale 100" in found.how
    raw = select_by_similarity(similarity, negatives, score="softmax", logit_scale="raw")
    assert raw.mask.equal(found.mask)  # nearly uniform, but its modes are apart all the same
    assert select_by_similarity(similarity, negatives, score="cosine").mask.equal(found.mask)


def test_wrong_options_are_named():
    similarity, negatives = cosines()
    with pytest.raises(ValueError, match=tells("score:", "'cosine', 'softmax', 'relevancy'", "got 'dot'")):
        text_scores(similarity, score="dot")
    with pytest.raises(ValueError, match=tells("negatives", "'softmax'", "got none")):
        text_scores(similarity, score="softmax")
    with pytest.raises(ValueError, match=tells("logit_scale:", "'raw', 'lseg', 'clip'", "got 'hot'")):
        text_scores(similarity, negatives, score="softmax", logit_scale="hot")
    with pytest.raises(ValueError, match=tells("logit_scale:", "(0, inf)", "got 0")):
        text_scores(similarity, negatives, score="softmax", logit_scale=0)
    with pytest.raises(ValueError, match=tells("threshold:", "[0, 1]", "got -0.5")):
        select_by_similarity(similarity, negatives, -0.5, score="softmax")
    with pytest.raises(ValueError, match=tells("negatives:", "got NaN")):
        text_scores(similarity, negatives.masked_fill(negatives < 0, float("nan")), score="softmax")
    assert set(LOGIT_SCALES) == {"raw", "lseg", "clip"}


# Facts about real embeddings: CLIP ViT-B/32 of LVIS's 1203 names ("a {name}"), CLIP ViT-B/16 of COCO-Stuff's 171.


@pytest.fixture(scope="module")
def lvis(shared_data):
    names = json.loads((shared_data / "text" / "names.json").read_text())["lvis_1203"]
    rows = np.load(shared_data / "text" / "lvis_1203_vitb32.npy").astype(np.float32)
    return names, torch.from_numpy(rows)


@pytest.mark.parametrize(
    ("word", "likest"),
    [("sofa", "sofa_bed"), ("pillow", "cushion"), ("cushion", "pillow"), ("cat", "kitten"), ("table", "desk")],
)
def test_the_nearest_word_of_a_thousand_means_nearly_the_same(lvis, word, likest):
    names, rows = lvis
    scores = select_by_query(rows, rows[names.index(word)], 0.5).scores
    first, second = scores.topk(2).indices.tolist()
    assert (names[first], names[second]) == (word, likest)


def test_a_cosine_alone_tells_little_among_words_and_relevancy_more(lvis):
    """Any two words have cosines near 0.74: 0.5, and every other fixed gamma, means nothing by itself."""
    names, rows = lvis
    sofa = rows[names.index("sofa")]
    assert len(select_by_query(rows, sofa, 0.5)) == len(names)
    against = rows[[names.index(word) for word in ("cat", "table", "lamp", "pillow", "banana")]]
    found = select_by_query(rows, sofa, negatives=against)
    kept = {names[i] for i in found.indices.tolist()}
    assert {"sofa", "sofa_bed", "loveseat", "armchair"} <= kept
    assert not {"cat", "table", "lamp", "pillow", "banana", "dog", "desk", "cushion"} & kept
    assert len(kept) < len(names) / 2


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


def test_two_values_are_cut_in_the_middle():
    threshold, _ = similarity_threshold(torch.tensor([0.2] * 30 + [0.8] * 10))
    assert threshold == pytest.approx(0.5, abs=0.02)


def test_copying_the_scores_does_not_move_the_threshold():
    scores = mixture([(0.4, 0.05, 900), (0.8, 0.02, 60)])
    assert similarity_threshold(scores.repeat(7))[0] == pytest.approx(similarity_threshold(scores)[0], abs=1e-12)


def test_shift_and_scale_carry_over():
    scores = mixture([(0.4, 0.05, 900), (0.8, 0.02, 60)])
    moved = similarity_threshold(scores * 0.5 - 0.2)[0]
    assert moved == pytest.approx(similarity_threshold(scores)[0] * 0.5 - 0.2, abs=0.005)


def test_equal_or_no_scores_select_nothing():
    equal = torch.full((9,), 0.7) + torch.tensor([0, 1e-8] + [0] * 7)
    threshold, how = similarity_threshold(equal)
    assert not (equal > threshold).any()
    assert "nothing stands out" in how
    assert similarity_threshold(torch.empty(0)) == (1.0, "no scores: nothing to select")


@pytest.mark.parametrize("parts", [[(0.3, 0.05, 60), (0.85, 0.02, 9)], [(0.6, 0.05, 40)], [(0.6, 0.0, 5)]])
def test_a_score_that_counts_several_times_is_that_many_scores(parts):
    scores = mixture(parts)
    times = torch.randint(1, 30, (len(scores),), generator=torch.Generator().manual_seed(1))
    threshold, how = similarity_threshold(scores.repeat_interleave(times))
    found, same = similarity_threshold(scores, times)
    assert found == pytest.approx(threshold, abs=1e-12)
    assert same == how
