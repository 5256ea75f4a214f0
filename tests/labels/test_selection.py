import json
import math
import operator

import numpy as np
import pytest
import torch
from cases_clouds import balls
from messages import refused
from oracles_selection import rotation

from kfgs.labels import InBox, OfClass, OrientedBox, Selection
from kfgs.labels.selection import KINDS, OfIndex, read_object

NAMES = ("wall", "Chair", "plant")


def cloud(n=60):
    means = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (n, 3)))
    return balls(means, torch.arange(n) % 4 - 1, names=NAMES).replace(means=means)


def ask(where, gaussians):
    return where.select(gaussians).mask.tolist()


def test_class_by_name_by_index_and_none():
    g = cloud()
    assert ask(OfClass("plant"), g) == ask(OfClass(2), g) == [label == 2 for label in g.labels.tolist()]
    assert ask(OfClass("chair"), g) == ask(OfClass(1), g)  # whatever its case
    assert ask(OfClass(-1), g) == [label == -1 for label in g.labels.tolist()]
    assert not any(ask(OfClass(7), g))
    twice = g.replace(names=("chair", "wall", "chair"))
    assert ask(OfClass("Chair"), twice) == [label in (0, 2) for label in g.labels.tolist()]
    own_case = g.replace(names=("Chair", "chair", "wall"))
    assert ask(OfClass("chair"), own_case) == ask(OfClass(1), g)
    chairs = OfClass("chair").select(g)
    assert (chairs.threshold, chairs.how) == (None, "label chair")


def test_a_part_of_a_class_is_the_largest_or_the_next():
    x = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1, 9.0])
    means = torch.stack([x, torch.zeros(6), torch.zeros(6)], dim=1)
    g = cloud(6).replace(means=means, labels=torch.tensor([1, 1, 1, 1, 1, 0]))
    g = g.replace(extra={"instance": np.array([1, 1, 1, 2, 2, 1])})
    assert ask(OfClass(1, 0), g) == [True, True, True, False, False, False]
    assert ask(OfClass("chair", part=1), g) == [False, False, False, True, True, False]
    for rule, got in ((OfClass("chair", 2), "1 to 2, got chair/3"), (OfClass(9, 0), ".* got 9, which none has")):
        with pytest.raises(ValueError, match=f"part: expected {got}"):
            rule.select(g)
    assert ask(OfIndex([2, 0, 2]), g) == [True, False, True, False, False, False]
    assert OfIndex([0, 2]) == OfIndex(torch.tensor([2, 0]))


def test_a_box_against_loops_faces_included():
    g, low, high = cloud(), (-1.0, -0.5, -2.0), (0.5, 1.5, 1.0)
    expected = [all(a <= x <= b for a, x, b in zip(low, p, high, strict=True)) for p in g.means.tolist()]
    assert 0 < sum(expected) < 60
    assert ask(InBox(low, high), g) == expected
    edge = cloud(2).replace(means=torch.tensor([[1.0, 0, 0], [1.0 + 1e-6, 0, 0]], dtype=torch.float64))
    assert ask(InBox((-1, -1, -1), (1, 1, 1)), edge) == [True, False]
    far = edge.replace(origin=(5e5, 0.0, 0.0))
    assert ask(InBox((499999, -1, -1), (500001, 1, 1)), far) == [True, False]


@pytest.mark.parametrize(
    "where",
    [OfClass("plant"), OfClass(-1, 1), InBox((0, 0, 0), (1, 1, 1)), OfIndex([3])],
)
def test_json_there_and_back(where):
    again = read_object("where", json.loads(json.dumps(where.to_json(), allow_nan=False)), KINDS, "kind")
    assert again == where
    assert hash(again) == hash(where)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("chair", ("where:", "class, box", "'kind'", "got 'chair'")),
        ({"kind": ["class"]}, ("where:", "got {'kind': ['class']}")),
        ({"kind": "class"}, ("where:", "'name'")),
        ({"kind": "class", "name": "a", "size": 3}, ("where:", "'size'")),
        ({"kind": "class", "name": True}, ("where: name:", "got True")),
        ({"kind": "class", "name": "a", "part": -1}, ("where: part:", "got -1")),
        ({"kind": "box", "min": [0, 0], "max": [1, 1, 1]}, ("where: min:", "3 numbers", "got [0, 0]")),
        ({"kind": "box", "min": [0, 0, float("nan")], "max": [1, 1, 1]}, ("where: min:", "got nan")),
        ({"kind": "box", "min": [0, 0, 2], "max": [1, 1, 1]}, ("where: max:", "min", "got (1.0, 1.0, 1.0)")),
        ({"kind": "index", "indices": [1.5]}, ("where: indices:", "got 1.5")),
        ({"kind": "index", "indices": 3}, ("where: indices:", "got 3")),
    ],
)
def test_json_of_others_is_refused_with_the_place(value, message):
    refused(lambda: read_object("where", value, KINDS, "kind"), *message)


def test_what_the_cloud_lacks_is_named():
    g = cloud()
    refused(lambda: OfClass("plnat").select(g), "class:", "wall, Chair, plant", "got 'plnat'", "'plant'")
    refused(lambda: OfClass("plant").select(g.replace(labels=None)), "gaussians.labels:", "'plant'", "got None")
    refused(lambda: OfIndex([0, 60]).select(g), "indices:", "got 60")
    means = g.means.clone()
    means[1] = math.nan
    box = InBox([0, 0, 0], [1, 1, 1])
    refused(lambda: box.select(g.replace(means=means)), "gaussians.means:", "got NaN", "row 1")


# Selections


def some(seed, n=40):
    scores = torch.rand(n, generator=torch.Generator().manual_seed(seed))
    return Selection(scores > 0.5, scores, 0.5, f"seed {seed}")


def test_what_a_selection_knows():
    chosen = Selection(torch.tensor([False, True, True]), torch.tensor([0.1, 0.7, 0.9]), 0.5, "given")
    assert (len(chosen), chosen.indices.tolist()) == (2, [1, 2])
    assert repr(chosen) == "Selection(2 of 3 Gaussians: score > 0.5 (given))"
    assert not Selection.of(torch.zeros(3, dtype=torch.bool))  # empty is false


@pytest.mark.parametrize(
    ("combine", "mask", "scores"),
    [
        (operator.and_, [1, 0, 0, 0], [0.6, 0.1, 0.2, 0.3]),
        (operator.or_, [1, 1, 1, 0], [0.9, 0.8, 0.7, 0.4]),
        (operator.sub, [0, 1, 0, 0], [0.4, 0.8, 0.2, 0.4]),
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


def test_wrong_selections_are_named():
    a = some(0)
    refused(lambda: a & some(1, n=39), "other:", "40 Gaussians", "39")
    refused(lambda: a - a.mask, "other:", "got Tensor", "Selection.of(mask)", error=TypeError)
    refused(lambda: Selection.of(torch.ones(3)), "mask:", "got torch.float32", error=TypeError)
    refused(lambda: Selection(torch.ones(3, dtype=torch.bool), torch.ones(4)), "scores:", "[N]", "got (3,) and (4,)")
    refused(lambda: Selection(torch.ones(2, dtype=torch.bool), torch.tensor([0.0, math.nan])), "scores:", "got NaN")


# Oriented boxes


@pytest.mark.parametrize("seed", range(4))
def test_a_box_holds_every_point_and_is_no_larger_than_that_along_the_axes(seed):
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.normal(size=(200, 3)) @ rng.normal(size=(3, 3)) + rng.gamma(1, 1, (200, 1)))
    box = OrientedBox.around(points)
    assert (((points - box.center) @ box.axes.T).abs() <= box.half + 1e-9).all()
    assert box.volume <= float((points.amax(0) - points.amin(0)).prod()) * (1 + 1e-9)


def test_boxes_of_a_turned_box_a_rectangle_and_a_point():
    turn = torch.from_numpy(rotation([1, -2, 0.5], 37))
    flat = torch.tensor([[1.0, 0.5, 0], [-1, 0.5, 0], [1, -0.5, 0], [-1, -0.5, 0]], dtype=torch.float64) @ turn.T
    assert (2 * OrientedBox.around(flat).half).tolist() == pytest.approx([2, 1, 0], abs=1e-9)
    solid = torch.cartesian_prod(*torch.tensor([[-1.5, 1.5], [-1, 1], [-0.25, 0.25]]).double())
    box = OrientedBox.around(solid @ turn.T + 4)
    assert (2 * box.half).tolist() == pytest.approx([3, 2, 0.5])
    torch.testing.assert_close((box.axes @ turn).abs(), torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    assert (float(torch.linalg.det(box.axes)), box.volume) == (pytest.approx(1), pytest.approx(3))
    torch.testing.assert_close(box.corners.mean(0), box.center)
    point = OrientedBox.around(torch.tensor([[1.0, 2, 3]]).expand(5, 3))
    assert (point.center.tolist(), point.half.tolist(), point.volume) == ([1, 2, 3], [0, 0, 0], 0)
    refused(lambda: OrientedBox.around(torch.tensor([[0.0, 0, 0], [0, math.inf, 0]])), "points:", "got NaN", "row 1")
