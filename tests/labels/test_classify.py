import math

import numpy as np
import pytest
import torch
from messages import tells
from oracles_labels import cosine, most_similar

from kfgs.labels import classify, label_codewords, select_by_query, select_like
from kfgs.labels import classify as classify_function


def random_rows(n, d, seed):
    return torch.randn(n, d, generator=torch.Generator().manual_seed(seed))


def test_labels_and_similarities_agree_with_the_oracle():
    codewords, embeddings = random_rows(40, 12, 0), random_rows(7, 12, 1)
    result = label_codewords(codewords, embeddings)
    assert result.labels.tolist() == most_similar(codewords, embeddings).tolist()
    expected = [[cosine(a, b) for b in embeddings.double().numpy()] for a in codewords.double().numpy()]
    np.testing.assert_allclose(result.similarity, expected, atol=1e-6)


def test_length_of_features_and_embeddings_does_not_matter():
    features, embeddings = random_rows(50, 8, 2), random_rows(5, 8, 3)
    scaled = classify(
        features * torch.logspace(-3, 3, 50)[:, None], embeddings * torch.tensor([[1], [9], [0.1], [50], [3.0]])
    )
    assert scaled.labels.equal(classify(features, embeddings).labels)


def test_all_zero_feature_has_no_class_and_score_zero():
    result = classify(torch.tensor([[0.0, 0.0], [-1.0, -1.0]]), torch.eye(2))
    assert result.labels.tolist() == [-1, 0]
    assert result.scores.tolist() == pytest.approx([0.0, -math.sqrt(0.5)])
    assert label_codewords(torch.zeros(1, 2), torch.eye(2)).labels.tolist() == [-1]


def test_tie_goes_to_the_lowest_class():
    assert classify(torch.tensor([[1.0, 1.0]]), torch.tensor([[0.0, 2.0], [2.0, 0.0], [0.0, 1.0]])).labels.tolist() == [
        0
    ]


def test_chunks_change_nothing(monkeypatch):
    import sys

    module = sys.modules[classify_function.__module__]
    features, embeddings = random_rows(103, 6, 4), random_rows(4, 6, 5)
    whole = classify(features, embeddings)
    monkeypatch.setattr(module, "CHUNK", 10)
    parts = classify(features, embeddings)
    assert parts.labels.equal(whole.labels)
    torch.testing.assert_close(parts.scores, whole.scores)


def test_no_features_give_no_labels():
    result = classify(torch.empty(0, 3), torch.eye(3))
    assert (result.labels.shape, result.scores.shape) == ((0,), (0,))


def test_dtype_follows_the_features():
    assert classify(torch.eye(3, dtype=torch.float64), torch.eye(3)).scores.dtype == torch.float64


@pytest.mark.parametrize(
    ("features", "embeddings", "message"),
    [
        (torch.ones(4, 3), torch.eye(2), ("embeddings:", "[C, D]", "D = 3", "got (2, 2)")),
        (torch.ones(4, 3), torch.empty(0, 3), ("embeddings:", "class", "got (0, 3)")),
        (torch.ones(4, 2), torch.tensor([[1.0, 0.0], [0.0, 0.0]]), ("embeddings:", "zeros", "row 1")),
        (torch.tensor([[1.0, 1.0], [math.nan, 0.0]]), torch.eye(2), ("features:", "row 1", "got NaN")),
        (torch.ones(1, 2), torch.tensor([[math.inf, 0.0]]), ("embeddings:", "got NaN")),
    ],
)
def test_wrong_input_is_named(features, embeddings, message):
    with pytest.raises(ValueError, match=tells(*message)):
        classify(features, embeddings)


def at_angles(degrees):
    angle = torch.deg2rad(torch.as_tensor(degrees, dtype=torch.float64))
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def test_given_threshold_is_strict_and_reported():
    result = select_by_query(torch.tensor([[1.0, 0.0], [3.0, 4.0], [0.0, 1.0]]), torch.tensor([1.0, 0.0]), 0.6)
    assert result.scores.tolist() == pytest.approx([1, 0.6, 0])
    assert result.mask.tolist() == [True, bool(result.scores[1] > 0.6), False]
    assert (result.threshold, result.how) == (0.6, "given")
    exactly = select_by_query(torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([1.0, 0.0]), 1.0)
    assert not exactly.mask.any()  # a cosine of 1 is not above 1


def test_all_zero_features_are_never_selected():
    result = select_by_query(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.tensor([1.0, 0.0]), -0.5)
    assert result.mask.tolist() == [False, True]


def test_automatic_threshold_finds_the_target():
    degrees = torch.cat([torch.linspace(10, 14, 20), torch.linspace(55, 65, 500), torch.linspace(75, 90, 1480)])
    result = select_by_query(at_angles(degrees), at_angles(0.0))
    assert result.mask.sum() == 20
    assert result.mask[:20].all()
    assert math.cos(math.radians(55)) < result.threshold < math.cos(math.radians(14))
    assert result.how.startswith("gap at")


@pytest.mark.parametrize(
    ("value", "message"), [(1.5, ("threshold:", "[-1, 1]", "got 1.5")), (math.nan, ("threshold:", "got nan"))]
)
def test_threshold_that_is_no_cosine_is_refused(value, message):
    with pytest.raises(ValueError, match=tells(*message)):
        select_by_query(torch.eye(2), torch.tensor([1.0, 0.0]), value)


def test_query_without_a_direction_is_refused():
    with pytest.raises(ValueError, match=tells("query:", "direction", "row 0")):
        select_by_query(torch.eye(2), torch.zeros(2))


def test_arrays_are_taken_and_a_name_gets_advice():
    rows, classes = torch.tensor([[2.0, 0.1], [0.1, 0.3]]), torch.eye(2)
    assert classify(rows.numpy(), classes.numpy()).labels.equal(classify(rows, classes).labels)
    assert classify(rows, classes.double()).labels.tolist() == [0, 1]
    expected = select_by_query(rows, classes[0], 0.5)
    assert select_by_query(rows.numpy(), classes[0].double().numpy(), 0.5).mask.equal(expected.mask)
    assert select_like(rows, np.array([0]), 0.5).mask.equal(select_like(rows, 0, 0.5).mask)
    for call in (lambda: select_by_query(rows, "chair"), lambda: classify(rows, "chair")):
        with pytest.raises(TypeError, match=tells("'chair'", "field.query", "OfClass")):
            call()


WHOLE = torch.eye(3, dtype=torch.int64)


@pytest.mark.parametrize(
    "ask",
    [
        lambda whole: classify(torch.eye(3), whole),
        lambda whole: classify(whole, torch.eye(3)),
        lambda whole: label_codewords(torch.eye(3), whole),
        lambda whole: select_by_query(torch.eye(3), whole[0]),
        lambda whole: select_by_query(torch.eye(3), torch.eye(3)[0], negatives=whole),
        lambda whole: select_like(whole, 0),
    ],
)
@pytest.mark.parametrize("whole", [WHOLE, WHOLE.numpy()], ids=["torch", "numpy"])
def test_whole_numbers_in_the_place_of_features_are_named(ask, whole):
    with pytest.raises(TypeError, match=tells("expected floating-point numbers", "int64", "convert")):
        ask(whole)


@pytest.mark.parametrize("size", [1e20, 1e37])
def test_numbers_whose_squares_overflow_are_named(size):
    huge = torch.eye(3) * size
    for ask in (
        lambda: classify(huge, torch.eye(3)),
        lambda: classify(torch.eye(3), huge),
        lambda: label_codewords(huge, torch.eye(3)),
        lambda: select_by_query(huge, torch.eye(3)[0]),
    ):
        with pytest.raises(ValueError, match=tells("squares", "float32", f"got {size:.3g}", "divide")):
            ask()
    assert classify(huge.double(), torch.eye(3).double()).labels.tolist() == [0, 1, 2]


def test_a_tiny_embedding_is_not_called_zero():
    with pytest.raises(ValueError, match=tells("embeddings:", "1e-08", "a length of 1e-37 in row 1")):
        classify(torch.eye(2), torch.tensor([[1.0, 0], [0, 1e-37]]))
