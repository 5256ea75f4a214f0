import math
import operator

import numpy as np
import pytest
import torch
from messages import tells

from kfgs.gaussians import Gaussians
from kfgs.labels import AboveScore, InBox, InSphere, OfClass, OrientedBox, Selection


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
    assert not Selection.of(torch.zeros(3, dtype=torch.bool))  # empty is false


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
    place = Selection.of(torch.arange(40) < 20)
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


def test_of_a_class_by_index_or_name():
    gaussians, names = cloud([0, 1, -1, 2, 1]), ("wall", "chair", "lamp")
    assert OfClass(1).select(gaussians).indices.tolist() == [1, 4]
    assert OfClass("chair").select(gaussians, names).indices.tolist() == [1, 4]
    assert (OfClass("lamp") | OfClass(0)).select(gaussians, names).indices.tolist() == [0, 3]
    assert OfClass(-1).select(gaussians).indices.tolist() == [2]
    assert OfClass("CHAIR").select(gaussians, names).indices.tolist() == [1, 4]
    assert OfClass("chair").select(gaussians, ("wall", "chair", "chair")).indices.tolist() == [1, 3, 4]
    found = OfClass("chair").select(gaussians.replace(names=names))
    assert (found.indices.tolist(), found.scores.tolist()) == ([1, 4], [0, 1, 0, 0, 1])
    assert (found.threshold, found.how) == (None, "label chair")
    for one in (np.int64(1), torch.tensor(1)):
        assert OfClass(one).select(gaussians).indices.tolist() == [1, 4]


def placed(means):
    n = len(means)
    return Gaussians(means, torch.ones(n, 4), torch.ones(n, 3), torch.full((n,), 0.5))


def test_box_and_sphere_hold_their_faces():
    means = placed(torch.tensor([[0.0, 0, 0], [1, 1, 1], [1.001, 0, 0], [0.5, 0.25, -0.001]]))
    assert InBox([0, 0, 0], [1, 1, 1]).mask(means).tolist() == [True, True, False, False]
    assert InSphere([0, 0, 0], 1.0).mask(means).tolist() == [True, False, False, True]
    assert InSphere(torch.tensor([1.0, 1, 1]), 1e-9).select(means).indices.tolist() == [1]
    assert InBox([0, 0, 0], [1, 1, 1]).select(means).how == "in a box of 1 x 1 x 1"


def test_a_question_gives_the_same_as_its_parts_combined():
    splats = cloud([0, 1, -1, 2, 1]).replace(scores=np.array([0.1, 0.9, 0.2, np.nan, 0.3]), names=("a", "b", "c"))
    box, sure = InBox((0, 0, 0), (8, 8, 8)), AboveScore(0.25)
    asked, combined = (
        ((OfClass("b") & sure) - box).select(splats),
        (OfClass("b").select(splats) & sure.select(splats)) - box.select(splats),
    )
    assert asked.mask.equal(combined.mask)
    assert asked.scores.equal(combined.scores)
    assert asked.indices.tolist() == [4]
    assert sure.select(splats).scores.tolist() == pytest.approx([0.1, 0.9, 0.2, 0.0, 0.3])
    assert sure.select(splats).threshold == 0.25


def test_points_and_box_of_a_class_in_two_lines():
    splats = cloud([0, 1, -1, 2, 1]).replace(names=("wall", "chair", "lamp"))
    chair = OfClass("chair").select(splats)
    points, box = chair.points(splats), chair.box(splats)
    assert isinstance(points, np.ndarray)
    assert points.tolist() == [[3, 4, 5], [12, 13, 14]]
    assert box.center.tolist() == pytest.approx([7.5, 8.5, 9.5])
    assert box.half.tolist() == pytest.approx([4.5 * math.sqrt(3), 0, 0], abs=1e-6)
    for same in (splats, splats.means, splats.means.numpy()):
        assert np.array_equal(chair.points(same), points)
    with pytest.raises(ValueError, match=tells("cloud", "N = 5", "(4, 3)")):
        chair.points(torch.zeros(4, 3))
    with pytest.raises(ValueError, match=tells("points", "at least one")):
        OfClass(7).select(splats).box(splats)


def test_arrays_are_taken_and_text_gets_advice():
    chosen = Selection(np.array([True, False]), np.array([0.5, 0.25]))
    assert chosen.scores.dtype == torch.float64
    assert chosen & Selection.of(np.array([True, True]))
    with pytest.raises(TypeError, match=tells("mask", "'chair'", "OfClass")):
        Selection.of("chair")
    with pytest.raises(TypeError, match=tells("cloud", "Tensor")):
        OfClass("chair").select(torch.zeros(3, 3))


def test_a_selection_shows_itself_in_short():
    long = some(0)
    for seed in range(1, 40):
        long = long | some(seed)
    assert len(repr(long)) < 250
    shown = some(0)._repr_html_()
    assert shown.startswith("<table>")
    assert "of 40 Gaussians" in shown
    assert "Selection" in Selection.of(torch.zeros(3, dtype=torch.bool))._repr_html_()


def test_wrong_input_is_named():
    a, gaussians = some(0), cloud([0, 1])
    with pytest.raises(ValueError, match=tells("other:", "40 Gaussians", "39")):
        a & some(1, n=39)
    with pytest.raises(ValueError, match=tells("other:", "40 Gaussians", "39")):
        a ^ some(1, n=39)
    with pytest.raises(TypeError, match=tells("other:", "got Tensor", "Selection.of(mask)")):
        a - a.mask
    with pytest.raises(TypeError, match=tells("mask:", "got torch.float32")):
        Selection.of(torch.ones(3))
    with pytest.raises(ValueError, match=tells("scores:", "[N]", "N = 3", "got (4,)")):
        Selection(torch.ones(3, dtype=torch.bool), torch.ones(4))
    with pytest.raises(ValueError, match=tells("scores:", "got NaN", "row 1")):
        Selection(torch.ones(2, dtype=torch.bool), torch.tensor([0.0, math.nan]))
    with pytest.raises(ValueError, match=tells("class:", "wall, chair", "got 'chiar'", "'chair'")):
        OfClass("chiar").select(gaussians, ("wall", "chair"))
    for wrong in (1.5, [1, 2.0], True, None, b"chair"):
        with pytest.raises(ValueError, match=tells("name:", "whole number", f"got {wrong!r}")):
            OfClass(wrong)
    with pytest.raises(ValueError, match=tells("name:", "[-1, ", "got -2")):
        OfClass(-2)
    with pytest.raises(ValueError, match=tells("gaussians.labels:", "got None")):
        OfClass(1).select(gaussians.replace(labels=None))
    with pytest.raises(ValueError, match=tells("half:", "got [0.5, 0.5, -0.5]")):
        OrientedBox.between([0, 0, 1], [1, 1, 0])
    with pytest.raises(ValueError, match=tells("max", "min")):
        InBox([0, 0, 1], [1, 1, 0])
    with pytest.raises(ValueError, match=tells("radius:", "(0, inf)", "got -1")):
        InSphere([0, 0, 0], -1)
    with pytest.raises(ValueError, match=tells("center:", "expected 3", "got [0, nan, 0]")):
        InSphere([0, math.nan, 0], 1)
    broken = placed(torch.tensor([[0.0, 0, 0], [math.nan, 0, 0]]))
    for where in (InSphere([0, 0, 0], 1), InBox([0, 0, 0], [1, 1, 1])):
        with pytest.raises(ValueError, match=tells("gaussians.means:", "got NaN", "row 1")):
            where.select(broken)
