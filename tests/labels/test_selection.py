import math
import operator

import numpy as np
import pytest
import torch

from kfgs.gaussians import Gaussians
from kfgs.labels import Selection, select_by_label, select_in_box, select_in_sphere, select_where


def some(seed, n=40):
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(n, generator=generator)
    return Selection(scores > 0.5, scores, 0.5, f"seed {seed}")


def cloud(labels):
    n = len(labels)
    means = torch.arange(3.0 * n).reshape(n, 3)
    return Gaussians(means, torch.ones(n, 4), torch.ones(n, 3), torch.full((n,), 0.5), labels=torch.tensor(labels))


def test_what_a_selection_knows():
    chosen = Selection(torch.tensor([False, True, True]), torch.tensor([0.1, 0.7, 0.9]), 0.5, "given")
    assert len(chosen) == 2
    assert chosen.indices.tolist() == [1, 2]
    assert repr(chosen) == "Selection(2 of 3 Gaussians: score > 0.5 (given))"
    assert not select_where(torch.zeros(3, dtype=torch.bool))  # empty is false


@pytest.mark.parametrize(
    ("combine", "mask", "scores"),
    [
        (operator.and_, [1, 0, 0, 0], [0.6, 0.1, 0.2, 0.3]),
        (operator.or_, [1, 1, 1, 0], [0.9, 0.8, 0.7, 0.4]),
        (operator.sub, [0, 1, 0, 0], [0.4, 0.8, 0.2, 0.4]),
        (operator.xor, [0, 1, 1, 0], [0.4, 0.8, 0.7, 0.4]),
    ],
)
def test_algebra_by_hand(combine, mask, scores):
    a = Selection(torch.tensor([True, True, False, False]), torch.tensor([0.9, 0.8, 0.2, 0.4]), 0.5, "a")
    b = Selection(torch.tensor([True, False, True, False]), torch.tensor([0.6, 0.1, 0.7, 0.3]), None, "b")
    result = combine(a, b)
    assert result.mask.int().tolist() == mask
    assert result.scores.tolist() == pytest.approx(scores)
    assert result.threshold is None
    assert "score > 0.5 (a)" in result.how
    assert "(b)" in result.how


def test_laws_of_the_algebra():
    a, b, c = some(0), some(1), some(2)

    def same(left, right):
        assert left.mask.equal(right.mask)
        torch.testing.assert_close(left.scores, right.scores)

    same(~(a & b), ~a | ~b)
    same(~(a | b), ~a & ~b)
    same(~~a, a)
    same(a - b, a & ~b)
    same(a & (b | c), (a & b) | (a & c))
    same(a ^ b, b ^ a)
    assert len(a ^ a) == 0
    assert len(a | ~a) == 40


def test_a_place_cuts_a_query_and_leaves_its_scores():
    query = some(3)
    place = select_where(torch.arange(40) < 20)
    inside = query & place
    assert inside.indices.equal(query.indices[query.indices < 20])
    assert inside.scores[:20].equal(query.scores[:20])
    assert (query - place).scores[20:].equal(query.scores[20:])


def test_within_keeps_scores_and_threshold():
    query = some(4)
    part = query.within(torch.arange(40) < 10, "the first ten")
    assert part.scores.equal(query.scores)
    assert (part.threshold, part.how) == (0.5, "seed 4; the first ten")
    assert part.indices.tolist() == [i for i in query.indices.tolist() if i < 10]


def test_by_label_index_name_or_several():
    gaussians, names = cloud([0, 1, -1, 2, 1]), ("wall", "chair", "lamp")
    assert select_by_label(gaussians, 1).indices.tolist() == [1, 4]
    assert select_by_label(gaussians, "chair", names).indices.tolist() == [1, 4]
    assert select_by_label(gaussians, ["lamp", 0], names).indices.tolist() == [0, 3]
    assert select_by_label(gaussians, -1).indices.tolist() == [2]
    assert len(select_by_label(gaussians, [])) == 0
    assert select_by_label(gaussians, "CHAIR", names).indices.tolist() == [1, 4]
    assert select_by_label(gaussians, "chair", ("wall", "chair", "chair")).indices.tolist() == [1, 3, 4]
    for one in (np.int64(1), torch.tensor(1), np.array([1]), [torch.tensor(1)], {1}):
        assert select_by_label(gaussians, one).indices.tolist() == [1, 4]
    scores = torch.linspace(0, 1, 5)
    assert select_by_label(gaussians, 1, scores=scores).scores.equal(scores)


def test_box_and_sphere_hold_their_faces():
    means = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1.001, 0, 0], [0.5, 0.25, -0.001]])
    assert select_in_box(means, ([0, 0, 0], [1, 1, 1])).mask.tolist() == [True, True, False, False]
    assert select_in_sphere(means, [0, 0, 0], 1.0).mask.tolist() == [True, False, False, True]
    assert select_in_sphere(means, torch.tensor([1.0, 1, 1]), 0).indices.tolist() == [1]
    assert select_in_box(means, ([0, 0, 0], [1, 1, 1])).how == "in a box of 1 x 1 x 1"


def test_wrong_input_is_named():
    a, gaussians = some(0), cloud([0, 1])
    with pytest.raises(ValueError, match="other: expected a selection among the same 40 Gaussians, got one among 39"):
        a & some(1, n=39)
    with pytest.raises(ValueError, match="other: expected a selection among the same 40"):
        a ^ some(1, n=39)
    with pytest.raises(TypeError, match="other: expected a Selection, got Tensor; make one"):
        a - a.mask
    with pytest.raises(TypeError, match="mask: expected a boolean mask, got torch.float32"):
        select_where(torch.ones(3))
    with pytest.raises(ValueError, match=r"scores: expected \[N\] with N = 3 \(from mask\), got \(4,\)"):
        Selection(torch.ones(3, dtype=torch.bool), torch.ones(4))
    with pytest.raises(ValueError, match="scores: expected finite numbers, got NaN or infinity in row 1"):
        Selection(torch.ones(2, dtype=torch.bool), torch.tensor([0.0, math.nan]))
    with pytest.raises(ValueError, match="class: expected one of wall, chair, got 'chiar'; did you mean 'chair'?"):
        select_by_label(gaussians, "chiar", ("wall", "chair"))
    for wrong in (1.5, [1, 2.0], True, None):
        with pytest.raises(ValueError, match="label: expected a whole number, got .*; pass an int"):
            select_by_label(gaussians, wrong)
    with pytest.raises(ValueError, match=r"label: expected a number in \[-1, .*got -2"):
        select_by_label(gaussians, -2)
    with pytest.raises(ValueError, match="gaussians.labels: expected labels"):
        select_by_label(gaussians.replace(labels=None), 1)
    with pytest.raises(ValueError, match="half: expected half edges >= 0"):
        select_in_box(torch.zeros(1, 3), ([0, 0, 1], [1, 1, 0]))
    with pytest.raises(ValueError, match=r"radius: expected a number in \[0, inf\), got -1"):
        select_in_sphere(torch.zeros(1, 3), [0, 0, 0], -1)
    with pytest.raises(ValueError, match="center: expected finite numbers"):
        select_in_sphere(torch.zeros(1, 3), [0, math.nan, 0], 1)
    with pytest.raises(ValueError, match="means: expected finite numbers, got NaN or infinity in row 1"):
        select_in_sphere(torch.tensor([[0.0, 0, 0], [math.nan, 0, 0]]), [0, 0, 0], 1)


def test_a_name_in_bytes_is_refused():
    with pytest.raises((TypeError, ValueError), match="label: expected"):
        select_by_label(cloud([0, 1]), b"chair", ("wall", "chair"))
