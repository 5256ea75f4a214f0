import json

import numpy as np
import pytest
import torch
from oracles_words import softmax_share

from kfgs.labels import LOGIT_SCALES, relevancy, select_by_query, select_by_similarity, text_scores


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
    with pytest.raises(ValueError, match="score: expected one of 'cosine', 'softmax', 'relevancy', got 'dot'"):
        text_scores(similarity, score="dot")
    with pytest.raises(ValueError, match="negatives: expected some for score 'softmax', got none; pass what"):
        text_scores(similarity, score="softmax")
    with pytest.raises(ValueError, match="logit_scale: expected one of 'raw', 'lseg', 'clip', got 'hot'"):
        text_scores(similarity, negatives, score="softmax", logit_scale="hot")
    with pytest.raises(ValueError, match=r"logit_scale: expected a number in \(0, inf\), got 0"):
        text_scores(similarity, negatives, score="softmax", logit_scale=0)
    with pytest.raises(ValueError, match=r"threshold: expected a number in \[0, 1\], got -0.5"):
        select_by_similarity(similarity, negatives, -0.5, score="softmax")
    with pytest.raises(ValueError, match="negatives: expected finite numbers, got NaN"):
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
