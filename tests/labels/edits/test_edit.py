import numpy as np
import pytest
import torch
from messages import tells

from kfgs import Gaussians
from kfgs.labels import Extract, OfClass, OfIndex, Opacity, Recolor, Remove, recolor
from kfgs.splat import rgb_to_sh0

CLASSES = ("wall", "chair", "plant")


def scene(positions=range(9), labels=(0, 0, 0, 1, 1, -1, -1, 0, -1)):
    n = len(positions)
    means = torch.zeros(n, 3)
    means[:, 0] = torch.tensor(list(positions), dtype=torch.float32)
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.linspace(0.1, 0.9, n),
        sh=rgb_to_sh0(torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(0))),
        labels=torch.tensor(labels),
    )
    return gaussians.replace(scores=np.arange(n, dtype=np.float32), names=CLASSES)


def places(splats):
    assert splats.scores.tolist() == splats.means[:, 0].tolist()  # columns stay with their rows
    return splats.means[:, 0].tolist()


def test_remove_and_extract_divide_the_cloud():
    splats = scene()
    assert places(Remove("chair").apply(splats)) == [0, 1, 2, 5, 6, 7, 8]
    assert places(Extract("chair").apply(splats)) == [3, 4]
    assert Remove("chair").apply(splats).names == CLASSES  # names stay: labels mean what they meant
    assert places(splats) == list(range(9))


def test_grow_takes_unlabelled_neighbours_that_are_nearest_to_it():
    splats = scene()  # the chair at 3 and 4, a wall at 0, 1, 2 and 7, orphans at 5, 6 and 8
    assert places(Remove("chair", grow=1.0).apply(splats)) == [0, 1, 2, 5, 6, 7, 8]  # strictly closer
    assert places(Remove("chair", grow=1.5).apply(splats)) == [0, 1, 2, 6, 7, 8]
    assert places(Remove("chair", grow=100.0).apply(splats)) == [0, 1, 2, 6, 7, 8]  # 6 and 8 belong to the wall at 7
    middle = scene((0, 1, 2, 3, 4, 5, 5.5, 7, 8))
    assert places(Remove("chair", grow=100.0).apply(middle)) == [0, 1, 2, 7, 8]  # 5.5 lies half-way: taken


def test_grow_against_loops():
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 2, 200)
    splats = scene(range(200), labels)
    points = rng.uniform(0, 1, (200, 3))
    splats = splats.replace(means=torch.from_numpy(points))
    gone = []
    for i in range(200):
        to = {label: min(np.linalg.norm(points[i] - p) for p in points[labels == label]) for label in (0, 1)}
        if labels[i] == 1 or (labels[i] == -1 and to[1] < 0.1 and to[1] <= to[0]):
            gone.append(i)
    assert (labels == 1).sum() < len(gone) < (labels != 0).sum()
    left = Remove("chair", grow=0.1).apply(splats).scores.int().tolist()
    assert left == sorted(set(range(200)) - set(gone))


def test_grow_without_labels_takes_every_neighbour():
    splats = scene()
    splats = splats.replace(labels=None)
    assert places(Remove(OfIndex([3, 4]), grow=1.5).apply(splats)) == [0, 1, 6, 7, 8]


def test_opacity_multiplies_and_nought_hides():
    splats = scene()
    before = splats.opacities.clone()
    half, hidden = Opacity("chair", 0.5).apply(splats), Opacity("chair", 0).apply(splats)
    expected = [0.5 if i in (3, 4) else 1.0 for i in range(9)]
    torch.testing.assert_close(half.opacities / before, torch.tensor(expected))
    assert (hidden.opacities[3:5] < 1 / 255).all()
    assert (hidden.opacities > 0).all()
    assert len(hidden) == 9
    faint = torch.tensor([0.5, 0.5, 0.5, 1e-9, 0.0, 0.5, 0.5, 0.5, 0.5])
    faint = splats.replace(opacities=faint)
    for factor in (1, 0.5, 0):  # what is fainter than hidden gets no stronger
        assert Opacity("chair", factor).apply(faint).opacities.equal(faint.opacities)
    assert Opacity("chair", 1).apply(splats).opacities.equal(before)
    assert splats.opacities.equal(before)


@pytest.mark.parametrize(
    "edit", [Remove, Extract, lambda w, **k: Recolor(w, "red", **k), lambda w, **k: Opacity(w, 0, **k)]
)
def test_nothing_selected_is_an_error_unless_allowed(edit):
    splats = scene()
    with pytest.raises(
        ValueError,
        match=tells("where:", "got none", "OfClass(name=", "'plant'", "(4)", "(2)"),
    ):
        edit(OfClass("plant")).apply(splats)
    result = edit(OfClass("plant"), allow_empty=True).apply(splats)
    assert len(result) == (0 if edit is Extract else 9)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Remove(3), TypeError, ("where:", "OfClass", "got 3")),
        (lambda: Remove([]), ValueError, ("where:", "at least one rule")),
        (lambda: Remove("chair", grow=-1), ValueError, ("grow:", "got -1")),
        (lambda: Remove("chair", grow="1"), TypeError, ("grow:", "got '1'")),
        (lambda: Opacity("chair", 1.5), ValueError, ("factor:", "[0, 1]", "got 1.5")),
        (lambda: Recolor("chair", "reddish"), ValueError, ("rgb:", "'#c04040'", "got 'reddish'")),
        (lambda: Recolor("chair", "red", "paint"), ValueError, ("mode:", "'tint', 'hue'", "got 'paint'")),
    ],
)
def test_wrong_input_is_named(make, error, message):
    with pytest.raises(error, match=tells(*message)):
        make()


def test_a_cloud_without_colours_cannot_be_painted():
    splats = scene()
    with pytest.raises(ValueError, match=tells("gaussians.sh:", "got None")):
        Recolor("chair", "red").apply(splats.replace(sh=None))


def test_grow_names_a_position_that_is_none():
    splats = scene()
    means = splats.means.clone()
    means[5] = torch.nan
    broken = splats.replace(means=means)
    with pytest.raises(ValueError, match=tells("gaussians.means:", "got NaN", "row 5")):
        Remove("chair", grow=0.5).apply(broken)
    assert len(Remove("chair").apply(broken)) == 7


def test_a_selection_can_be_edited_as_well():
    splats = scene()
    chairs = OfClass("chair").select(splats)
    assert Remove(chairs) == Remove(OfIndex([3, 4]))
    assert places(Remove(chairs).apply(splats)) == places(Remove("chair").apply(splats))


def test_several_rules_select_what_any_of_them_does():
    splats = scene()
    both = Extract(["chair", OfIndex([0]), OfClass(-1)]).apply(splats)
    assert places(both) == [0, 3, 4, 5, 6, 8]
    painted = Recolor(["chair", OfIndex([0])], "#c04040").apply(splats)
    mask = torch.tensor([True, False, False, True, True, False, False, False, False])
    assert painted.sh.equal(recolor(splats, mask, "#c04040").sh)
