import pytest
import torch
from cases_clouds import balls
from messages import refused

from kfgs.labels import Extract, OfClass, Opacity, Recolor, Remove
from kfgs.labels.color import parse_color, recolor
from kfgs.labels.selection import OfIndex
from kfgs.splat.sh import rgb_to_sh0

CLASSES = ("wall", "chair", "plant")


def scene():
    """Nine balls on a line, whose scores are their places."""
    x = torch.arange(9.0)
    sh = rgb_to_sh0(torch.rand(9, 1, 3, generator=torch.Generator().manual_seed(0)))
    made = balls(torch.stack([x, 0 * x, 0 * x], dim=1), [0, 0, 0, 1, 1, -1, -1, 0, -1], sh=sh, scores=x, names=CLASSES)
    return made.replace(opacities=torch.linspace(0.1, 0.9, 9))


def places(splats):
    assert splats.scores.tolist() == splats.means[:, 0].tolist()  # columns stay with their rows
    return splats.means[:, 0].tolist()


def test_remove_and_extract_divide_the_cloud():
    splats = scene()
    assert places(Remove("chair").apply(splats)) == [0, 1, 2, 5, 6, 7, 8]
    assert places(Extract("chair").apply(splats)) == [3, 4]
    assert Remove("chair").apply(splats).names == CLASSES  # names stay: labels mean what they meant
    assert places(splats) == list(range(9))


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
    "edit", [Remove, Extract, lambda where: Recolor(where, "red"), lambda where: Opacity(where, 0)]
)
def test_nothing_selected_is_an_error(edit):
    splats = scene()
    refused(lambda: edit(OfClass("plant")).apply(splats), "where:", "got none", "OfClass(name=", "'plant'", "(2)")


def test_what_cannot_be_edited_is_named():
    refused(lambda: Remove(3), "where:", "OfClass", "got 3", error=TypeError)
    refused(lambda: Remove([]), "where:", "at least one rule")
    refused(lambda: Recolor("chair", "red").apply(scene().replace(sh=None)), "gaussians.sh:", "got None")


def test_several_rules_select_what_any_of_them_does():
    splats = scene()
    assert Remove(OfClass("chair").select(splats)) == Remove(OfIndex([3, 4]))  # a selection can be edited as well
    both = Extract(["chair", OfIndex([0]), OfClass(-1)]).apply(splats)
    assert places(both) == [0, 3, 4, 5, 6, 8]
    painted = Recolor(["chair", OfIndex([0])], "#c04040").apply(splats)
    mask = torch.tensor([True, False, False, True, True, False, False, False, False])
    assert painted.sh.equal(recolor(splats, mask, parse_color("#c04040")).sh)
