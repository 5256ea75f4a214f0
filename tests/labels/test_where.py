import json

import numpy as np
import pytest
import torch
from messages import tells
from scipy.spatial.transform import Rotation

from kfgs.gaussians import Gaussians
from kfgs.labels import (
    AboveScore,
    Both,
    Component,
    Either,
    Everything,
    InBox,
    InSphere,
    Not,
    OfClass,
    OfIndex,
    Where,
)

CLASSES = ("wall", "Chair", "plant")


def cloud(n=60, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=torch.from_numpy(rng.uniform(-2, 2, (n, 3))),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.5),
        labels=torch.arange(n) % 4 - 1,
    )


def ask(where, gaussians, extra=None):
    return where.mask(gaussians.replace(extra=extra or {}, names=CLASSES)).tolist()


def test_class_by_name_by_index_and_none():
    g = cloud()
    assert ask(OfClass("plant"), g) == ask(OfClass(2), g) == [label == 2 for label in g.labels.tolist()]
    assert ask(OfClass("chair"), g) == ask(OfClass(1), g)  # whatever its case
    assert ask(OfClass(-1), g) == [label == -1 for label in g.labels.tolist()]
    assert not any(ask(OfClass(7), g))
    assert OfClass(np.int64(2)) == OfClass(torch.tensor(2)) == OfClass(2)


def test_all_classes_of_one_name_are_meant():
    g = cloud()
    expected = [label in (0, 2) for label in g.labels.tolist()]
    assert OfClass("chair").mask(g, ("chair", "wall", "chair")).tolist() == expected
    assert OfClass("Chair").mask(g, ("chair", "wall", "chair")).tolist() == expected


def test_a_name_in_its_own_case_wins():
    g = cloud()
    assert OfClass("chair").mask(g, ("Chair", "chair", "wall")).tolist() == ask(OfClass(1), g)


def test_box_against_a_loop():
    g, low, high = cloud(), (-1.0, -0.5, -2.0), (0.5, 1.5, 1.0)
    expected = [all(a <= x <= b for a, x, b in zip(low, p, high, strict=True)) for p in g.means.tolist()]
    assert 0 < sum(expected) < 60
    assert ask(InBox(low, high), g) == expected


def test_turned_box_against_its_definition():
    g, low, high = cloud(400), np.array([-1.0, -0.2, -2.0]), np.array([1.0, 0.8, 1.0])
    w, x, y, z = quaternion = (0.9, 0.1, -0.3, 0.4)
    R, center = Rotation.from_quat([x, y, z, w]).as_matrix(), (low + high) / 2
    expected = []
    for point in g.means.numpy():
        local = center + R.T @ (point - center)
        expected.append(bool((local >= low).all() and (local <= high).all()))
    straight = ask(InBox(low, high), g)
    assert ask(InBox(low, high, quaternion), g) == expected != straight
    assert ask(InBox(low, high, tuple(-2 * q for q in quaternion)), g) == expected
    assert ask(InBox(low, high, (1, 0, 0, 0)), g) == straight


def test_faces_and_the_sphere_itself_belong_inside():
    g = cloud(2).replace(means=torch.tensor([[1.0, 0, 0], [1.0 + 1e-6, 0, 0]], dtype=torch.float64))
    assert ask(InBox((-1, -1, -1), (1, 1, 1)), g) == [True, False]
    assert ask(InSphere((0, 0, 0), 1), g) == [True, False]


def test_index_score_and_everything():
    g = cloud(4)
    assert ask(OfIndex([2, 0, 2]), g) == [True, False, True, False]
    assert OfIndex(torch.tensor([True, False, True, False])) == OfIndex([0, 2]) == OfIndex(torch.tensor([2, 0]))
    score = np.array([0.1, 0.5, 0.6, 0.9], np.float32)
    assert ask(AboveScore(0.5), g, {"score": score}) == [False, False, True, True]
    assert ask(AboveScore(0.8, "sure"), g, {"sure": score}) == [False, False, False, True]
    assert ask(Everything(), g) == [True] * 4
    assert ask(OfIndex([]), g) == [False] * 4


def test_algebra_is_that_of_sets():
    g, a, b, c = cloud(), OfClass("plant"), InSphere((0, 0, 0), 1.5), InBox((0, 0, 0), (2, 2, 2))
    A, B, C = (set(np.flatnonzero(ask(w, g)).tolist()) for w in (a, b, c))
    everything = set(range(60))
    assert A & B
    assert B - A
    for where, expected in (
        (a & b, A & B),
        (a | b, A | B),
        (a - b, A - B),
        (~a, everything - A),
        (~(a | b) & c, (everything - A - B) & C),
        (a | b & c, A | (B & C)),
    ):
        assert set(np.flatnonzero(ask(where, g)).tolist()) == expected
    assert ~~a == a
    assert len((a & b & c).parts) == 3
    assert (a | b) | c == Either((a, b, c))


def test_component_is_the_largest_connected_part_or_the_next():
    x = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1, 9.0])
    means = torch.stack([x, torch.zeros(6), torch.zeros(6)], dim=1)
    g = cloud(6).replace(means=means, labels=torch.tensor([1, 1, 1, 1, 1, 0]))
    assert ask(Component(OfClass(1), 0.5), g) == [True, True, True, False, False, False]
    assert ask(Component(OfClass(1), 0.5, 1), g) == [False, False, False, True, True, False]
    assert not any(ask(Component(OfClass(1), 0.5, 2), g))
    assert not any(ask(Component(OfClass(9), 0.5), g))


def test_a_part_far_down_the_list_is_found():
    n = 250  # parts of one Gaussian each, more than `connected_parts` returns
    g = Gaussians(
        means=torch.arange(n, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.5),
        labels=torch.ones(n, dtype=torch.int64),
    )
    assert Component(OfClass(1), 0.5, 200).mask(g).nonzero().tolist() == [[200]]  # equally large: by index


EVERY_KIND = (
    (OfClass("plant") | OfClass(-1)) - InBox((0, 0, 0), (1, 1, 1), (1, 0, 0, 0.5)),
    Component(~InSphere((1, 2, 3), 0.25), 0.1, 1),
    Both((Everything(), OfIndex([3, 1]), AboveScore(0.5, "sure"), InBox((0, 0, 0), (1, 1, 1)))),
    Not(Component(OfClass("wall"))),
)


@pytest.mark.parametrize("where", EVERY_KIND, ids=lambda where: where.kind)
def test_json_there_and_back(where):
    text = json.dumps(where.to_json(), allow_nan=False)
    assert Where.from_json(json.loads(text)) == where
    assert hash(Where.from_json(json.loads(text))) == hash(where)


def nested(depth):
    value = {"kind": "everything"}
    for _ in range(depth):
        value = {"kind": "not", "where": value}
    return value


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("chair", ("where:", "everything, class", "'kind'", "got 'chair'")),
        ({"kind": "klass"}, ("where:", "got {'kind': 'klass'}")),
        ({"kind": ["class"]}, ("where:", "got {'kind': ['class']}")),
        ({"kind": "class"}, ("where:", "'name'", "'class'", "got none")),
        ({"kind": "class", "name": "a", "size": 3}, ("where:", "'class'", "got 'size'")),
        ({"kind": "class", "name": True}, ("where.name:", "got True")),
        ({"kind": "class", "name": 10**30}, ("where.name:", "got 1000000000000000000000000000000")),
        ({"kind": "box", "min": [0, 0], "max": [1, 1, 1]}, ("where.min:", "expected 3", "got [0, 0]")),
        ({"kind": "box", "min": "abc", "max": [1, 1, 1]}, ("where.min:", "expected 3", "got 'abc'")),
        (
            {"kind": "box", "min": [0, 0, float("nan")], "max": [1, 1, 1]},
            ("where.min:", "expected 3", "got [0, 0, nan]"),
        ),
        ({"kind": "box", "min": [0, 0, 2], "max": [1, 1, 1]}, ("where.max:", "min", "got (1.0, 1.0, 1.0)")),
        ({"kind": "box", "min": [0] * 3, "max": [1] * 3, "rotation": [0] * 4}, ("where.rotation:", "got zeros")),
        ({"kind": "sphere", "center": [0, 0, 0], "radius": "1"}, ("where.radius:", "got '1'")),
        (
            {"kind": "sphere", "center": [0, 0, 0], "radius": 10**400},
            ("where.radius:", "got 10000000000000000000000000000000000000000000000000000000000000000000000000000000"),
        ),
        ({"kind": "sphere", "center": [0, 0, 0], "radius": float("inf")}, ("where.radius:", "got inf")),
        ({"kind": "sphere", "center": [0, 0, 0], "radius": 0}, ("where.radius:", "got 0.0")),
        ({"kind": "index", "indices": [1.5]}, ("where.indices:", "got 1.5")),
        ({"kind": "index", "indices": [-1]}, ("where.indices:", "got -1")),
        ({"kind": "index", "indices": 3}, ("where.indices:", "got 3")),
        ({"kind": "score", "threshold": 0, "column": 3}, ("where.column:", "got 3")),
        ({"kind": "not", "where": "chair"}, ("where.where:", "'kind'", "got 'chair'")),
        ({"kind": "both", "parts": []}, ("where.parts:", "got ()")),
        ({"kind": "either", "parts": [{"kind": "class", "name": []}]}, ("where.parts[0].name:", "got []")),
        ({"kind": "component", "where": {"kind": "everything"}, "rank": -1}, ("where.rank:", "got -1")),
        (nested(40), ("32 levels", "got more")),
    ],
)
def test_json_of_others_is_refused_with_the_place(value, message):
    with pytest.raises(ValueError, match=tells(*message)):
        Where.from_json(value)


def test_what_the_cloud_lacks_is_named():
    g = cloud()
    with pytest.raises(ValueError, match=tells("class:", "wall, Chair, plant", "got 'plnat'", "'plant'")):
        OfClass("plnat").mask(g, CLASSES)
    with pytest.raises(ValueError, match=tells("gaussians.labels:", "'plant'", "got None")):
        OfClass("plant").mask(g.replace(labels=None), CLASSES)
    with pytest.raises(ValueError, match=tells("indices:", "got 60")):
        OfIndex([0, 60]).mask(g)
    with pytest.raises(ValueError, match=tells("column:", "(none)", "got 'score'")):
        AboveScore(0.5).mask(g)
    with pytest.raises(TypeError, match=tells("where:", "OfClass", "got 'plant'")):
        Not("plant")
    with pytest.raises(TypeError, match=tells("OfClass", "str")):
        OfClass("plant") & "wall"


def test_a_rotation_of_the_smallest_floats_is_one():
    g = cloud(200)
    for tiny in (1e-320, 1e308):
        assert ask(InBox((-1, -1, -1), (1, 0, 1), (tiny, 0, 0, tiny)), g) == ask(
            InBox((-1, -1, -1), (1, 0, 1), (1, 0, 0, 1)), g
        )
